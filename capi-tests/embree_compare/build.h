// What a commit costs and what it gives: time, memory, and the surface area heuristic's cost of the tree.

#pragma once

#include "scene.h"

struct CommitTimes {
    double ours = 0, embree = 0; // seconds, medians
    double ratio = 0;            // median over alternating pairs of Embree's time to ours
};

CommitTimes time_commits(const Scene &s, const Setup &setup, Mode mode, unsigned threads, unsigned pairs);

// Bytes, of the tree with the triangles in its leaves, and together with the vertices and indices that a scene keeps.
struct Bytes {
    double tree = 0, scene = 0;
};

// What bk_scene_stats says of a commit.
struct OurTree {
    Bytes bytes;
    double sah;
};

OurTree our_tree(const Scene &s, uint32_t quality);

// As the memory monitor counts them.
Bytes embree_bytes(const Scene &s, const Setup &setup, Mode mode);

// How many nodes plus triangles a ray through the scene's bounds is expected to meet: for all nodes and leaves the area
// of their box, times 1 or the number of triangles, by the area of the bounds. That is bk_scene_stats.wide_sah_cost.
//
// Embree does not show the tree of a scene. This is the cost of the tree that rtcBuildBVH makes with the parameters of
// the scene's builder: of default quality the same tree (what Embree prints of a scene with verbose=2 has the same sums
// of areas, to the last digit), of high quality one whose cost differs by less than 1 %. Embree tests leaves by blocks
// of four and builds for that: by blocks, Sponza's 46.4 would be 23.0. Our tree's cost by blocks is not to be had from
// the API, so this measure is a little in our favour.
double embree_sah(const Scene &s, const Setup &setup, Mode mode);
