// The kinds of rays, and for each the ways to trace them.

#pragma once

#include "scene.h"

#include <cstring>
#include <functional>

// ---------------------------------------------------------------------------------------------
// Rays in the layouts that the ways of tracing want.

struct Rays {
    std::vector<bk_ray> rays;
    std::vector<float> directions; // xyz packed, for bk_gather
    std::vector<RTCRay> ones;
    std::vector<RTCRay16> sixteens;

    void add(Vec3d origin, float tmin, Vec3d direction, float tmax) {
        bk_ray r;
        store(origin, r.origin);
        store(direction, r.direction);
        r.tmin = tmin;
        r.tmax = tmax;
        rays.push_back(r);
    }

    // Fills the other layouts; a multiple of 16 rays.
    void finish() {
        ones.resize(rays.size());
        sixteens.resize(rays.size() / 16);
        directions.resize(rays.size() * 3);
        for (size_t i = 0; i < rays.size(); i++) {
            const bk_ray &r = rays[i];
            std::memcpy(&directions[3 * i], r.direction, 12);
            RTCRay &one = ones[i];
            one.org_x = r.origin[0], one.org_y = r.origin[1], one.org_z = r.origin[2];
            one.dir_x = r.direction[0], one.dir_y = r.direction[1], one.dir_z = r.direction[2];
            one.tnear = r.tmin, one.tfar = r.tmax, one.time = 0;
            one.mask = ~0u, one.id = 0, one.flags = 0;
            RTCRay16 &p = sixteens[i / 16];
            const size_t k = i % 16;
            p.org_x[k] = one.org_x, p.org_y[k] = one.org_y, p.org_z[k] = one.org_z;
            p.dir_x[k] = one.dir_x, p.dir_y[k] = one.dir_y, p.dir_z[k] = one.dir_z;
            p.tnear[k] = one.tnear, p.tfar[k] = one.tfar, p.time[k] = 0;
            p.mask[k] = ~0u, p.id[k] = 0, p.flags[k] = 0;
        }
    }
};

// ---------------------------------------------------------------------------------------------
// Ways of tracing: run over the rays [begin, end), multiples of the kind's unit.

using Run = std::function<void(size_t begin, size_t end)>;
using EmbreeRun = std::function<void(RTCScene, size_t begin, size_t end)>;

struct Way {
    std::string name;
    EmbreeRun run;
};

const size_t STREAM = 256; // rays of an Embree stream

RTCIntersectContext context(RTCIntersectContextFlags flags);

// ---------------------------------------------------------------------------------------------
// The kinds of rays.

struct Kind {
    const char *name;
    size_t unit; // rays that belong together
    bool occlusion;
    Rays rays;
    Rays sorted;                   // the same in the order that suits Embree best, unit by unit; empty if there is none
    std::vector<bk_hit> hits;      // ours
    std::vector<uint8_t> occluded; // ours
    Run ours;
    std::vector<Way> ways;
};

const size_t KINDS = 10;
extern const char *const KIND_NAMES[KINDS];

// Makes rays of the kind with that number: the same for the same seed and scene, whatever traces them. As many as
// count, rounded down to whole units, but one unit at least.
void make_kind(Kind &k, size_t number, const Scene &s, size_t count, uint64_t seed);
