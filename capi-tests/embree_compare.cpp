// Bakelite against Embree 3 on the same scene and the same rays: rates of every kind of ray, side by
// side, and every ray on which the two disagree, judged by an oracle of its own in extended
// precision.
//
//     embree_compare SCENE [--rays N] [--threads T] [--isa NAME] [--csv FILE] [--pairs P] [--seed S]
//
// SCENE: a file (.obj .ply .gltf .glb) or a built-in name. N: rays per kind (default 500000).
// T: threads, each tracing its share by single-thread calls (default 1). NAME: portable, avx2,
// avx512 (default: the best). P: pairs of runs per ratio (default 5).
//
// Rates are medians; a ratio is the median over alternating pairs (ours, Embree's) of our rate to
// Embree's. Embree gets its rays ready in its own layout and keeps its results in its own packets:
// only the copy into the structure that it traces is timed. "default" and "robust" are scenes
// without and with RTC_SCENE_FLAG_ROBUST. Both sides run with denormals flushed to zero.
//
// Disagreements are counted against Embree's robust rtcIntersect1 or rtcOccluded1:
//   same t   both hit, at the same distance (coincident triangles, a shared edge)
//   grazing  the ray passes an edge, or the end of its range, closer than rounding can tell
//   theirs   the oracle agrees with Bakelite
//   real     the oracle agrees with Embree: printed, and the exit code is 1

#include <bakelite.h>
#include <embree3/rtcore.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <functional>
#include <limits>
#include <random>
#include <string>
#include <thread>
#include <vector>
#if defined(__x86_64__) || defined(_M_X64)
#include <pmmintrin.h>
#include <xmmintrin.h>
#endif

namespace {

const float INF = std::numeric_limits<float>::infinity();

[[noreturn]] void fail(const std::string &what) {
    std::fprintf(stderr, "embree_compare: %s\n", what.c_str());
    std::exit(2);
}

void check(bk_result result) {
    if (result != BK_OK) fail(std::string(bk_result_string(result)) + ": " + bk_last_error());
}

// Denormals to zero on the calling thread, as Embree recommends; for both sides.
void flush_denormals() {
#if defined(__x86_64__) || defined(_M_X64)
    _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
    _MM_SET_DENORMALS_ZERO_MODE(_MM_DENORMALS_ZERO_ON);
#endif
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

Vec3d load(const float *p) { return {p[0], p[1], p[2]}; }
Vec3x exact(const float *p) { return {p[0], p[1], p[2]}; }
void store(Vec3d v, float *p) { p[0] = float(v.x), p[1] = float(v.y), p[2] = float(v.z); }

// ---------------------------------------------------------------------------------------------
// The scene on both sides.

struct Scene {
    bk_device *device = nullptr;
    bk_scene *scene = nullptr;
    RTCDevice embree = nullptr;
    RTCScene with_default = nullptr, with_robust = nullptr;
    std::vector<bk_mesh_view> meshes;
    std::vector<std::pair<uint32_t, uint32_t>> triangles; // (mesh, triangle) of those with an area
    std::vector<double> area_sums;
    Vec3d center{};
    double diagonal = 0;

    const float *vertex(uint32_t mesh, uint32_t triangle, int corner) const {
        const bk_mesh_view &m = meshes[mesh];
        return m.positions + 3 * size_t(m.indices[3 * size_t(triangle) + size_t(corner)]);
    }
    ~Scene() {
        rtcReleaseScene(with_default);
        rtcReleaseScene(with_robust);
        rtcReleaseDevice(embree);
        bk_scene_release(scene);
        bk_device_release(device);
    }
};

RTCScene embree_scene(const Scene &s, RTCSceneFlags flags) {
    RTCScene scene = rtcNewScene(s.embree);
    rtcSetSceneFlags(scene, flags);
    for (size_t m = 0; m < s.meshes.size(); m++) {
        const bk_mesh_view &mesh = s.meshes[m];
        if (mesh.triangle_count == 0) continue;
        RTCGeometry geometry = rtcNewGeometry(s.embree, RTC_GEOMETRY_TYPE_TRIANGLE);
        void *vertices = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12,
                                                 mesh.vertex_count);
        void *indices =
            rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, mesh.triangle_count);
        if (!vertices || !indices) fail("Embree has no memory for mesh " + std::to_string(m));
        std::memcpy(vertices, mesh.positions, mesh.vertex_count * 12);
        std::memcpy(indices, mesh.indices, mesh.triangle_count * 12);
        rtcCommitGeometry(geometry);
        rtcAttachGeometryByID(scene, geometry, unsigned(m));
        rtcReleaseGeometry(geometry);
    }
    rtcCommitScene(scene);
    return scene;
}

