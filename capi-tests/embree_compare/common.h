// What all files share: errors, vectors, medians and clocks.

#pragma once

#include <bakelite.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

const float INF = std::numeric_limits<float>::infinity();

[[noreturn]] void fail(const std::string &what);
void check(bk_result result);

// Denormals to zero on the calling thread, as Embree recommends; for both sides.
void flush_denormals();

// Seconds, from any beginning: by the clock on the wall, and what the calling thread and all threads together have run.
// The latter leave out what a thread waits while others have its core.
double wall_seconds();
double thread_seconds();
double process_seconds();

inline double median(std::vector<double> v) {
    std::sort(v.begin(), v.end());
    return v.empty() ? 0 : 0.5 * (v[(v.size() - 1) / 2] + v[v.size() / 2]);
}

// ---------------------------------------------------------------------------------------------
// Vectors in the precision that is asked for.

template <typename T> struct Vec {
    T x, y, z;
    Vec operator+(Vec b) const { return {x + b.x, y + b.y, z + b.z}; }
    Vec operator-(Vec b) const { return {x - b.x, y - b.y, z - b.z}; }
    Vec operator*(T s) const { return {x * s, y * s, z * s}; }
};
template <typename T> T dot(Vec<T> a, Vec<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <typename T> Vec<T> cross(Vec<T> a, Vec<T> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <typename T> T length(Vec<T> a) { return std::sqrt(dot(a, a)); }
template <typename T> T largest(Vec<T> a) { return std::max({std::abs(a.x), std::abs(a.y), std::abs(a.z)}); }
template <typename T> Vec<T> unit(Vec<T> a) { return a * (T(1) / length(a)); }

using Exact = long double;
using Vec3d = Vec<double>;
using Vec3x = Vec<Exact>;

inline Vec3d load(const float *p) { return {p[0], p[1], p[2]}; }
inline Vec3x exact(const float *p) { return {p[0], p[1], p[2]}; }
inline void store(Vec3d v, float *p) { p[0] = float(v.x), p[1] = float(v.y), p[2] = float(v.z); }
