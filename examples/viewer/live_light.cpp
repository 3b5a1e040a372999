#include "live_light.h"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <stdexcept>

namespace {

// Errors are codes in C; what went wrong is a sentence that belongs to the thread.
void check(bk_result result) {
    if (result != BK_OK) throw std::runtime_error(bk_last_error());
}

void print_log(void *, uint32_t level, const char *message) {
    if (level <= BK_LOG_WARNING) std::fprintf(stderr, "%s\n", message);
}

int32_t call_progress(void *user, float fraction, const char *stage) {
    return (*static_cast<const Progress *>(user))(fraction, stage) ? 1 : 0;
}

bk_light_desc describe(const PlacedLight &light, bool off) {
    bk_light_desc desc;
    bk_light_desc_init(&desc);
    desc.type = light.sun ? BK_LIGHT_DIRECTIONAL : BK_LIGHT_POINT;
    for (int i = 0; i < 3; i++) {
        (light.sun ? desc.direction : desc.position)[i] = light.place[i];
        desc.color[i] = off ? 0 : light.color[i];
    }
    return desc;
}

} // namespace

LiveLight::LiveLight(const Options &options, const Progress &progress) {
    bk_device_desc device_desc;
    bk_device_desc_init(&device_desc);
    device_desc.num_threads = options.threads;
    device_desc.log = print_log;
    bk_device *new_device = nullptr;
    check(bk_device_create(&device_desc, &new_device));
    const Handle<bk_device> device(new_device); // ours until the end of this function, then the scene's

    bk_scene *new_scene = nullptr;
    check(bk_scene_create(device.get(), &new_scene));
    scene.reset(new_scene);
    progress(0, "reading");
    load(options);
    void *user = const_cast<Progress *>(&progress);
    check(bk_scene_commit(scene.get(), call_progress, user));
    float bounds[6];
    check(bk_scene_bounds(scene.get(), bounds, bounds + 3));
    lower = {bounds[0], bounds[1], bounds[2]}, upper = {bounds[3], bounds[4], bounds[5]};

    bk_lightmap_desc lightmap_desc;
    bk_lightmap_desc_init(&lightmap_desc);
    lightmap_desc.texels_per_unit = options.texels_per_unit;
    lightmap_desc.page_size = options.page_size;
    bk_lightmap *new_lightmap = nullptr;
    check(bk_lightmap_create(scene.get(), &lightmap_desc, call_progress, user, &new_lightmap));
    lightmap.reset(new_lightmap);
    bk_lightmap_info_init(&pages);
    check(bk_lightmap_get_info(lightmap.get(), &pages));

    set_mode(options.mode, &progress);
    if (!is_lit()) warning = "no light in the scene: give some with --light";
    if (!warning.empty()) std::fprintf(stderr, "%s: %s\n", options.scene.c_str(), warning.c_str());
}

void LiveLight::load(const Options &options) {
    const bool is_file = options.scene.find('.') != std::string::npos;
    if (is_scene_file(options.scene)) {
        add(load_scene_file(options.scene));
    } else {
        check(is_file ? bk_scene_load_file(scene.get(), options.scene.c_str(), nullptr, nullptr, nullptr, nullptr)
                      : bk_scene_load_builtin(scene.get(), options.scene.c_str()));
        // The library does not tell the materials that it has loaded: they are drawn in grey.
        materials.emplace_back();
        material_of.resize(mesh_count());
    }
    add_lights(options);
}

void LiveLight::add(const SceneFile &file) {
    materials = file.materials;
    for (const Material &m : materials) {
        bk_material_desc desc;
        bk_material_desc_init(&desc);
        // Files do not say which side of a surface is meant to be seen, and often mean both.
        desc.flags = BK_MATERIAL_TWO_SIDED;
        for (int c = 0; c < 3; c++) desc.albedo[c] = m.albedo[c], desc.emission[c] = m.emission[c];
        check(bk_scene_add_material(scene.get(), &desc, nullptr));
    }
    for (const Mesh &m : file.meshes) {
        bk_mesh_desc desc;
        bk_mesh_desc_init(&desc);
        desc.positions = m.positions.data();
        desc.vertex_count = m.positions.size() / 3;
        desc.indices = m.indices.data();
        desc.triangle_count = m.indices.size() / 3;
        desc.triangle_materials = m.materials.data();
        if (!m.lightmap_uvs.empty()) {
            desc.lightmap_uvs = m.lightmap_uvs.data();
            desc.lightmap_page = m.pages.data();
        }
        check(bk_scene_add_mesh(scene.get(), &desc, nullptr));
        material_of.push_back(m.materials);
    }
}

void LiveLight::add_lights(const Options &options) {
    lights = options.lights;
    const auto emits = [](const Material &m) { return m.emission.x + m.emission.y + m.emission.z > 0; };
    if (is_scene_file(options.scene) && lights.empty() && std::none_of(materials.begin(), materials.end(), emits)) {
        warning = "no light in the scene emits, so a sun was added; --light adds others";
        Vec3 down{0.3f, 0.3f, 0.3f};
        down[options.up] = -1;
        lights.push_back({true, down, {20, 18, 15}});
    }
    // The first light of the command line is the one that can be switched; a file may bring others.
    for (const PlacedLight &light : lights) {
        const bk_light_desc desc = describe(light, false);
        uint32_t id;
        check(bk_scene_add_light(scene.get(), &desc, &id));
        if (&light == &lights[0]) first_light = id;
    }
}

