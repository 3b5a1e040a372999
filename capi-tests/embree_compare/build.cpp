#include "build.h"

#include <atomic>
#include <new>

// Embree's devices share their threads: one that was started with few may get more by its neighbour. So there is only
// ever one of them here.

CommitTimes time_commits(const Scene &s, const Setup &setup, Mode mode, unsigned threads, unsigned pairs) {
    const uint32_t quality = mode == HIGH ? BK_BUILD_QUALITY_HIGH : BK_BUILD_QUALITY_DEFAULT;
    bk_device *device = our_device(setup, threads);
    const RTCDevice embree = embree_device(setup, threads);
    // On one thread what was run is as good as the wall clock, and not disturbed by other programs.
    const auto now = threads == 1 ? process_seconds : wall_seconds;
    std::vector<double> ours, theirs, ratios;
    for (unsigned p = 0; p < pairs; p++) {
        bk_scene *const scene = our_scene(device, s, quality);
        double start = now();
        check(bk_scene_commit(scene, nullptr, nullptr));
        ours.push_back(now() - start);
        bk_scene_release(scene);

        const RTCScene other = embree_scene(embree, s, mode);
        start = now();
        rtcCommitScene(other);
        theirs.push_back(now() - start);
        rtcReleaseScene(other);
        ratios.push_back(theirs.back() / ours.back());
    }
    rtcReleaseDevice(embree);
    bk_device_release(device);
    return {median(ours), median(theirs), median(ratios)};
}

// ---------------------------------------------------------------------------------------------
// Memory.

OurTree our_tree(const Scene &s, uint32_t quality) {
    bk_scene *const scene = our_scene(s.device, s, quality);
    check(bk_scene_commit(scene, nullptr, nullptr));
    bk_scene_stats stats;
    bk_scene_stats_init(&stats);
    check(bk_scene_get_stats(scene, &stats));
    bk_scene_release(scene);
    return {{double(stats.bvh_bytes), double(stats.bytes)}, double(stats.wide_sah_cost)};
}

Bytes embree_bytes(const Scene &s, const Setup &setup, Mode mode) {
    std::atomic<long long> held{0};
    const RTCDevice device = embree_device(setup, 1);
    rtcSetDeviceMemoryMonitorFunction(
        device,
        [](void *user, ssize_t bytes, bool) {
            *static_cast<std::atomic<long long> *>(user) += bytes;
            return true;
        },
        &held);
    const long long before = held;
    const RTCScene scene = embree_scene(device, s, mode);
    const long long described = held;
    rtcCommitScene(scene);
    const long long committed = held;
    rtcReleaseScene(scene);
    rtcReleaseDevice(device);
    return {double(committed - described), double(committed - before)};
}

// ---------------------------------------------------------------------------------------------
// The surface area heuristic's cost.

namespace {

// Embree's builders for triangles count, split and fill leaves by blocks of four triangles, at most seven of them.
const unsigned BLOCK = 4, MOST_BLOCKS = 7, DEPTH = 32, WIDEST = 8;
// References that spatial splits may leave, in parts of the triangles: max_spatial_split_replications.
const double REPLICATIONS = 1.2;

// A node with the areas of its children, or a leaf.
struct TreeNode {
    unsigned triangles; // 0: not a leaf
    unsigned count;
    const TreeNode *children[WIDEST];
    double areas[WIDEST];
};

double half_area(const RTCBounds &b) {
    const double x = std::max(0.0f, b.upper_x - b.lower_x), y = std::max(0.0f, b.upper_y - b.lower_y),
                 z = std::max(0.0f, b.upper_z - b.lower_z);
    return x * y + y * z + z * x;
}

void *new_node(RTCThreadLocalAllocator allocator) {
    return new (rtcThreadLocalAlloc(allocator, sizeof(TreeNode), alignof(TreeNode))) TreeNode{};
}

// By areas, to be divided by the bounds'.
double cost_below(const TreeNode &node) {
    double sum = 0;
    for (unsigned i = 0; i < node.count; i++) {
        const TreeNode &child = *node.children[i];
        sum += child.triangles ? node.areas[i] * child.triangles : node.areas[i] + cost_below(child);
    }
    return sum;
}

void grow(RTCBounds &b, const float p[3]) {
    b.lower_x = std::min(b.lower_x, p[0]), b.upper_x = std::max(b.upper_x, p[0]);
    b.lower_y = std::min(b.lower_y, p[1]), b.upper_y = std::max(b.upper_y, p[1]);
    b.lower_z = std::min(b.lower_z, p[2]), b.upper_z = std::max(b.upper_z, p[2]);
}

RTCBounds no_bounds() {
    RTCBounds b{};
    b.lower_x = b.lower_y = b.lower_z = INF;
    b.upper_x = b.upper_y = b.upper_z = -INF;
    return b;
}

// The boxes around the parts of a triangle on both sides of a plane, as Embree has it for scenes.
void split(const RTCBuildPrimitive *primitive, unsigned axis, float position, RTCBounds *left, RTCBounds *right,
           void *user) {
    const Scene &s = *static_cast<const Scene *>(user);
    *left = *right = no_bounds();
    for (int c = 0; c < 3; c++) {
        const Position a = s.vertex(primitive->geomID, primitive->primID, c);
        const Position b = s.vertex(primitive->geomID, primitive->primID, (c + 1) % 3);
        if (a[axis] <= position) grow(*left, a);
        if (a[axis] >= position) grow(*right, a);
        if ((a[axis] < position && b[axis] > position) || (a[axis] > position && b[axis] < position)) {
            const float t = (position - a[axis]) / (b[axis] - a[axis]);
            const float crossing[3] = {a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])};
            grow(*left, crossing);
            grow(*right, crossing);
        }
    }
    for (RTCBounds *b : {left, right}) {
        b->lower_x = std::max(b->lower_x, primitive->lower_x), b->upper_x = std::min(b->upper_x, primitive->upper_x);
        b->lower_y = std::max(b->lower_y, primitive->lower_y), b->upper_y = std::min(b->upper_y, primitive->upper_y);
        b->lower_z = std::max(b->lower_z, primitive->lower_z), b->upper_z = std::min(b->upper_z, primitive->upper_z);
    }
}

} // namespace