void load_scene(Scene &s, const std::string &name, uint32_t isa) {
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.isa = isa;
    check(bk_device_create(&desc, &s.device));
    check(bk_scene_create(s.device, &s.scene));
    const bool file = name.find('.') != std::string::npos;
    check(file ? bk_scene_load_file(s.scene, name.c_str(), nullptr) : bk_scene_load_builtin(s.scene, name.c_str()));
    check(bk_scene_commit(s.scene, nullptr, nullptr));

    float lower[3], upper[3];
    check(bk_scene_bounds(s.scene, lower, upper));
    s.center = (load(lower) + load(upper)) * 0.5;
    s.diagonal = length(load(upper) - load(lower));
    double sum = 0;
    for (uint32_t m = 0; m < bk_scene_mesh_count(s.scene); m++) {
        bk_mesh_view view;
        bk_mesh_view_init(&view);
        check(bk_scene_mesh_geometry(s.scene, m, &view));
        s.meshes.push_back(view);
        for (uint32_t t = 0; t < view.triangle_count; t++) {
            const Vec3d a = load(s.vertex(m, t, 0)), b = load(s.vertex(m, t, 1)), c = load(s.vertex(m, t, 2));
            const double area = 0.5 * length(cross(b - a, c - a));
            if (!(area > 0) || !std::isfinite(area)) continue;
            sum += area;
            s.triangles.emplace_back(m, t);
            s.area_sums.push_back(sum);
        }
    }

    s.embree = rtcNewDevice("threads=1");
    if (!s.embree) fail("Embree starts no device");
    s.with_default = embree_scene(s, RTC_SCENE_FLAG_NONE);
    s.with_robust = embree_scene(s, RTC_SCENE_FLAG_ROBUST);
    if (rtcGetDeviceError(s.embree) != RTC_ERROR_NONE) fail("Embree cannot build the scene");
}

// ---------------------------------------------------------------------------------------------
// Random points and directions.

class Random {
  public:
    explicit Random(uint64_t seed) : engine(seed) {}
    double uniform() { return double(engine() >> 11) * 0x1p-53; }

    struct Point {
        Vec3d position, normal;
    };
    // Uniform over the area of all triangles, with the facing normal.
    Point on_surface(const Scene &s) {
        const double at = uniform() * s.area_sums.back();
        size_t i = size_t(std::upper_bound(s.area_sums.begin(), s.area_sums.end(), at) - s.area_sums.begin());
        i = std::min(i, s.triangles.size() - 1);
        const auto [mesh, triangle] = s.triangles[i];
        const Vec3d a = load(s.vertex(mesh, triangle, 0));
        const Vec3d ab = load(s.vertex(mesh, triangle, 1)) - a, ac = load(s.vertex(mesh, triangle, 2)) - a;
        double u = uniform(), v = uniform();
        if (u + v > 1) u = 1 - u, v = 1 - v;
        return {a + ab * u + ac * v, unit(cross(ab, ac))};
    }

  private:
    std::mt19937_64 engine;
};

const double PI = 3.14159265358979323846;

// From z up to n up, turned by `turn` around it (Duff et al. 2017).
Vec3d around(Vec3d n, Vec3d d, double turn) {
    const double sign = std::copysign(1.0, n.z), a = -1 / (sign + n.z), b = n.x * n.y * a;
    const Vec3d s{1 + sign * n.x * n.x * a, sign * b, -sign * n.x}, t{b, sign + n.y * n.y * a, -n.y};
    const double cs = std::cos(turn), sn = std::sin(turn);
    return s * (d.x * cs - d.y * sn) + t * (d.x * sn + d.y * cs) + n * d.z;
}

Vec3d uniform_hemisphere(double u, double v) {
    const double r = std::sqrt(std::max(0.0, 1 - u * u));
    return {r * std::cos(2 * PI * v), r * std::sin(2 * PI * v), u};
}