// Whether any texel has light. The library does not tell whether the materials that it has loaded emit any.
bool LiveLight::is_lit() {
    bool any = false;
    everything(true, [&](const bk_rect &rect, const void *data) {
        const auto *halves = static_cast<const uint16_t *>(data);
        for (size_t i = 0; i < size_t(rect.width) * rect.height * 4 && !any; i++) any = i % 4 != 3 && halves[i] != 0;
    });
    return any;
}

bk_mesh_view LiveLight::geometry(uint32_t mesh) const {
    bk_mesh_view view;
    bk_mesh_view_init(&view);
    check(bk_scene_get_mesh(scene.get(), mesh, &view));
    return view;
}

void LiveLight::layout(uint32_t mesh, std::vector<float> &corner_uvs, std::vector<uint32_t> &page) const {
    const size_t triangles = geometry(mesh).triangle_count;
    corner_uvs.resize(6 * triangles);
    page.resize(triangles);
    check(bk_lightmap_mesh_uvs(lightmap.get(), mesh, corner_uvs.data(), page.data()));
}

void LiveLight::layout_of_backs(uint32_t mesh, std::vector<float> &corner_uvs, std::vector<uint32_t> &page) const {
    const size_t triangles = geometry(mesh).triangle_count;
    corner_uvs.resize(6 * triangles);
    page.resize(triangles);
    check(bk_lightmap_mesh_back_uvs(lightmap.get(), mesh, corner_uvs.data(), page.data(), nullptr));
}

void LiveLight::set_mode(Mode new_mode, const Progress *progress) {
    mode = new_mode;
    const uint32_t wanted = mode == Mode::position ? BK_LIVE_POSITION : BK_LIVE_VIEW;
    if (live && (mode == Mode::off || wanted == live_mode)) return; // off, and back on, keep what there is
    bk_live_params params;
    bk_live_params_init(&params);
    params.mode = wanted;
    params.quick_start = 1; // somebody waits for the first picture
    bk_live *new_live = nullptr;
    live.reset();
    check(bk_live_create(lightmap.get(), &params, progress ? call_progress : nullptr, const_cast<Progress *>(progress),
                         &new_live));
    live.reset(new_live);
    live_mode = wanted;
    top_lod = params.lod_count - 1;
}

void LiveLight::switch_light() {
    if (!can_switch()) return;
    switched_off = !switched_off;
    const bk_light_desc desc = describe(lights[0], switched_off);
    check(bk_scene_set_light(scene.get(), first_light, &desc));
    check(bk_live_light_changed(live.get(), first_light));
}

bk_live_stats LiveLight::update(const bk_camera &camera, float milliseconds, uint64_t max_dirty_bytes) {
    bk_budget budget;
    bk_budget_init(&budget);
    budget.milliseconds = mode == Mode::off ? 0 : milliseconds; // 0, and no number of rays: nothing is traced
    budget.max_dirty_bytes = max_dirty_bytes;
    bk_live_stats stats;
    bk_live_stats_init(&stats);
    check(bk_live_update(live.get(), &camera, &budget, &stats));
    return stats;
}

void LiveLight::read(const bk_rect &rect, bool direct, const Use &use) {
    texels.resize(size_t(rect.width) * rect.height * TEXEL_BYTES);
    const uint32_t layer = direct ? BK_LAYER_COMBINED : BK_LAYER_INDIRECT;
    check(bk_live_read(live.get(), rect.page, rect.lod, layer, BK_FORMAT_RGBA16F, &rect, texels.data(), 0));
    use(rect, texels.data());
}

void LiveLight::changes(bool direct, double milliseconds, const Use &use) {
    using Clock = std::chrono::steady_clock;
    const auto end = Clock::now() + std::chrono::duration<double, std::milli>(milliseconds);
    bk_rect rect;
    size_t count;
    do {
        check(bk_live_dirty_rects(live.get(), &rect, 1, &count));
        if (count) read(rect, direct, use);
    } while (count && Clock::now() < end);
}

void LiveLight::everything(bool direct, const Use &use) {
    for (uint32_t page = 0; page < pages.page_count; page++) {
        read({page, top_lod, 0, 0, pages.width, pages.height}, direct, use);
    }
}

std::vector<uint8_t> LiveLight::cells(bk_cell_info &info) const {
    bk_cell_info_init(&info);
    check(bk_live_cell_lods(live.get(), &info, nullptr, 0));
    std::vector<uint8_t> lods(size_t(info.dimensions[0]) * info.dimensions[1] * info.dimensions[2]);
    check(bk_live_cell_lods(live.get(), &info, lods.data(), lods.size()));
    return lods;
}
