// bakelite.hpp: the same program with exceptions, and compiled without them (see the end).
#include "check.h"
#include <bakelite.hpp>
#include <array>
#include <cmath>
#include <vector>
#if __cplusplus >= 202002L && __has_include(<span>)
#include <span>
#endif

using namespace bakelite;

#ifdef BAKELITE_NO_EXCEPTIONS
// The value of a call that must succeed.
template <class T>
static T value_at(Result<T> result, const char *what, const char *file, int line) {
    check_at(bool(result), what, file, line);
    return std::move(result).value();
}
static void value_at(Result<void> result, const char *what, const char *file, int line) {
    check_at(bool(result), what, file, line);
}
#define VALUE(call) value_at((call), #call, __FILE__, __LINE__)
#define CHECK_FAILS(call, expected, culprit)                                                                           \
    do {                                                                                                               \
        const auto result = (call);                                                                                    \
        CHECK(!result && result.code() == (expected) && strstr(result.message(), culprit));                            \
    } while (0)
#else
#define VALUE(call) (call)
#define CHECK_FAILS(call, expected, culprit)                                                                           \
    do {                                                                                                               \
        bk_result code = BK_OK;                                                                                        \
        bool names_it = false;                                                                                         \
        try {                                                                                                          \
            (void)(call);                                                                                              \
        } catch (const Error &error) {                                                                                 \
            code = error.code();                                                                                       \
            names_it = strstr(error.what(), culprit) != nullptr;                                                       \
        }                                                                                                              \
        CHECK(code == (expected));                                                                                     \
        CHECK(names_it);                                                                                               \
    } while (0)
#endif

struct Vec3 {
    float x, y, z;
};
struct Vertex {
    Vec3 position, normal;
    float lightmap_uv[2];
};

// A floor of 4 x 4 units.
static const std::vector<Vertex> vertices{{{0, 0, 0}, {0, 1, 0}, {0, 0}},
                                          {{4, 0, 0}, {0, 1, 0}, {1, 0}},
                                          {{4, 0, 4}, {0, 1, 0}, {1, 1}},
                                          {{0, 0, 4}, {0, 1, 0}, {0, 1}}};
static const std::array<std::uint32_t, 6> triangles{0, 2, 1, 0, 3, 2};

static Scene floor_with_lamp(const Device &device) {
    Scene scene = VALUE(Scene::create(device));
    MaterialDesc grey;
    grey.albedo[0] = grey.albedo[1] = grey.albedo[2] = 0.5f;
    const Vertex &first = vertices[0];
    MeshDesc mesh(vertices, triangles);
    mesh.with_normals({&first.normal.x, vertices.size(), sizeof(Vertex)})
        .with_lightmap_uvs({first.lightmap_uv, vertices.size(), sizeof(Vertex)});
    mesh.material = VALUE(scene.add_material(grey));
    CHECK(VALUE(scene.add_mesh(mesh)) == 0);
    LightDesc lamp;
    lamp.position[0] = lamp.position[2] = 2, lamp.position[1] = 2;
    VALUE(scene.add_light(lamp));
    return scene;
}

static void spans() {
    const float packed[6] = {1, 2, 3, 4, 5, 6};
    const std::vector<float> floats(9);
    const std::array<Vec3, 2> vectors{};
    CHECK(Span<const float>(packed).size() == 6 && Span<const float>(floats).data() == floats.data());
    CHECK(Vectors<3>(floats).count() == 3 && Vectors<3>(floats).stride() == 12);
    CHECK(Vectors<3>(vectors).count() == 2 && Vectors<3>(vertices).stride() == sizeof(Vertex));
#ifdef __cpp_lib_span
    CHECK(Span<const float>(std::span<const float>(packed)).size() == 6);
#endif
}

static void handles(const Device &device) {
    Scene first = VALUE(Scene::create(device));
    Scene second = first;
    CHECK(first.get() == second.get());
    Scene third = std::move(first);
    CHECK(!first && third.get() == second.get());
    second = Scene();
    CHECK(!second && third);
    bk_scene *mine = third.release();
    CHECK(mine && !third);
    bk_scene_release(mine);
}

