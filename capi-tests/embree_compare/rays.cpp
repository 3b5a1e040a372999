#include "rays.h"

#include <atomic>
#include <random>

RTCIntersectContext context(RTCIntersectContextFlags flags) {
    RTCIntersectContext c;
    rtcInitIntersectContext(&c);
    c.flags = flags;
    return c;
}

namespace {

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
// The ways of Embree.

std::atomic<unsigned> sink{0}; // keeps results alive

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
                RTCIntersectContext c =
                    context(coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
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

// Streams of `length` rays, at most STREAM.
Way intersect_stream(const Rays &rays, size_t length, bool coherent) {
    return {coherent ? "rtcIntersect1M coherent" : "rtcIntersect1M incoherent",
            [&rays, length, coherent](RTCScene scene, size_t begin, size_t end) {
                RTCIntersectContext c =
                    context(coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
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
                RTCIntersectContext c =
                    context(coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
                unsigned sum = 0;
                for (size_t i = begin / 16; i < end / 16; i++) {
                    RTCRay16 r = rays.sixteens[i];
                    rtcOccluded16(ALL_VALID, scene, &c, &r);
                    sum += (r.tfar[0] < 0) + (r.tfar[15] < 0);
                }
                sink += sum;
            }};
}

// Not in packets through instances: in Sponza as one instance rtcOccluded16 did not come back within minutes (3.13.5).
std::vector<Way> occlusion_ways(const Kind &k, const Scene &s) {
    if (!s.places.empty()) return {occluded1(k.rays)};
    return {occluded1(k.rays), occluded16(k.rays, true), occluded16(k.rays, false)};
}

// ---------------------------------------------------------------------------------------------
// The kinds.

// 1, or -1 if most rays from the facing side of surfaces miss and fewer do from the other: of a closed thing in the
// open, rays inside it are of use, rays into the sky are not.
double busier_side(const Scene &s, Random random) {
    std::vector<bk_ray> rays[2];
    const float epsilon = float(1e-5 * s.diagonal);
    for (int i = 0; i < 1000; i++) {
        const Random::Point p = random.on_surface(s);
        const Vec3d d = around(p.normal, uniform_hemisphere(random.uniform(), random.uniform()), 0);
        for (const double side : {1.0, -1.0}) {
            bk_ray r;
            store(p.position, r.origin);
            store(d * side, r.direction);
            r.tmin = epsilon;
            r.tmax = INF;
            rays[side < 0].push_back(r);
        }
    }
    size_t hits[2];
    for (int side = 0; side < 2; side++) {
        std::vector<uint8_t> hit(rays[side].size());
        check(bk_occluded_many(s.scene, rays[side].data(), hit.size(), 0, hit.data()));
        hits[side] = size_t(std::count(hit.begin(), hit.end(), 1));
    }
    return 2 * hits[0] < rays[0].size() && hits[1] > hits[0] ? -1 : 1;
}

// Random points on random triangles, uniform directions about the facing normal (thesis 4.1.2).
void random_incoherent(Kind &k, const Scene &s, size_t count, Random &random) {
    const float epsilon = float(1e-5 * s.diagonal);
    const double side = busier_side(s, random);
    for (size_t i = 0; i < count; i++) {
        const Random::Point p = random.on_surface(s);
        const Vec3d d = uniform_hemisphere(random.uniform(), random.uniform());
        k.rays.add(p.position, epsilon, around(p.normal * side, d, 0), INF);
    }
    k.rays.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        check(bk_intersect_many(s.scene, &k.rays.rays[begin], end - begin, 0, &k.hits[begin]));
    };
    k.ways = {intersect1(k.rays), intersect16(k.rays, false), intersect_stream(k.rays, STREAM, false)};
}

// The same, by one call per ray: for programs that know one ray at a time.
void one_by_one(Kind &k, const Scene &s, size_t count, Random &random) {
    random_incoherent(k, s, count, random);
    k.ours = [&k, &s](size_t begin, size_t end) {
        for (size_t i = begin; i < end; i++) bk_intersect(s.scene, &k.rays.rays[i], &k.hits[i]);
    };
    k.ways = {intersect1(k.rays)};
}

// Texel-like origins, just off the surface; one set of cosine-distributed directions, turned for each.
void gather(Kind &k, const Scene &s, size_t count, Random &random) {
    std::vector<Vec3d> set;
    for (size_t i = 0; i < k.unit; i++) {
        // A rank-1 lattice: stratified, as a baker's samples are.
        const double v = double(i) * 0.6180339887498949;
        set.push_back(cosine_hemisphere((double(i) + 0.5) / double(k.unit), v - std::floor(v)));
    }
    const double side = busier_side(s, random);
    for (size_t i = 0; i < count; i += k.unit) {
        const Random::Point p = random.on_surface(s);
        const Vec3d n = p.normal * side, origin = p.position + n * (1e-4 * s.diagonal);
        const double turn = 2 * PI * random.uniform();
        for (const Vec3d &d : set) k.rays.add(origin, 0, around(n, d, turn), INF);
    }
    k.rays.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        for (size_t i = begin; i < end; i += k.unit) {
            check(bk_gather(s.scene, k.rays.rays[i].origin, &k.rays.directions[3 * i], k.unit, INF, 0, &k.hits[i]));
        }
    };
    k.ways = {intersect1(k.rays), intersect16(k.rays, true), intersect16(k.rays, false),
              intersect_stream(k.rays, std::min(k.unit, STREAM), true),
              intersect_stream(k.rays, std::min(k.unit, STREAM), false)};
}

// Calls place(origin, n) for the texels of a square tile around a random point, n its facing normal. Texels are 12 cm
// apart in a scene of the size of Sponza.
template <typename Place> void tile(const Scene &s, size_t texels, double side, Random &random, const Place &place) {
    const Random::Point p = random.on_surface(s);
    const Vec3d n = p.normal * side, first = p.position + n * (1e-4 * s.diagonal);
    const Vec3d x = around(n, {1, 0, 0}, 0), y = around(n, {0, 1, 0}, 0);
    const double spacing = 0.12 * std::sqrt(s.area_sums.back() / 7000);
    for (size_t j = 0; j < texels; j++) {
        for (size_t i = 0; i < texels; i++) place(first + x * (spacing * double(i)) + y * (spacing * double(j)), n);
    }
}

// Octant, longest axis and place of a direction on a curve through the cells of a cube's face: rays that follow one another
// go alike.
uint32_t direction_key(const bk_ray &r) {
    const float *d = r.direction;
    const size_t a = std::abs(d[0]) > std::abs(d[1]) ? (std::abs(d[0]) > std::abs(d[2]) ? 0 : 2)
                                                     : (std::abs(d[1]) > std::abs(d[2]) ? 1 : 2);
    uint32_t key = 0;
    for (size_t i = 0; i < 3; i++) key |= uint32_t(d[i] < 0) << i;
    key = key * 3 + uint32_t(a);
    const float u = std::abs(d[(a + 1) % 3] / d[a]), v = std::abs(d[(a + 2) % 3] / d[a]);
    const auto cell = [](float x) { return std::min(255u, uint32_t(x * 256)); };
    for (int bit = 7; bit >= 0; bit--) key = key << 2 | (cell(u) >> bit & 1) << 1 | (cell(v) >> bit & 1);
    return key;
}

// Gather rays of tiles of 8 x 8 texels, 64 rays each: what a baker traces. Each texel turns the set of directions. Three
// quarters of a tile's rays hit something, if there are such places.
void tiles(Kind &k, const Scene &s, size_t count, Random &random) {
    const size_t per_texel = k.unit / 64;
    const double side = busier_side(s, random);
    std::vector<uint8_t> hit(k.unit);
    for (size_t made = 0, tries = 0; made < count; tries++) {
        tile(s, 8, side, random, [&](Vec3d origin, Vec3d n) {
            const double turn = 2 * PI * random.uniform(), shift = random.uniform();
            for (size_t i = 0; i < per_texel; i++) {
                const double v = double(i) * 0.6180339887498949 + shift;
                const Vec3d d = cosine_hemisphere((double(i) + 0.5) / double(per_texel), v - std::floor(v));
                k.rays.add(origin, 0, around(n, d, turn), INF);
            }
        });
        // In rooms, where somebody sees the light: not on roofs, whose rays miss.
        check(bk_occluded_many(s.scene, &k.rays.rays[made], k.unit, 0, hit.data()));
        const size_t hits = size_t(std::count(hit.begin(), hit.end(), 1));
        if (4 * hits >= 3 * k.unit || tries > 20 * (count / k.unit)) {
            made += k.unit;
        } else {
            k.rays.rays.resize(made);
        }
    }
    k.rays.finish();
    k.sorted.rays = k.rays.rays;
    for (auto unit = k.sorted.rays.begin(); unit < k.sorted.rays.end(); unit += long(k.unit)) {
        std::stable_sort(unit, unit + long(k.unit), [](const bk_ray &a, const bk_ray &b) {
            return direction_key(a) < direction_key(b);
        });
    }
    k.sorted.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        for (size_t i = begin; i < end; i += k.unit) {
            check(bk_intersect_many(s.scene, &k.rays.rays[i], k.unit, 0, &k.hits[i]));
        }
    };
    k.ways = {intersect1(k.rays), intersect16(k.rays, true), intersect16(k.rays, false),
              intersect_stream(k.rays, STREAM, false)};
    for (Way way : {intersect1(k.sorted), intersect16(k.sorted, true), intersect16(k.sorted, false),
                    intersect_stream(k.sorted, STREAM, true)}) {
        way.name += ", sorted";
        k.ways.push_back(way);
    }
}

// Shadow rays of tiles of 16 x 16 texels to a point some way off another surface.
void tiles_to_lamp(Kind &k, const Scene &s, size_t count, Random &random) {
    const double side = busier_side(s, random);
    while (k.rays.rays.size() < count) {
        const Random::Point p = random.on_surface(s);
        const Vec3d lamp = p.position + p.normal * (side * 0.02 * s.diagonal);
        tile(s, 16, side, random, [&](Vec3d origin, Vec3d) { k.rays.add(origin, 0, lamp - origin, 1); });
    }
    k.rays.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        for (size_t i = begin; i < end; i += k.unit) {
            check(bk_occluded_many(s.scene, &k.rays.rays[i], k.unit, 0, &k.occluded[i]));
        }
    };
    k.ways = occlusion_ways(k, s);
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
        check(bk_intersect_many(s.scene, &k.rays.rays[begin], end - begin, 0, &k.hits[begin]));
    };
    k.ways = {intersect1(k.rays), intersect16(k.rays, true), intersect_stream(k.rays, STREAM, true)};
}

