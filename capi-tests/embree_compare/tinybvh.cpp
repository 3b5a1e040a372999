// tinybvh's trees for CPUs. Its rays have unit directions and begin at t = 0: origins are moved to tmin, distances are
// converted. Each run copies a ray into the structure that is traced, as for Embree, and stores what it hits, as ours.
//
// The only file that is compiled for AVX2 with FMA, which tinybvh wants.

#include "tinybvh.h"

#ifdef BAKELITE_TINYBVH

#define TINYBVH_IMPLEMENTATION
#include <tiny_bvh.h>

namespace {

using Triangles = std::vector<tinybvh::bvhvec4>;

template <typename Tree> class TinyBvh : public Peer {
  public:
    TinyBvh(const char *layout, bool high, std::shared_ptr<const Triangles> triangles)
        : layout(layout), triangles(std::move(triangles)) {
        const uint32_t count = uint32_t(this->triangles->size() / 3);
        if (high) {
            tree.BuildHQ(this->triangles->data(), count);
        } else {
            tree.Build(this->triangles->data(), count);
        }
    }

    std::string name() const override {
        return "tinybvh " + std::to_string(TINY_BVH_VERSION_MAJOR) + "." + std::to_string(TINY_BVH_VERSION_MINOR) +
               "." + std::to_string(TINY_BVH_VERSION_SUB) + " " + layout;
    }

    void prepare(const Kind &k) override {
        occlusion = k.occlusion;
        const size_t count = k.rays.rays.size();
        rays.resize(count);
        factors.resize(count);
        offsets.resize(count);
        distances.assign(count, INF);
        for (size_t i = 0; i < count; i++) {
            const bk_ray &r = k.rays.rays[i];
            const Vec3d d = load(r.direction), o = load(r.origin) + d * r.tmin;
            const double far = (double(r.tmax) - r.tmin) * length(d);
            const tinybvh::bvhvec3 origin(float(o.x), float(o.y), float(o.z));
            const tinybvh::bvhvec3 direction(r.direction[0], r.direction[1], r.direction[2]);
            rays[i] = tinybvh::Ray(origin, direction, float(std::min(far, double(BVH_FAR))));
            factors[i] = float(1 / length(d));
            offsets[i] = r.tmin;
        }
    }

    void run(size_t begin, size_t end) override {
        for (size_t i = begin; i < end; i++) {
            tinybvh::Ray ray = rays[i];
            if (occlusion) {
                distances[i] = tree.IsOccluded(ray) ? 0 : INF;
            } else {
                tree.Intersect(ray);
                distances[i] = ray.hit.t;
            }
        }
    }

    bool is_hit(size_t ray) const override { return distances[ray] < rays[ray].hit.t && distances[ray] < BVH_FAR; }
    float t(size_t ray) const override { return distances[ray] * factors[ray] + offsets[ray]; }

  private:
    const char *layout;
    std::shared_ptr<const Triangles> triangles; // to which the tree refers
    Tree tree;
    bool occlusion = false;
    std::vector<tinybvh::Ray> rays;
    std::vector<float> factors, offsets, distances;
};

} // namespace

std::vector<std::unique_ptr<Peer>> peers(const Scene &s) {
    const auto triangles = std::make_shared<Triangles>();
    for (uint32_t m = 0; m < s.meshes.size(); m++) {
        for (uint32_t t = 0; t < s.meshes[m].triangle_count; t++) {
            for (int corner = 0; corner < 3; corner++) {
                const Position v = s.vertex(m, t, corner);
                triangles->emplace_back(v[0], v[1], v[2], 0.0f);
            }
        }
    }
    std::vector<std::unique_ptr<Peer>> found;
    found.push_back(std::make_unique<TinyBvh<tinybvh::BVH8_CPU>>("BVH8_CPU", false, triangles));
    found.push_back(std::make_unique<TinyBvh<tinybvh::BVH8_CPU>>("BVH8_CPU HQ", true, triangles));
    found.push_back(std::make_unique<TinyBvh<tinybvh::BVH4_CPU>>("BVH4_CPU", false, triangles));
    found.push_back(std::make_unique<TinyBvh<tinybvh::BVH_SoA>>("BVH_SoA", false, triangles));
    return found;
}

#else

std::vector<std::unique_ptr<Peer>> peers(const Scene &) { return {}; }

#endif
