#include "scene.h"

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#if defined(__x86_64__) || defined(_M_X64)
#include <pmmintrin.h>
#include <xmmintrin.h>
#endif

void fail(const std::string &what) {
    std::fprintf(stderr, "embree_compare: %s\n", what.c_str());
    std::exit(2);
}

void check(bk_result result) {
    if (result != BK_OK) fail(std::string(bk_result_string(result)) + ": " + bk_last_error());
}

double wall_seconds() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

#ifdef _WIN32
double thread_seconds() { return wall_seconds(); }
double process_seconds() { return wall_seconds(); }
#else
static double seconds_of(clockid_t clock) {
    timespec t{};
    clock_gettime(clock, &t);
    return double(t.tv_sec) + 1e-9 * double(t.tv_nsec);
}
double thread_seconds() { return seconds_of(CLOCK_THREAD_CPUTIME_ID); }
double process_seconds() { return seconds_of(CLOCK_PROCESS_CPUTIME_ID); }
#endif

void flush_denormals() {
#if defined(__x86_64__) || defined(_M_X64)
    _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
    _MM_SET_DENORMALS_ZERO_MODE(_MM_DENORMALS_ZERO_ON);
#endif
}

bk_device *our_device(const Setup &setup, unsigned threads) {
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.isa = setup.isa;
    desc.num_threads = threads;
    bk_device *device = nullptr;
    const bk_result result = bk_device_create(&desc, &device);
    if (result != BK_ERROR_UNSUPPORTED) check(result);
    return device;
}

RTCDevice embree_device(const Setup &setup, unsigned threads) {
    std::string config = "threads=" + std::to_string(threads);
    if (!setup.embree_isa.empty()) config += ",isa=" + setup.embree_isa;
    return rtcNewDevice(config.c_str());
}

// Of one material, without meshes.
static bk_scene *empty_scene(bk_device *device) {
    bk_scene *scene;
    check(bk_scene_create(device, &scene));
    bk_material_desc material;
    bk_material_desc_init(&material);
    check(bk_scene_add_material(scene, &material, nullptr));
    return scene;
}

// Adds the triangles of a mesh with other positions, as many; returns the new mesh's number.
static uint32_t add_mesh(bk_scene *scene, const bk_mesh_view &view, const float *positions) {
    bk_mesh_desc mesh;
    bk_mesh_desc_init(&mesh);
    mesh.positions = positions;
    mesh.vertex_count = view.vertex_count;
    mesh.indices = view.indices;
    mesh.triangle_count = view.triangle_count;
    uint32_t number;
    check(bk_scene_add_mesh(scene, &mesh, &number));
    return number;
}

bk_scene *our_scene(bk_device *device, const Scene &s, uint32_t quality) {
    bk_scene *const scene = empty_scene(device);
    bk_build_params params;
    bk_build_params_init(&params);
    params.quality = quality;
    check(bk_scene_set_build(scene, &params));
    for (const bk_mesh_view &view : s.meshes) add_mesh(scene, view, view.positions);
    return scene;
}

static RTCScene empty_embree_scene(RTCDevice device, Mode mode) {
    RTCScene scene = rtcNewScene(device);
    rtcSetSceneBuildQuality(scene, mode == HIGH ? RTC_BUILD_QUALITY_HIGH : RTC_BUILD_QUALITY_MEDIUM);
    rtcSetSceneFlags(scene, mode == ROBUST ? RTC_SCENE_FLAG_ROBUST : RTC_SCENE_FLAG_NONE);
    return scene;
}

RTCScene embree_scene(RTCDevice device, const Scene &s, Mode mode) {
    RTCScene scene = empty_embree_scene(device, mode);
    // Instances are all of the first mesh.
    const size_t meshes = s.places.empty() ? s.meshes.size() : 1;
    for (size_t m = 0; m < meshes; m++) {
        const bk_mesh_view &mesh = s.meshes[m];
        if (mesh.triangle_count == 0) continue;
        RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
        void *vertices =
            rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, mesh.vertex_count);
        void *indices =
            rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, mesh.triangle_count);
        if (!vertices || !indices) fail("Embree has no memory for mesh " + std::to_string(m));
        std::memcpy(vertices, mesh.positions, mesh.vertex_count * 12);
        std::memcpy(indices, mesh.indices, mesh.triangle_count * 12);
        rtcCommitGeometry(geometry);
        rtcAttachGeometryByID(scene, geometry, unsigned(m));
        rtcReleaseGeometry(geometry);
    }
    if (s.places.empty()) return scene;
    rtcCommitScene(scene);
    RTCScene all = empty_embree_scene(device, mode);
    for (size_t i = 0; i < s.places.size(); i++) {
        const float *const at = s.places[i];
        const float transform[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, at[0], at[1], at[2]};
        RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_INSTANCE);
        rtcSetGeometryInstancedScene(geometry, scene);
        rtcSetGeometryTransform(geometry, 0, RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR, transform);
        rtcCommitGeometry(geometry);
        rtcAttachGeometryByID(all, geometry, unsigned(i));
        rtcReleaseGeometry(geometry);
    }
    rtcReleaseScene(scene);
    return all;
}