Vec3d cosine_hemisphere(double u, double v) {
    const double r = std::sqrt(u);
    return {r * std::cos(2 * PI * v), r * std::sin(2 * PI * v), std::sqrt(1 - u)};
}

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
    const char *name;
    EmbreeRun run;
};

std::atomic<unsigned> sink{0}; // keeps results alive

RTCIntersectContext context(RTCIntersectContextFlags flags) {
    RTCIntersectContext c;
    rtcInitIntersectContext(&c);
    c.flags = flags;
    return c;
}

alignas(64) const int ALL_VALID[16] = {-1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1};

Way intersect1(const Rays &rays) {
    return {"rtcIntersect1", [&rays](RTCScene scene, size_t begin, size_t end) {
                RTCIntersectContext c = context(RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
                unsigned sum = 0;
                for (size_t i = begin; i < end; i++) {
                    RTCRayHit h;
                    h.ray = rays.ones[i];
                    h.hit.geomID = h.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
                    rtcIntersect1(scene, &c, &h);
                    sum += h.hit.primID ^ h.hit.geomID;
                }
                sink += sum;
            }};
}

Way intersect16(const Rays &rays, bool coherent) {
    return {coherent ? "rtcIntersect16 coherent" : "rtcIntersect16 incoherent",
            [&rays, coherent](RTCScene scene, size_t begin, size_t end) {
                RTCIntersectContext c = context(coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT
                                                         : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
                unsigned sum = 0;
                for (size_t i = begin / 16; i < end / 16; i++) {
                    RTCRayHit16 h;
                    h.ray = rays.sixteens[i];
                    std::memset(h.hit.geomID, 0xff, sizeof h.hit.geomID);
                    std::memset(h.hit.instID, 0xff, sizeof h.hit.instID);
                    rtcIntersect16(ALL_VALID, scene, &c, &h);
                    sum += h.hit.primID[0] ^ h.hit.geomID[15];
                }
                sink += sum;
            }};
}

const size_t STREAM = 256;

// Streams of `length` rays, at most STREAM.
Way intersect_stream(const Rays &rays, size_t length, bool coherent) {
    return {coherent ? "rtcIntersect1M coherent" : "rtcIntersect1M incoherent",
            [&rays, length, coherent](RTCScene scene, size_t begin, size_t end) {
                RTCIntersectContext c = context(coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT
                                                         : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
                unsigned sum = 0;
                RTCRayHit h[STREAM];
                for (size_t i = begin; i < end; i += length) {
                    for (size_t k = 0; k < length; k++) {
                        h[k].ray = rays.ones[i + k];
                        h[k].hit.geomID = h[k].hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
                    }
                    rtcIntersect1M(scene, &c, h, unsigned(length), sizeof(RTCRayHit));
                    sum += h[0].hit.primID ^ h[length - 1].hit.geomID;
                }
                sink += sum;
            }};
}

Way occluded1(const Rays &rays) {
    return {"rtcOccluded1", [&rays](RTCScene scene, size_t begin, size_t end) {
                RTCIntersectContext c = context(RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
                unsigned sum = 0;
                for (size_t i = begin; i < end; i++) {
                    RTCRay r = rays.ones[i];
                    rtcOccluded1(scene, &c, &r);
                    sum += r.tfar < 0;
                }
                sink += sum;
            }};
}

Way occluded16(const Rays &rays, bool coherent) {
    return {coherent ? "rtcOccluded16 coherent" : "rtcOccluded16 incoherent",
            [&rays, coherent](RTCScene scene, size_t begin, size_t end) {
                RTCIntersectContext c = context(coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT
                                                         : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
                unsigned sum = 0;
                for (size_t i = begin / 16; i < end / 16; i++) {
                    RTCRay16 r = rays.sixteens[i];
                    rtcOccluded16(ALL_VALID, scene, &c, &r);
                    sum += (r.tfar[0] < 0) + (r.tfar[15] < 0);
                }
                sink += sum;
            }};
}

// ---------------------------------------------------------------------------------------------
// The kinds of rays.

struct Kind {
    const char *name;
    size_t unit; // rays that belong together
    bool occlusion;
    Rays rays;
    std::vector<bk_hit> hits;      // ours
    std::vector<uint8_t> occluded; // ours
    Run ours;
    std::vector<Way> ways;
};

// Random points on random triangles, uniform directions about the facing normal (thesis 4.1.2).
void random_incoherent(Kind &k, const Scene &s, size_t count, Random &random) {
    const float epsilon = float(1e-5 * s.diagonal);
    for (size_t i = 0; i < count; i++) {
        const Random::Point p = random.on_surface(s);
        const Vec3d d = uniform_hemisphere(random.uniform(), random.uniform());
        k.rays.add(p.position, epsilon, around(p.normal, d, 0), INF);
    }
    k.rays.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        check(bk_intersect_many(s.scene, &k.rays.rays[begin], end - begin, 0, &k.hits[begin]));
    };
    k.ways = {intersect1(k.rays), intersect16(k.rays, false), intersect_stream(k.rays, STREAM, false)};
}

// Texel-like origins, just off the surface; one set of cosine-distributed directions, turned for each.
void gather(Kind &k, const Scene &s, size_t count, Random &random) {
    std::vector<Vec3d> set;
    for (size_t i = 0; i < k.unit; i++) {
        // A rank-1 lattice: stratified, as a baker's samples are.
        const double v = double(i) * 0.6180339887498949;
        set.push_back(cosine_hemisphere((double(i) + 0.5) / double(k.unit), v - std::floor(v)));
    }
    for (size_t i = 0; i < count; i += k.unit) {
        const Random::Point p = random.on_surface(s);
        const Vec3d origin = p.position + p.normal * (1e-4 * s.diagonal);
        const double turn = 2 * PI * random.uniform();
        for (const Vec3d &d : set) k.rays.add(origin, 0, around(p.normal, d, turn), INF);
    }
    k.rays.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        for (size_t i = begin; i < end; i += k.unit) {
            check(bk_gather(s.scene, k.rays.rays[i].origin, &k.rays.directions[3 * i], k.unit, INF, 0, &k.hits[i]));
        }
    };
    k.ways = {intersect1(k.rays), intersect16(k.rays, true), intersect16(k.rays, false),
              intersect_stream(k.rays, k.unit, true), intersect_stream(k.rays, k.unit, false)};
}

// A pinhole camera, 90 degrees, square, in tiles of 4 x 4 pixels.
void camera_rays(Rays &rays, Vec3d eye, Vec3d toward, size_t side) {
    const Vec3d z = unit(toward);
    const Vec3d up = std::abs(z.z) < 0.9 ? Vec3d{0, 0, 1} : Vec3d{0, 1, 0};
    const Vec3d x = unit(cross(z, up)), y = cross(x, z);
    for (size_t ty = 0; ty < side; ty += 4) {
        for (size_t tx = 0; tx < side; tx += 4) {
            for (size_t p = 0; p < 16; p++) {
                const double px = 2 * (double(tx + p % 4) + 0.5) / double(side) - 1;
                const double py = 2 * (double(ty + p / 4) + 0.5) / double(side) - 1;
                rays.add(eye, 0, z + x * px + y * py, INF);
            }
        }
    }
}

// From the point, of some tries off the surface, that sees the most of the scene.
void primary(Kind &k, const Scene &s, size_t count, Random &random) {
    Vec3d best_eye{}, best_toward{};
    double best = -1;
    for (int tries = 0; tries < 64; tries++) {
        const Random::Point p = random.on_surface(s);
        const Vec3d eye = p.position + p.normal * (0.02 * s.diagonal), toward = s.center - eye;
        if (!(length(toward) > 0.01 * s.diagonal)) continue;
        Rays few;
        camera_rays(few, eye, toward, 16);
        std::vector<bk_hit> hits(few.rays.size());
        check(bk_intersect_many(s.scene, few.rays.data(), hits.size(), 0, hits.data()));
        double score = 0;
        for (const bk_hit &h : hits) {
            if (h.triangle != BK_NONE) score += std::min(1.0, h.t / (0.1 * s.diagonal));
        }
        if (score > best) best = score, best_eye = eye, best_toward = toward;
    }
    // A square picture of about `count` pixels.
    const size_t side = std::max<size_t>(16, size_t(std::sqrt(double(count))) / 16 * 16);
    camera_rays(k.rays, best_eye, best_toward, side);
    k.rays.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        check(bk_intersect_many(s.scene, &k.rays.rays[begin], end - begin, BK_RAYS_COHERENT, &k.hits[begin]));
    };
    k.ways = {intersect1(k.rays), intersect16(k.rays, true), intersect_stream(k.rays, STREAM, true)};
}

// Segments between random points, both just off their surfaces.
void occlusion(Kind &k, const Scene &s, size_t count, Random &random) {
    for (size_t i = 0; i < count; i++) {
        const Random::Point p = random.on_surface(s), q = random.on_surface(s);
        const double off = 1e-4 * s.diagonal;
        const Vec3d a = p.position + p.normal * off, b = q.position + q.normal * off;
        k.rays.add(a, 0, b - a, 1.0f - 1e-4f);
    }
    k.rays.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        check(bk_occluded_many(s.scene, &k.rays.rays[begin], end - begin, 0, &k.occluded[begin]));
    };
    k.ways = {occluded1(k.rays), occluded16(k.rays, true), occluded16(k.rays, false)};
}

// ---------------------------------------------------------------------------------------------
// Timing.

double seconds(const Run &run, size_t count, size_t unit, unsigned threads) {
    using Clock = std::chrono::steady_clock;
    if (threads == 1) {
        const auto start = Clock::now();
        run(0, count);
        return std::chrono::duration<double>(Clock::now() - start).count();
    }
    std::atomic<unsigned> ready{0};
    std::atomic<bool> go{false};
    std::vector<std::thread> workers;
    const size_t units = count / unit;
    for (unsigned t = 0; t < threads; t++) {
        workers.emplace_back([&, t] {
            flush_denormals();
            ready++;
            while (!go) std::this_thread::yield();
            run(units * t / threads * unit, units * (t + 1) / threads * unit);
        });
    }
    while (ready < threads) std::this_thread::yield();
    const auto start = Clock::now();
    go = true;
    for (std::thread &w : workers) w.join();
    return std::chrono::duration<double>(Clock::now() - start).count();
}

double median(std::vector<double> v) {
    std::sort(v.begin(), v.end());
    return v.empty() ? 0 : 0.5 * (v[(v.size() - 1) / 2] + v[v.size() / 2]);
}

struct Rate {
    double mrays = 0, ratio = 0;
};

// Alternating pairs of ours and one of Embree's ways; adds our times to `ours`.
Rate compare(const Kind &k, const EmbreeRun &way, RTCScene scene, unsigned threads, unsigned pairs,
             std::vector<double> &ours) {
    const size_t count = k.rays.rays.size();
    const Run theirs = [&](size_t begin, size_t end) { way(scene, begin, end); };
    std::vector<double> times, ratios;
    for (unsigned p = 0; p < pairs; p++) {
        const double a = seconds(k.ours, count, k.unit, threads), b = seconds(theirs, count, k.unit, threads);
        ours.push_back(a);
        times.push_back(b);
        ratios.push_back(b / a);
    }
    return {double(count) / median(times) * 1e-6, median(ratios)};
}

// ---------------------------------------------------------------------------------------------
// Disagreements.

struct Hit {
    bool hit;
    float t;
    uint32_t mesh, triangle;
};

// What extended precision says about a ray and one triangle (Moeller and Trumbore 1997).
struct Verdict {
    enum { Misses, Grazes, Hits } answer;
    Exact t, tolerance; // where the ray meets the plane, and how far rounding may shift that
};

// Rounding errors of float vertices and origins, taken relative to their magnitude: a few units in
// the last place (6e-8).
const Exact ROUNDING = 1e-6L;

Verdict judge(const Scene &s, const bk_ray &ray, uint32_t mesh, uint32_t triangle) {
    const Vec3x o = exact(ray.origin), d = exact(ray.direction);
    Vec3x v[3];
    Exact scale = largest(o);
    for (int c = 0; c < 3; c++) {
        v[c] = exact(s.vertex(mesh, triangle, c));
        scale = std::max(scale, largest(v[c]));
        v[c] = v[c] - o;
    }
    const Exact shift = ROUNDING * scale, speed = length(d);
    const Vec3x n = cross(v[1] - v[0], v[2] - v[0]);
    const Exact nn = length(n), dn = dot(n, d);
    if (nn == 0 || dn == 0) return {Verdict::Grazes, 0, std::numeric_limits<Exact>::infinity()};
    const Exact t = dot(n, v[0]) / dn;
    const Exact tolerance = std::abs(t) * 1e-5L + shift * nn / std::abs(dn);
    // Signed distances of the ray's line from the lines of the edges, positive inside.
    Exact inside = std::numeric_limits<Exact>::infinity();
    for (int c = 0; c < 3; c++) {
        const Vec3x a = v[c], b = v[(c + 1) % 3], across = cross(d, b - a);
        const Exact w = length(across);
        // Seen edge on, the ray passes along the edge: no line to be on one side of.
        const Exact distance = w == 0 ? 0 : dot(across, a) / w;
        inside = std::min(inside, dn > 0 ? -distance : distance);
    }
    const Exact early = t - Exact(ray.tmin), late = Exact(ray.tmax) - t;
    if (inside < -shift || early < -tolerance || late < -tolerance) return {Verdict::Misses, t, tolerance};
    // The end of the range and edges: too close to call. A plane seen almost edge on, likewise.
    const bool sure = inside > shift && early > tolerance && late > tolerance && std::abs(dn) > 1e-6L * nn * speed;
    return {sure ? Verdict::Hits : Verdict::Grazes, t, tolerance};
}

enum Class { Agree, SameT, Grazing, Theirs, Real };

// Which of two answers is right, by judging the triangles that they name.
Class classify(const Scene &s, const bk_ray &ray, const Hit &ours, const Hit &theirs) {
    if (!ours.hit && !theirs.hit) return Agree;
    if (ours.hit && theirs.hit && ours.mesh == theirs.mesh && ours.triangle == theirs.triangle) {
        const Verdict v = judge(s, ray, ours.mesh, ours.triangle);
        if (std::abs(Exact(ours.t) - v.t) <= v.tolerance) return Agree;
        return std::abs(Exact(theirs.t) - v.t) <= v.tolerance ? Real : Grazing;
    }
    const Verdict none{Verdict::Misses, INF, 0};
    const Verdict a = ours.hit ? judge(s, ray, ours.mesh, ours.triangle) : none;
    const Verdict b = theirs.hit ? judge(s, ray, theirs.mesh, theirs.triangle) : none;
    if (ours.hit && theirs.hit && std::abs(a.t - b.t) <= std::max(a.tolerance, b.tolerance)) {
        const bool a_ok = a.answer != Verdict::Misses, b_ok = b.answer != Verdict::Misses;
        return a_ok ? SameT : b_ok ? Real : Grazing;
    }
    if (ours.hit && a.answer == Verdict::Misses) return Real;
    if (theirs.hit && b.answer == Verdict::Misses) return Theirs;
    // Both name what the ray may well hit: the nearer one should have won.
    const bool ours_nearer = ours.hit && (!theirs.hit || a.t < b.t);
    const Verdict &nearer = ours_nearer ? a : b;
    if (nearer.answer == Verdict::Grazes) return Grazing;
    return ours_nearer ? Theirs : Real;
}

Hit embree_hit(RTCScene scene, const RTCRay &ray) {
    RTCIntersectContext c = context(RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
    RTCRayHit h;
    h.ray = ray;
    h.hit.geomID = h.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
    rtcIntersect1(scene, &c, &h);
    return {h.hit.geomID != RTC_INVALID_GEOMETRY_ID, h.ray.tfar, h.hit.geomID, h.hit.primID};
}

Hit our_hit(const bk_hit &h) { return {h.triangle != BK_NONE, h.t, h.mesh, h.triangle}; }

void print_real(const Kind &k, size_t i, const Hit &ours, const Hit &theirs) {
    const bk_ray &r = k.rays.rays[i];
    std::printf("real disagreement, %s ray %zu: origin {%a, %a, %a} tmin %a direction {%a, %a, %a} tmax %a\n", k.name, i,
                double(r.origin[0]), double(r.origin[1]), double(r.origin[2]), double(r.tmin), double(r.direction[0]),
                double(r.direction[1]), double(r.direction[2]), double(r.tmax));
    for (const auto &[name, h] : {std::make_pair("ours", ours), std::make_pair("Embree's", theirs)}) {
        if (h.hit) {
            std::printf("  %s: mesh %u triangle %u t %a\n", name, h.mesh, h.triangle, double(h.t));
        } else {
            std::printf("  %s: miss\n", name);
        }
    }
}

struct Counts {
    size_t hits = 0, misses = 0, of[5] = {};
};

const size_t MAX_PRINTED = 10;

Counts verify(const Kind &k, const Scene &s) {
    Counts counts;
    for (size_t i = 0; i < k.rays.rays.size(); i++) {
        const bk_ray &ray = k.rays.rays[i];
        Hit ours, theirs;
        if (k.occlusion) {
            RTCIntersectContext c = context(RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
            RTCRay r = k.rays.ones[i];
            rtcOccluded1(s.with_robust, &c, &r);
            const bool occluded = k.occluded[i] != 0, embree_occluded = r.tfar < 0;
            ++(occluded ? counts.hits : counts.misses);
            if (occluded == embree_occluded) {
                counts.of[Agree]++;
                continue;
            }
            // Either side's culprit is its closest hit.
            bk_hit h;
            bk_intersect(s.scene, &ray, &h);
            ours = our_hit(h);
            theirs = embree_hit(s.with_robust, k.rays.ones[i]);
            if (ours.hit != occluded || theirs.hit != embree_occluded || ours.hit == theirs.hit) {
                // A side contradicts itself: judge whichever hit there is.
                const Hit any = ours.hit ? ours : theirs;
                const Hit none{false, INF, BK_NONE, BK_NONE};
                ours = occluded ? any : none;
                theirs = occluded ? none : any;
            }
        } else {
            ours = our_hit(k.hits[i]);
            theirs = embree_hit(s.with_robust, k.rays.ones[i]);
            ++(ours.hit ? counts.hits : counts.misses);
        }
        const Class c = classify(s, ray, ours, theirs);
        counts.of[c]++;
        if (c == Real && counts.of[Real] <= MAX_PRINTED) print_real(k, i, ours, theirs);
    }
    return counts;
}

// ---------------------------------------------------------------------------------------------
// The command line and the table.

struct Options {
    std::string scene, csv;
    size_t rays = 500000;
    unsigned threads = 1, pairs = 5;
    uint64_t seed = 1;
    uint32_t isa = BK_ISA_AUTO;
};

const char *const ISA_NAMES[] = {"auto", "portable", "avx2", "avx512"};

unsigned long number(const char *text, const char *option, unsigned long low, unsigned long high) {
    char *end = nullptr;
    const unsigned long value = std::strtoul(text, &end, 10);
    if (*text < '0' || *text > '9' || *end || value < low || value > high) {
        fail(std::string(option) + " wants a number from " + std::to_string(low) + " to " + std::to_string(high) +
             ", not " + text);
    }
    return value;
}

Options parse(int argc, char **argv) {
    const char *usage =
        "usage: embree_compare SCENE [--rays N] [--threads T] [--isa NAME] [--csv FILE] [--pairs P] [--seed S]";
    Options o;
    for (int i = 1; i < argc; i++) {
        const std::string arg = argv[i];
        if (arg.compare(0, 2, "--") != 0) {
            if (!o.scene.empty()) fail(usage);
            o.scene = arg;
            continue;
        }
        if (i + 1 == argc) fail(arg == "--help" ? usage : arg + " wants a value");
        const char *value = argv[++i];
        if (arg == "--rays") {
            o.rays = number(value, "--rays", 256, 100000000);
        } else if (arg == "--threads") {
            o.threads = unsigned(number(value, "--threads", 1, 1024));
        } else if (arg == "--pairs") {
            o.pairs = unsigned(number(value, "--pairs", 1, 1000));
        } else if (arg == "--seed") {
            o.seed = number(value, "--seed", 0, ~0ul);
        } else if (arg == "--csv") {
            o.csv = value;
        } else if (arg == "--isa") {
            const auto found = std::find(std::begin(ISA_NAMES), std::end(ISA_NAMES), std::string(value));
            if (found == std::end(ISA_NAMES)) fail(std::string("--isa wants portable, avx2 or avx512, not ") + value);
            o.isa = uint32_t(found - std::begin(ISA_NAMES));
        } else {
            fail("there is no option " + arg);
        }
    }
    if (o.scene.empty()) fail(usage);
    return o;
}

const char *const CSV_HEAD = "scene,isa,threads,kind,rays,hits,misses,ours_mrays_per_s,embree_way,embree_mode,"
                             "embree_mrays_per_s,ratio,same_t,grazing,theirs,real\n";

// Runs one kind of ray, prints its rows and returns its real disagreements.
size_t run_kind(Kind &k, const Scene &s, const Options &o, std::ofstream &csv) {
    const size_t count = k.rays.rays.size();
    k.hits.resize(k.occlusion ? 0 : count);
    k.occluded.resize(k.occlusion ? count : 0);
    k.ours(0, count);
    const Counts counts = verify(k, s);

    std::vector<double> our_times;
    std::vector<Rate> rates[2];
    for (const Way &way : k.ways) {
        rates[0].push_back(compare(k, way.run, s.with_default, o.threads, o.pairs, our_times));
        rates[1].push_back(compare(k, way.run, s.with_robust, o.threads, o.pairs, our_times));
    }
    const double ours = double(count) / median(our_times) * 1e-6;

    std::printf("%-17s  %8zu rays, %zu hits, %zu misses; disagreements: %zu same t, %zu grazing, %zu theirs, %zu real\n",
                k.name, count, counts.hits, counts.misses, counts.of[SameT], counts.of[Grazing], counts.of[Theirs],
                counts.of[Real]);
    // Right between points of a convex room, a mistake elsewhere.
    if (counts.hits == 0) std::printf("  NONE OF THESE RAYS HITS ANYTHING\n");
    std::printf("  %-26s %8.3f\n", "bakelite", ours);
    double least[2] = {INF, INF};
    for (size_t w = 0; w < k.ways.size(); w++) {
        const Rate &a = rates[0][w], &b = rates[1][w];
        std::printf("  %-26s %8.3f %7.2fx   %8.3f %7.2fx\n", k.ways[w].name, a.mrays, a.ratio, b.mrays, b.ratio);
        for (int mode = 0; mode < 2; mode++) {
            const Rate &r = rates[mode][w];
            least[mode] = std::min(least[mode], r.ratio);
            if (!csv.is_open()) continue;
            csv << o.scene << ',' << ISA_NAMES[bk_device_isa(s.device)] << ',' << o.threads << ',' << k.name << ','
                << count << ',' << counts.hits << ',' << counts.misses << ',' << ours << ',' << k.ways[w].name << ','
                << (mode ? "robust" : "default") << ',' << r.mrays << ',' << r.ratio << ',' << counts.of[SameT] << ','
                << counts.of[Grazing] << ',' << counts.of[Theirs] << ',' << counts.of[Real] << '\n';
        }
    }
    std::printf("  %-26s %8s %7.2fx   %8s %7.2fx\n\n", "against the best of them", "", least[0], "", least[1]);
    std::fflush(stdout);
    return counts.of[Real];
}

} // namespace

int main(int argc, char **argv) {
    const Options o = parse(argc, argv);
    flush_denormals();
    Scene s;
    load_scene(s, o.scene, o.isa);
    std::ofstream csv;
    if (!o.csv.empty()) {
        csv.open(o.csv);
        csv << CSV_HEAD;
        if (!csv) fail("cannot write " + o.csv);
    }

    struct bk_scene_stats stats;
    bk_scene_stats_init(&stats);
    check(bk_scene_stats(s.scene, &stats));
    const long version = long(rtcGetDeviceProperty(s.embree, RTC_DEVICE_PROPERTY_VERSION));
    std::printf("%s: %llu triangles (%llu degenerate), Bakelite %s, Embree %ld.%ld.%ld, %u thread%s, %u pairs\n",
                o.scene.c_str(), static_cast<unsigned long long>(stats.triangles),
                static_cast<unsigned long long>(stats.skipped_degenerate), ISA_NAMES[bk_device_isa(s.device)],
                version / 10000, version / 100 % 100, version % 100, o.threads, o.threads == 1 ? "" : "s", o.pairs);
    std::printf("  %-26s %17s   %17s\n", "Mrays/s, ours / Embree's", "Embree default", "Embree robust");

    struct {
        const char *name;
        size_t unit;
        bool occlusion;
        void (*make)(Kind &, const Scene &, size_t, Random &);
    } const kinds[] = {
        {"random-incoherent", STREAM, false, random_incoherent},
        {"gather32", 32, false, gather},
        {"gather256", 256, false, gather},
        {"primary", STREAM, false, primary},
        {"occluded", 16, true, occlusion},
    };
    size_t real = 0;
    uint64_t seed = o.seed;
    for (const auto &kind : kinds) {
        Kind k;
        k.name = kind.name;
        k.unit = kind.unit;
        k.occlusion = kind.occlusion;
        Random random(seed++);
        kind.make(k, s, o.rays / STREAM * STREAM, random);
        real += run_kind(k, s, o, csv);
    }
    if (real) std::printf("%zu real disagreements\n", real);
    return real ? 1 : 0;
}
