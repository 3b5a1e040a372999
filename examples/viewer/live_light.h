// All that the viewer asks of bakelite: a scene, its light map, and the light map's live updates.
#pragma once

#include "options.h"
#include "scene_file.h"

#include <bakelite.h>
#include <functional>
#include <memory>

// Told how far loading is, on any thread; false cancels.
using Progress = std::function<bool(float fraction, const char *stage)>;

// Of a texel as the viewer reads it: four half floats.
constexpr size_t TEXEL_BYTES = 8;

class LiveLight {
public:
    // Loads the scene and gives it light; takes seconds. Throws bakelite's sentence if something fails.
    LiveLight(const Options &options, const Progress &progress);

    // ---- The scene ----
    std::vector<Material> materials;
    std::vector<PlacedLight> lights; // those of the command line
    Vec3 lower, upper;               // bounding box
    std::string warning;             // that nothing shines, or nothing of a file did; else empty

    uint32_t mesh_count() const { return bk_scene_mesh_count(scene.get()); }
    bk_mesh_view geometry(uint32_t mesh) const;
    // Numbers in `materials`, one per triangle.
    const std::vector<uint32_t> &triangle_materials(uint32_t mesh) const { return material_of[mesh]; }

    // ---- The light map ----
    bk_lightmap_info pages;
    // Where a mesh lies in it: two numbers per corner, and a page (or BK_NONE) per triangle.
    void layout(uint32_t mesh, std::vector<float> &corner_uvs, std::vector<uint32_t> &page) const;
    // The same for the backs of its triangles: those without a place of their own show the light of the front.
    void layout_of_backs(uint32_t mesh, std::vector<float> &corner_uvs, std::vector<uint32_t> &page) const;

    // ---- Live updates ----
    // Between view- and position-based updates, light begins anew from the lowest LOD; `progress` is told how far
    // that is.
    void set_mode(Mode mode, const Progress *progress = nullptr);
    bool can_switch() const { return !lights.empty(); }
    // Switches the first light off and on.
    void switch_light();
    bool is_switched_off() const { return switched_off; }
    // Makes the light map better, where this camera makes worthwhile, for about so long.
    // At most so many bytes of texels are to be uploaded afterwards; 0: any number.
    bk_live_stats update(const bk_camera &camera, float milliseconds, uint64_t max_dirty_bytes);
    // What of the light map is another than at the last call: use() gets rectangles and their texels,
    // four half floats each. Without `direct`, only light that came by way of other surfaces. After about
    // so many milliseconds the rest is left to the next call.
    using Use = std::function<void(const bk_rect &, const void *texels)>;
    void changes(bool direct, double milliseconds, const Use &use);
    // The same for all pages, changed or not.
    void everything(bool direct, const Use &use);
    uint32_t highest_lod() const { return top_lod; }
    // The LODs that the cells of the scene show; 255 where there is nothing.
    std::vector<uint8_t> cells(bk_cell_info &info) const;

private:
    // bakelite counts references; what is made from an object keeps that object alive.
    struct Release {
        void operator()(bk_device *p) const { bk_device_release(p); }
        void operator()(bk_scene *p) const { bk_scene_release(p); }
        void operator()(bk_lightmap *p) const { bk_lightmap_release(p); }
        void operator()(bk_live *p) const { bk_live_release(p); }
    };
    template <class T> using Handle = std::unique_ptr<T, Release>;

    void load(const Options &options);
    void add(const SceneFile &file);
    void add_lights(const Options &options);
    bool is_lit();
    void read(const bk_rect &rect, bool direct, const Use &use);

    Handle<bk_scene> scene;
    Handle<bk_lightmap> lightmap;
    Handle<bk_live> live;
    std::vector<std::vector<uint32_t>> material_of;
    std::vector<uint8_t> texels;
    Mode mode = Mode::off;
    uint32_t live_mode = BK_LIVE_VIEW, top_lod = 0, first_light = 0;
    bool switched_off = false;
};