// Where a scene stands `times` times in a square grid on the plane of x and z, each beside the next, as
// `bakelite bake --repeat` places it.
static std::vector<Position> grid(const bk_scene *once, unsigned times) {
    float lower[3], upper[3];
    check(bk_scene_bounds(once, lower, upper));
    const auto columns = unsigned(std::ceil(std::sqrt(double(times))));
    std::vector<Position> places;
    for (unsigned i = 0; i < times; i++) {
        places.push_back({{(upper[0] - lower[0]) * float(i % columns), 0, (upper[2] - lower[2]) * float(i / columns)}});
    }
    return places;
}

// A scene of instances of a committed one, whose meshes become one mesh.
static bk_scene *instanced(bk_device *device, const bk_scene *once, const std::vector<Position> &places) {
    bk_scene *const scene = empty_scene(device);
    std::vector<float> positions;
    std::vector<uint32_t> indices;
    for (uint32_t m = 0; m < bk_scene_mesh_count(once); m++) {
        bk_mesh_view mesh;
        bk_mesh_view_init(&mesh);
        check(bk_scene_get_mesh(once, m, &mesh));
        const auto first = uint32_t(positions.size() / 3);
        positions.insert(positions.end(), mesh.positions, mesh.positions + 3 * size_t(mesh.vertex_count));
        for (size_t i = 0; i < 3 * size_t(mesh.triangle_count); i++) indices.push_back(first + mesh.indices[i]);
    }
    bk_mesh_view merged;
    bk_mesh_view_init(&merged);
    merged.vertex_count = uint32_t(positions.size() / 3);
    merged.indices = indices.data();
    merged.triangle_count = uint32_t(indices.size() / 3);
    const uint32_t all = add_mesh(scene, merged, positions.data());
    for (const Position &at : places) {
        const float transform[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, at.x[0], at.x[1], at.x[2]};
        check(bk_scene_add_instance(scene, all, transform, nullptr));
    }
    return scene;
}

// A scene of copies of a committed one.
static bk_scene *repeated(bk_device *device, const bk_scene *once, const std::vector<Position> &places) {
    bk_scene *const scene = empty_scene(device);
    std::vector<float> positions;
    for (uint32_t m = 0; m < bk_scene_mesh_count(once); m++) {
        bk_mesh_view mesh;
        bk_mesh_view_init(&mesh);
        check(bk_scene_get_mesh(once, m, &mesh));
        for (const Position &at : places) {
            positions.assign(mesh.positions, mesh.positions + 3 * size_t(mesh.vertex_count));
            for (size_t i = 0; i < positions.size(); i++) positions[i] += at.x[i % 3];
            add_mesh(scene, mesh, positions.data());
        }
    }
    return scene;
}

Scene::Scene(const std::string &name, const Setup &setup) {
    // All rays are traced by threads of this program's own.
    device = our_device(setup, 1);
    if (!device) fail(std::string("this machine has no ") + ISA_NAMES[setup.isa]);
    check(bk_scene_create(device, &scene));
    const bool file = name.find('.') != std::string::npos;
    check(file ? bk_scene_load_file(scene, name.c_str(), nullptr, nullptr, nullptr, nullptr) : bk_scene_load_builtin(scene, name.c_str()));
    if (setup.times > 1 || setup.instances) {
        bk_scene *const once = scene;
        check(bk_scene_commit(once, nullptr, nullptr));
        const std::vector<Position> all = grid(once, setup.times);
        scene = setup.instances ? instanced(device, once, all) : repeated(device, once, all);
        if (setup.instances) places = all;
        bk_scene_release(once);
    }
    bk_build_params params;
    bk_build_params_init(&params);
    params.quality = setup.quality;
    check(bk_scene_set_build(scene, &params));
    check(bk_scene_commit(scene, nullptr, nullptr));
    bk_scene_stats_init(&stats);
    check(bk_scene_get_stats(scene, &stats));

    float lower[3], upper[3];
    check(bk_scene_bounds(scene, lower, upper));
    center = (load(lower) + load(upper)) * 0.5;
    diagonal = length(load(upper) - load(lower));
    double sum = 0;
    const auto count = places.empty() ? bk_scene_mesh_count(scene) : uint32_t(places.size());
    for (uint32_t m = 0; m < count; m++) {
        bk_mesh_view view;
        bk_mesh_view_init(&view);
        check(bk_scene_get_mesh(scene, places.empty() ? m : 0, &view));
        meshes.push_back(view);
        for (uint32_t t = 0; t < view.triangle_count; t++) {
            const Vec3d a = load(vertex(m, t, 0)), b = load(vertex(m, t, 1)), c = load(vertex(m, t, 2));
            const double area = 0.5 * length(cross(b - a, c - a));
            if (!(area > 0) || !std::isfinite(area)) continue;
            sum += area;
            triangles.emplace_back(m, t);
            area_sums.push_back(sum);
        }
    }
}

Scene::~Scene() {
    bk_scene_release(scene);
    bk_device_release(device);
}

EmbreeScenes::EmbreeScenes(const Scene &s, const Setup &setup) : device(embree_device(setup, 1)) {
    if (!device) fail("Embree starts no device with ISA " + setup.embree_isa);
    for (int mode = 0; mode < MODES; mode++) {
        of[mode] = embree_scene(device, s, Mode(mode));
        rtcCommitScene(of[mode]);
    }
    if (rtcGetDeviceError(device) != RTC_ERROR_NONE) fail("Embree cannot build the scene");
}

EmbreeScenes::~EmbreeScenes() {
    for (RTCScene scene : of) rtcReleaseScene(scene);
    rtcReleaseDevice(device);
}