// Parallel to an axis, each toward a point that lies on a surface, from about as far along the axis as another such
// point: what voxelisers trace, and suns overhead. Zeros in a direction are where kernels divide by zero.
void axis_aligned(Kind &k, const Scene &s, size_t count, Random &random) {
    while (k.rays.rays.size() < count) {
        const Random::Point p = random.on_surface(s), q = random.on_surface(s);
        const double p_at[3] = {p.position.x, p.position.y, p.position.z};
        const double q_at[3] = {q.position.x, q.position.y, q.position.z},
                     normal[3] = {q.normal.x, q.normal.y, q.normal.z};
        const size_t axis = std::min<size_t>(2, size_t(random.uniform() * 3));
        const double way = q_at[axis] - p_at[axis];
        // Seen edge on, or no way to go.
        if (std::abs(normal[axis]) < 0.1 || std::abs(way) < 1e-3 * s.diagonal) continue;
        double origin[3] = {q_at[0], q_at[1], q_at[2]}, direction[3] = {0, 0, 0};
        // Not just as far: surfaces that lie across the axis would be met at their beginning, by one side or the other.
        origin[axis] = p_at[axis] + 0.01 * way;
        direction[axis] = way > 0 ? 1 : -1;
        k.rays.add({origin[0], origin[1], origin[2]}, 0, {direction[0], direction[1], direction[2]}, INF);
    }
    k.rays.finish();
    k.ours = [&k, &s](size_t begin, size_t end) {
        check(bk_intersect_many(s.scene, &k.rays.rays[begin], end - begin, 0, &k.hits[begin]));
    };
    k.ways = {intersect1(k.rays), intersect16(k.rays, false), intersect_stream(k.rays, STREAM, false)};
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
    k.ways = occlusion_ways(k, s);
}

