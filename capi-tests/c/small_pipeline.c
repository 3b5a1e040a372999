/* Everything once, as small as it goes: for tools that watch memory and are slow (sanitize.sh). */
#include "check.h"

#include <stdlib.h>

static int32_t progress(void *user, float fraction, const char *stage) {
    (void)stage;
    ++*(int *)user;
    return fraction <= 1.0f;
}

/* Several calls come at a time. */
static int32_t memory(void *user, int64_t bytes) {
    __atomic_fetch_add((int64_t *)user, bytes, __ATOMIC_SEQ_CST);
    return 1;
}

int main(int argc, char **argv) {
    const char *folder = argc > 1 ? argv[1] : "";
    char path[1024], text[512];
    int reports = 0;
    int64_t held = 0;
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.num_threads = 2;
    desc.memory = memory;
    desc.user = &held;
    CHECK_OK(bk_device_create(&desc, &device));
    for (uint32_t compact = 0; compact < 2; compact++) {
        bk_scene *scene = NULL;
        bk_build_params build;
        bk_build_params_init(&build);
        build.compact = compact;
        build.quality = compact ? BK_BUILD_QUALITY_HIGH : BK_BUILD_QUALITY_DEFAULT;
        CHECK_OK(bk_scene_create(device, &scene));
        CHECK_OK(bk_scene_load_builtin(scene, "cornell"));
        CHECK_OK(bk_scene_set_build(scene, &build));
        CHECK_OK(bk_scene_commit(scene, progress, &reports));

        bk_mesh_view view;
        bk_mesh_view_init(&view);
        CHECK_OK(bk_scene_get_mesh(scene, 0, &view));
        float *moved = (float *)malloc(3 * sizeof(float) * view.vertex_count);
        memcpy(moved, view.positions, 3 * sizeof(float) * view.vertex_count);
        moved[1] += 0.01f;
        CHECK_OK(bk_mesh_set_positions(scene, 0, moved, view.vertex_count, 0));
        CHECK_OK(bk_scene_refit(scene));
        free(moved);

        bk_ray rays[40];
        bk_hit hits[40];
        for (int i = 0; i < 40; i++) {
            bk_ray ray = {{0.5f, 0.5f, 0.5f}, 0.0f, {0.01f * (float)i, 0.3f, 0.9f}, 1e30f};
            rays[i] = ray;
        }
        CHECK_OK(bk_intersect_many(scene, rays, 40, BK_RAYS_PARALLEL, hits));

        bk_photon_params photons;
        bk_photon_params_init(&photons);
        photons.photon_count = 500;
        bk_photon_map *map = NULL;
        bk_photon_view stored;
        bk_photon_view_init(&stored);
        CHECK_OK(bk_photon_map_create(scene, &photons, progress, &reports, &map));
        CHECK_OK(bk_photon_map_get_photons(map, &stored));
        bk_photon_map_release(map);

        bk_lightmap_desc layout;
        bk_lightmap_desc_init(&layout);
        layout.page_size = 32;
        layout.both_sides = compact;
        bk_lightmap *lightmap = NULL;
        CHECK_OK(bk_lightmap_create(scene, &layout, progress, &reports, &lightmap));
        bk_bake_params bake;
        bk_bake_params_init(&bake);
        bake.photon_count = 500;
        bake.gather_rays = 4;
        bake.direct_samples = 1;
        CHECK_OK(bk_bake(lightmap, &bake, progress, &reports, NULL));
        CHECK(bk_plan_describe(lightmap, text, sizeof text) > 0);
        float *texels = (float *)malloc(12 * 32 * 32);
        CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, texels, 0));
        for (uint32_t format = BK_FILE_EXR; format <= BK_FILE_GLB; format++) {
            CHECK_OK(bk_lightmap_save(lightmap, folder, format, progress, &reports));
        }

        bk_live_params params;
        bk_live_params_init(&params);
        params.photon_count = 500;
        params.max_rounds = 1;
        params.background = compact;
        bk_live *live = NULL;
        CHECK_OK(bk_live_create(lightmap, &params, progress, &reports, &live));
        bk_camera camera;
        bk_camera_init(&camera);
        camera.position[0] = camera.position[1] = camera.position[2] = 0.5f;
        bk_budget budget;
        bk_budget_init(&budget);
        budget.milliseconds = 0.0f;
        budget.rays = 2000;
        bk_light_desc light;
        bk_light_desc_init(&light);
        CHECK_OK(bk_live_update(live, &camera, &budget, NULL));
        if (bk_scene_light_count(scene) > 0) {
            light.position[1] = 0.5f;
            CHECK_OK(bk_scene_set_light(scene, 0, &light));
            CHECK_OK(bk_live_light_changed(live, 0));
            CHECK_OK(bk_live_update(live, &camera, &budget, NULL));
        }
        bk_rect rects[4];
        size_t count = 4;
        while (count == 4) {
            CHECK_OK(bk_live_dirty_rects(live, rects, 4, &count));
        }
        CHECK_OK(bk_live_read(live, 0, params.lod_count - 1, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, NULL, texels, 0));
        snprintf(path, sizeof path, "%slive", folder);
        CHECK_OK(bk_live_save(live, path, progress, &reports));
        CHECK_OK(bk_live_restore(live, path, progress, &reports));
        free(texels);
        bk_lightmap_release(lightmap);
        bk_scene_release(scene);
        bk_live_release(live);
    }
    bk_device_release(device);
    CHECK(reports > 0);
    CHECK(held == 0);
    return check_report("small_pipeline");
}