static void errors(const Device &device) {
    Scene scene = VALUE(Scene::create(device));
    CHECK_FAILS(scene.load_builtin("no such scene"), BK_ERROR_INVALID_ARGUMENT, "no such scene");
    CHECK_FAILS(scene.commit(), BK_ERROR_INVALID_STATE, "triangle");
    CHECK_FAILS(scene.add_mesh(MeshDesc(vertices, std::array<std::uint32_t, 3>{0, 1, 9})), BK_ERROR_INVALID_ARGUMENT, "9");
    std::array<bk_ray, 2> rays{};
    std::array<bk_hit, 1> hits{};
    CHECK_FAILS(scene.intersect(rays, hits), BK_ERROR_INVALID_ARGUMENT, "as many hits");
}

static void rays(const Scene &scene) {
    const bk_ray down{{1, 1, 1}, 0, {0, -1, 0}, INFINITY}, up{{1, 1, 1}, 0, {0, 1, 0}, INFINITY};
    CHECK(scene.intersect(down).t == 1 && scene.intersect(up).mesh == BK_NONE);
    CHECK(scene.occluded(down) && !scene.occluded(up));
    const std::array<bk_ray, 2> both{down, up};
    std::array<bk_hit, 2> hits;
    std::vector<std::uint8_t> hidden(2);
    VALUE(scene.intersect(both, hits));
    VALUE(scene.occluded(both, hidden));
    CHECK(hits[0].t == 1 && hits[1].mesh == BK_NONE && hidden[0] == 1 && hidden[1] == 0);
}

// The irradiance below a lamp of 1 W/sr at height 2 is 1 / 4.
static void bake(const Scene &scene) {
    LightmapDesc desc;
    desc.page_size = 65;
    Lightmap map = VALUE(Lightmap::create(scene, desc));
    CHECK_FAILS(map.read(0), BK_ERROR_INVALID_STATE, "bake");
    CHECK_FAILS(map.bake({}, [](float, const char *) { return false; }), BK_ERROR_CANCELLED, "");
    int calls = 0;
    LightmapDesc fine;
    BakeParams good;
    VALUE(set_quality(BK_QUALITY_HIGH, fine, good));
    CHECK(fine.gather_divisor < LightmapDesc().gather_divisor && good.gather_rays > BakeParams().gather_rays);
    CHECK_FAILS(set_quality(77, fine, good), BK_ERROR_INVALID_ARGUMENT, "quality is 77");
    const BakeStats stats = VALUE(map.bake({}, [&calls](float, const char *) { return ++calls > 0; }));
    CHECK(calls > 0 && stats.seconds > 0);
    const LightmapInfo info = VALUE(map.info());
    CHECK(info.page_count == 1 && info.width == 65);
    const std::vector<float> light = VALUE(map.read(0));
    CHECK(light.size() == 3 * 65 * 65);
    CHECK(std::fabs(light[3 * (32 * 65 + 32)] - 0.25f) < 0.25e-3f);
    const std::array<std::uint32_t, 1> direct{BK_LAYER_DIRECT};
    VALUE(map.write(direct, VALUE(map.read(0, BK_LAYER_DIRECT))));
    CHECK(VALUE(map.read(0)) == light);
    CHECK_FAILS(map.write(direct, Span<const float>(light.data(), 3)), BK_ERROR_INVALID_ARGUMENT, "pages of these layers");
    std::vector<std::byte> halves(8 * 65 * 65);
    VALUE(map.read(0, BK_LAYER_COMBINED, BK_FORMAT_RGBA16F, halves));
    halves.pop_back();
    CHECK_FAILS(map.read(0, BK_LAYER_COMBINED, BK_FORMAT_RGBA16F, halves), BK_ERROR_INVALID_ARGUMENT, "page of this format");
    const MeshUvs uvs = VALUE(map.mesh_uvs(scene, 0));
    CHECK(uvs.corners.size() == 12 && uvs.pages.size() == 2 && uvs.pages[1] == 0);
    VALUE(map.follow(scene));
    CHECK_FAILS(map.bake_changed({}, -1), BK_ERROR_INVALID_ARGUMENT, "keep_error");
    VALUE(map.bake_changed({}, 0.1f));
    const LightmapInfo revised = VALUE(VALUE(Lightmap::create_from(scene, map, desc)).info());
    CHECK(revised.kept_charts == revised.charts);
    CHECK_FAILS(map.bake_changed_from(map, {}, 0.1f), BK_ERROR_INVALID_ARGUMENT, "earlier");
    CHECK(map.plan().find("direct") != std::string::npos && map.plan().back() != '\0');

    Live live = VALUE(Live::create(map));
    Camera camera;
    camera.position[1] = 3, camera.forward[1] = -1, camera.forward[2] = 0, camera.up[1] = 0, camera.up[2] = 1;
    VALUE(live.update(camera));
    const std::vector<bk_rect> rects = VALUE(live.dirty_rects());
    Live carried = VALUE(Live::create_from(map, live, 0.03f));
    VALUE(carried.update(camera));
    CHECK(!VALUE(carried.dirty_rects()).empty());
    CHECK(!rects.empty() && VALUE(live.dirty_rects()).empty());
    std::vector<std::byte> texels(std::size_t(12) * rects[0].width * rects[0].height);
    VALUE(live.read(rects[0], BK_LAYER_COMBINED, BK_FORMAT_RGB32F, texels));
}