const struct {
    size_t unit;
    bool occlusion;
    void (*make)(Kind &, const Scene &, size_t count, Random &);
} HOW[KINDS] = {
    {STREAM, false, random_incoherent}, {32, false, gather},   {256, false, gather},        {STREAM, false, primary},
    {STREAM, false, axis_aligned},      {16, true, occlusion}, {STREAM, false, one_by_one}, {4096, false, tiles},
    {1024, false, gather},              {256, true, tiles_to_lamp},
};

} // namespace

const char *const KIND_NAMES[KINDS] = {"random",       "gather 32", "gather 256", "primary",
                                       "axis-aligned", "occluded",  "one by one", "tiles 8x8x64",
                                       "gather 1024",  "tile to lamp"};

void make_kind(Kind &k, size_t number, const Scene &s, size_t count, uint64_t seed) {
    k.name = KIND_NAMES[number];
    k.unit = HOW[number].unit;
    k.occlusion = HOW[number].occlusion;
    // Each kind has random numbers of its own, so that a new one does not change the others.
    Random random(seed + number);
    HOW[number].make(k, s, std::max(k.unit, count / k.unit * k.unit), random);
    k.hits.resize(k.occlusion ? 0 : k.rays.rays.size());
    k.occluded.resize(k.occlusion ? k.rays.rays.size() : 0);
}
