#include "judge.h"

#include <cstdio>

namespace {

struct Hit {
    bool hit;
    float t;
    uint32_t mesh, triangle; // of instances the number of the instance, as of a mesh of its own
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
    const uint32_t mesh = h.hit.instID[0] != RTC_INVALID_GEOMETRY_ID ? h.hit.instID[0] : h.hit.geomID;
    return {h.hit.geomID != RTC_INVALID_GEOMETRY_ID, h.ray.tfar, mesh, h.hit.primID};
}

Hit our_hit(const bk_hit &h) {
    return {h.triangle != BK_NONE, h.t, h.instance != BK_NONE ? h.instance : h.mesh, h.triangle};
}

void print_real(const Kind &k, size_t i, const Hit &ours, const Hit &theirs) {
    const bk_ray &r = k.rays.rays[i];
    std::fprintf(stderr, "real disagreement, %s ray %zu: origin {%a, %a, %a} tmin %a direction {%a, %a, %a} tmax %a\n",
                 k.name, i, double(r.origin[0]), double(r.origin[1]), double(r.origin[2]), double(r.tmin),
                 double(r.direction[0]), double(r.direction[1]), double(r.direction[2]), double(r.tmax));
    for (const auto &[name, h] : {std::make_pair("ours", ours), std::make_pair("Embree's", theirs)}) {
        if (h.hit) {
            std::fprintf(stderr, "  %s: mesh %u triangle %u t %a\n", name, h.mesh, h.triangle, double(h.t));
        } else {
            std::fprintf(stderr, "  %s: miss\n", name);
        }
    }
}

const size_t MAX_PRINTED = 10;

} // namespace

Counts verify(const Kind &k, const Scene &s, RTCScene robust) {
    Counts counts;
    for (size_t i = 0; i < k.rays.rays.size(); i++) {
        const bk_ray &ray = k.rays.rays[i];
        Hit ours, theirs;
        if (k.occlusion) {
            RTCIntersectContext c = context(RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT);
            RTCRay r = k.rays.ones[i];
            rtcOccluded1(robust, &c, &r);
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
            theirs = embree_hit(robust, k.rays.ones[i]);
            if (ours.hit != occluded || theirs.hit != embree_occluded || ours.hit == theirs.hit) {
                // A side contradicts itself: judge whichever hit there is.
                const Hit any = ours.hit ? ours : theirs;
                const Hit none{false, INF, BK_NONE, BK_NONE};
                ours = occluded ? any : none;
                theirs = occluded ? none : any;
            }
        } else {
            ours = our_hit(k.hits[i]);
            theirs = embree_hit(robust, k.rays.ones[i]);
            ++(ours.hit ? counts.hits : counts.misses);
        }
        const Class c = classify(s, ray, ours, theirs);
        counts.of[c]++;
        if (c == Real && counts.of[Real] <= MAX_PRINTED) print_real(k, i, ours, theirs);
    }
    return counts;
}