double embree_sah(const Scene &s, const Setup &setup, Mode mode) {
    std::vector<RTCBuildPrimitive> primitives;
    RTCBounds bounds = no_bounds();
    for (uint32_t m = 0; m < s.meshes.size(); m++) {
        for (uint32_t t = 0; t < s.meshes[m].triangle_count; t++) {
            RTCBounds box = no_bounds();
            for (int c = 0; c < 3; c++) grow(box, s.vertex(m, t, c));
            if (!std::isfinite(half_area(box))) continue;
            primitives.push_back({box.lower_x, box.lower_y, box.lower_z, m, box.upper_x, box.upper_y, box.upper_z, t});
            const float lower[3] = {box.lower_x, box.lower_y, box.lower_z},
                        upper[3] = {box.upper_x, box.upper_y, box.upper_z};
            grow(bounds, lower);
            grow(bounds, upper);
        }
    }
    const size_t count = primitives.size();
    primitives.resize(size_t(REPLICATIONS * double(count)));

    const RTCDevice device = embree_device(setup, 1);
    const RTCBVH bvh = rtcNewBVH(device);
    RTCBuildArguments arguments = rtcDefaultBuildArguments();
    arguments.buildQuality = mode == HIGH ? RTC_BUILD_QUALITY_HIGH : RTC_BUILD_QUALITY_MEDIUM;
    // Without AVX its trees are four wide.
    arguments.maxBranchingFactor = setup.embree_isa.compare(0, 3, "sse") == 0 ? 4 : WIDEST;
    arguments.maxDepth = DEPTH;
    arguments.sahBlockSize = BLOCK;
    arguments.minLeafSize = BLOCK;
    arguments.maxLeafSize = MOST_BLOCKS * BLOCK;
    arguments.bvh = bvh;
    arguments.primitives = primitives.data();
    arguments.primitiveCount = count;
    arguments.primitiveArrayCapacity = mode == HIGH ? primitives.size() : count;
    arguments.createNode = [](RTCThreadLocalAllocator allocator, unsigned, void *) { return new_node(allocator); };
    arguments.setNodeChildren = [](void *node, void **children, unsigned n, void *) {
        TreeNode &to = *static_cast<TreeNode *>(node);
        to.count = n;
        for (unsigned i = 0; i < n; i++) to.children[i] = static_cast<const TreeNode *>(children[i]);
    };
    arguments.setNodeBounds = [](void *node, const RTCBounds **boxes, unsigned n, void *) {
        for (unsigned i = 0; i < n; i++) static_cast<TreeNode *>(node)->areas[i] = half_area(*boxes[i]);
    };
    arguments.createLeaf = [](RTCThreadLocalAllocator allocator, const RTCBuildPrimitive *, size_t n, void *) {
        void *const leaf = new_node(allocator);
        static_cast<TreeNode *>(leaf)->triangles = unsigned(n);
        return leaf;
    };
    arguments.splitPrimitive = split;
    arguments.userPtr = const_cast<Scene *>(&s);
    const TreeNode *const root = static_cast<const TreeNode *>(rtcBuildBVH(&arguments));
    if (!root) fail("Embree builds no tree");
    const double cost = root->triangles ? 1.0 + root->triangles : 1 + cost_below(*root) / half_area(bounds);
    rtcReleaseBVH(bvh);
    rtcReleaseDevice(device);
    return cost;
}
