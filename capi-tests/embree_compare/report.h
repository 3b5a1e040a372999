// What was measured, as rows, and the tables made of them.

#pragma once

#include "judge.h"

#include <cstdio>

// One figure on both sides.
struct Row {
    std::string scene, isa, embree_isa;
    unsigned threads = 1;
    std::string build;      // of ours
    std::string what, unit; // a kind of rays in Mrays/s; commit, tree, scene, SAH cost
    double ours = 0;
    std::string way; // a function of Embree
    Mode mode = DEFAULT;
    double embree = 0, ratio = 0; // ours to Embree's
    double fastest = 0;           // Embree's rate in its fastest run
    Counts counts;                // of rays
};

extern const char *const COMMIT, *const TREE, *const SCENE, *const SAH;

void write_csv(const std::string &path, const std::vector<Row> &rows);

// Tables for a document.
void print_markdown(std::FILE *out, const std::vector<Row> &rows);