static void photons(const Scene &scene) {
    PhotonParams params;
    params.photon_count = 10000;
    const PhotonMap map = VALUE(PhotonMap::create(scene, params));
    CHECK(VALUE(map.photons()).count > 0);
    const std::array<float, 3> middle{2, 0, 2}, up{0, 1, 0};
    std::array<float, 3> light{};
    VALUE(map.estimate(middle, up, light));
    CHECK(light[0] > 0.1f && light[0] < 0.5f);
    CHECK_FAILS(map.estimate(middle, up, Span<float>(light.data(), 2)), BK_ERROR_INVALID_ARGUMENT, "same points");
}

#ifndef BAKELITE_NO_EXCEPTIONS
// An exception in a callback ends the call and comes out of it, not through C.
static void exceptions(const Device &device) {
    Scene scene = floor_with_lamp(device);
    int caught = 0;
    try {
        scene.commit([](float, const char *) -> bool { throw 42; });
    } catch (int number) {
        caught = number;
    }
    CHECK(caught == 42);
    scene.commit();
}
#endif

static void instances(const Device &device) {
    const float at[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0.25f, 0}, higher[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0.5f, 0};
    Scene scene = floor_with_lamp(device);
    CHECK(VALUE(scene.add_instance(0, at)) == 0);
    VALUE(scene.commit());
    const auto height = [&] { return scene.intersect({{1, 1, 1}, 0, {0, -1, 0}, INFINITY}); };
    CHECK(height().t == 0.75f && height().instance == 0 && height().mesh == 0);
    LightmapDesc desc;
    desc.texels_per_unit = 4;
    const Lightmap map = VALUE(Lightmap::create(scene, desc));
    CHECK(VALUE(map.instance_uvs(scene, 0)).pages.size() == 2);
    CHECK_FAILS(map.mesh_uvs(scene, 0), BK_ERROR_INVALID_ARGUMENT, "instances");
    VALUE(scene.set_transform(0, higher));
    VALUE(scene.refit());
    CHECK(height().t == 0.5f);
}

int main() {
    DeviceDesc desc;
    desc.num_threads = 2;
    const Device device = VALUE(Device::create(desc));
    CHECK(device.num_threads() == 2 && device.isa() != BK_ISA_AUTO);
    spans();
    handles(device);
    errors(device);
    Scene scene = floor_with_lamp(device);
    VALUE(scene.commit());
    CHECK(VALUE(scene.stats()).triangles == 2 && VALUE(scene.bounds()).second[0] == 4);
    CHECK(scene.mesh_count() == 1 && VALUE(scene.mesh(0)).vertex_count == 4);
    CHECK(scene.light_count() == 1 && VALUE(scene.light(0)).position[1] == 2);
    CHECK(scene.material_count() >= 1 && VALUE(scene.material(0)).albedo[0] == 0.5f && scene.texture_count() == 0);
    rays(scene);
    bake(scene);
    photons(scene);
    std::vector<Vertex> raised = vertices;
    for (Vertex &vertex : raised)
        vertex.position.y += 0.5f;
    VALUE(scene.set_positions(0, raised));
    VALUE(scene.refit());
    CHECK(scene.intersect({{1, 1, 1}, 0, {0, -1, 0}, INFINITY}).t == 0.5f);
    instances(device);
#ifndef BAKELITE_NO_EXCEPTIONS
    exceptions(device);
#endif
    return check_report("wrapper");
}
