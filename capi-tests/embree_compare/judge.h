// Every ray on which the two sides disagree, judged by an oracle in extended precision.
//
//   same t   both hit, at the same distance (coincident triangles, a shared edge)
//   grazing  the ray passes an edge, or the end of its range, closer than rounding can tell
//   theirs   the oracle agrees with Bakelite
//   real     the oracle agrees with Embree

#pragma once

#include "rays.h"

enum Class { Agree, SameT, Grazing, Theirs, Real };

struct Counts {
    size_t hits = 0, misses = 0, of[5] = {}; // ours, and how many rays are of each class
};

// Compares what `k` holds with what Embree says of a robust scene; prints the first real disagreements to stderr.
Counts verify(const Kind &k, const Scene &s, RTCScene robust);
