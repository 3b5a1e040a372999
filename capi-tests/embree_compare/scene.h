// One scene on both sides.

#pragma once

#include "common.h"

#include <embree3/rtcore.h>

#include <utility>

// How Embree builds: its default, RTC_BUILD_QUALITY_HIGH, RTC_SCENE_FLAG_ROBUST. Rows of a peer are not Embree's.
enum Mode { DEFAULT, HIGH, ROBUST, MODES, PEER = MODES };
inline const char *const MODE_NAMES[] = {"default", "high", "robust", "peer"};

// What both sides are to use.
struct Setup {
    uint32_t isa = BK_ISA_AUTO;
    std::string embree_isa; // empty: its own choice
    uint32_t quality = BK_BUILD_QUALITY_DEFAULT;
    unsigned times = 1;     // how often the scene stands beside itself
    bool instances = false; // as instances of one mesh, instead of copies
};

inline const char *const ISA_NAMES[] = {"auto", "portable", "avx2", "avx512"};
inline const char *const QUALITY_NAMES[] = {"default", "high"};

// A position that can be given where floats are wanted.
struct Position {
    float x[3];
    operator const float *() const { return x; }
};

// Our side: committed, and all that rays are made from.
struct Scene {
    bk_device *device = nullptr;
    bk_scene *scene = nullptr;
    std::vector<bk_mesh_view> meshes; // of instances the same one for each
    std::vector<Position> places;     // where instances stand; empty: there are none
    std::vector<std::pair<uint32_t, uint32_t>> triangles; // (mesh, triangle) of those with an area
    std::vector<double> area_sums;
    bk_scene_stats stats;
    Vec3d center{};
    double diagonal = 0;

    Scene(const std::string &name, const Setup &setup);
    Scene(const Scene &) = delete;
    ~Scene();

    Position vertex(uint32_t mesh, uint32_t triangle, int corner) const {
        const bk_mesh_view &m = meshes[mesh];
        const float *const p = m.positions + 3 * size_t(m.indices[3 * size_t(triangle) + size_t(corner)]);
        if (places.empty()) return {{p[0], p[1], p[2]}};
        const float *const at = places[mesh];
        return {{p[0] + at[0], p[1] + at[1], p[2] + at[2]}};
    }
};

// Embree's side, committed in every mode.
struct EmbreeScenes {
    RTCDevice device;
    RTCScene of[MODES];

    EmbreeScenes(const Scene &s, const Setup &setup);
    EmbreeScenes(const EmbreeScenes &) = delete;
    ~EmbreeScenes();
};

// NULL if the machine has not got what is asked for.
bk_device *our_device(const Setup &setup, unsigned threads);
RTCDevice embree_device(const Setup &setup, unsigned threads);

// The triangles of `s`, to be committed.
bk_scene *our_scene(bk_device *device, const Scene &s, uint32_t quality);
RTCScene embree_scene(RTCDevice device, const Scene &s, Mode mode);
