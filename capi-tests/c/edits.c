/*
 * Edits: a light map follows its scene, and bakes again what has changed; that of a new scene keeps an old one's light.
 *
 *     edits
 */
#define _POSIX_C_SOURCE 200809L /* nanosleep */
#include "check.h"

#include <math.h>
#include <stdlib.h>
#include <time.h>

/* A room of 6 x 6 x 3 with a lamp, and a block that stands on its floor. Boxes of 8 vertices. */
static void box(const float lower[3], const float upper[3], float out[8][3]) {
    int i, axis;
    for (i = 0; i < 8; i++) {
        for (axis = 0; axis < 3; axis++) {
            out[i][axis] = (i >> axis & 1) ? upper[axis] : lower[axis];
        }
    }
}

static const uint32_t OUTWARD[12][3] = {{0, 2, 1}, {1, 2, 3}, {4, 5, 6}, {5, 7, 6}, {0, 1, 4}, {1, 5, 4},
                                        {2, 6, 3}, {3, 6, 7}, {0, 4, 2}, {2, 4, 6}, {1, 3, 5}, {3, 7, 5}};

static bk_scene *room_with(bk_device *device, int has_second_block) {
    static const float low[3] = {0, 0, 0}, high[3] = {6, 6, 3}, from[3] = {1, 1, 0}, to[3] = {1.5f, 1.5f, 0.8f};
    static const float second_from[3] = {4.5f, 5, 0}, second_to[3] = {5, 5.3f, 0.6f};
    float walls[8][3], block[8][3], second[8][3];
    uint32_t inward[12][3];
    bk_scene *scene = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh;
    bk_light_desc light;
    int i;
    for (i = 0; i < 12; i++) {
        inward[i][0] = OUTWARD[i][0], inward[i][1] = OUTWARD[i][2], inward[i][2] = OUTWARD[i][1];
    }
    box(low, high, walls);
    box(from, to, block);
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = walls[0];
    mesh.vertex_count = 8;
    mesh.indices = inward[0];
    mesh.triangle_count = 12;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    mesh.positions = block[0];
    mesh.indices = OUTWARD[0];
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    if (has_second_block) {
        box(second_from, second_to, second);
        mesh.positions = second[0];
        CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    }
    bk_light_desc_init(&light);
    light.type = BK_LIGHT_POINT;
    light.position[0] = light.position[1] = 3;
    light.position[2] = 2.5f;
    light.color[0] = light.color[1] = light.color[2] = 10;
    CHECK_OK(bk_scene_add_light(scene, &light, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

static bk_scene *room(bk_device *device) { return room_with(device, 0); }

static void move_block(bk_scene *scene, float x) {
    const float lower[3] = {x, 1, 0}, upper[3] = {x + 0.5f, 1.5f, 0.8f};
    float block[8][3];
    box(lower, upper, block);
    CHECK_OK(bk_mesh_set_positions(scene, 1, block[0], 8, 0));
    CHECK_OK(bk_scene_refit(scene));
}

/* Updates until all is finished. */
static void finish(bk_live *live) {
    bk_camera camera;
    bk_budget budget;
    bk_live_stats stats;
    int i;
    bk_camera_init(&camera);
    bk_budget_init(&budget);
    bk_live_stats_init(&stats);
    budget.milliseconds = 100;
    for (i = 0; i < 20000 && (i == 0 || stats.finished < 1 || stats.light_pending); i++) {
        CHECK_OK(bk_live_update(live, &camera, &budget, &stats));
        if (stats.milliseconds < 5) {
            /* Photons are on their way, on a thread that waits during updates. */
            const struct timespec pause = {0, 5000000};
            nanosleep(&pause, NULL);
        }
    }
    CHECK(stats.finished == 1 && !stats.light_pending);
}

/* The combined light of page 0 as live light shows it; the caller frees it. */
static float *shown_by(const bk_live *live, const bk_lightmap *map) {
    bk_lightmap_info info;
    float *page;
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(map, &info));
    page = malloc((size_t)info.width * info.height * 3 * sizeof *page);
    CHECK_OK(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, NULL, page, 0));
    return page;
}

/* The combined light of page 0; the caller frees it. */
static float *light_of(const bk_lightmap *map, size_t *count) {
    bk_lightmap_info info;
    float *page;
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(map, &info));
    *count = (size_t)info.width * info.height * 3;
    page = malloc(*count * sizeof *page);
    CHECK_OK(bk_lightmap_read(map, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, page, 0));
    return page;
}

static double difference(const float *a, const float *b, size_t count) {
    double sum = 0, all = 0;
    size_t i;
    for (i = 0; i < count; i++) {
        sum += fabs((double)a[i] - b[i]);
        all += b[i];
    }
    return sum / all;
}

/* Live light of a new scene keeps that of the old one's. */
static void revise_live(bk_lightmap *old, bk_lightmap *new) {
    bk_live_params params;
    bk_live *live = NULL, *another = NULL, *refused = NULL;
    bk_live_stats stats;
    bk_camera camera;
    bk_lightmap_info info;
    float *shown[4];
    size_t count;
    int i;
    bk_live_params_init(&params);
    params.mode = BK_LIVE_UNIFORM;
    params.photon_count = 50000;
    params.max_rounds = 1;
    params.quick_start = 1;
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(new, &info));
    count = (size_t)info.width * info.height * 3;
    CHECK_OK(bk_live_create(old, &params, NULL, NULL, &live));
    finish(live);
    CHECK_ERROR(bk_live_create_from(new, live, NAN, NULL, NULL, &refused), BK_ERROR_INVALID_ARGUMENT, "keep_error");
    CHECK_ERROR(bk_live_create_from(NULL, live, 0, NULL, NULL, &refused), BK_ERROR_INVALID_ARGUMENT, "lightmap");
    CHECK_ERROR(bk_live_create_from(new, NULL, 0, NULL, NULL, &refused), BK_ERROR_INVALID_ARGUMENT, "earlier");
    CHECK_ERROR(bk_live_create_from(new, live, 0, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "out");
    CHECK(refused == NULL);
    CHECK_OK(bk_live_create_from(new, live, 0.03f, NULL, NULL, &another));
    bk_live_release(live);
    bk_live_stats_init(&stats);
    bk_camera_init(&camera);
    CHECK_OK(bk_live_update(another, &camera, NULL, &stats));
    shown[0] = shown_by(another, new);
    finish(another);
    shown[1] = shown_by(another, new);
    bk_live_release(another);
    CHECK_OK(bk_live_create(new, &params, NULL, NULL, &live));
    shown[2] = shown_by(live, new);
    finish(live);
    shown[3] = shown_by(live, new);
    bk_live_release(live);
    CHECK(difference(shown[1], shown[3], count) < 0.005);
    CHECK(difference(shown[0], shown[3], count) < 0.5 * difference(shown[2], shown[3], count));
    for (i = 0; i < 4; i++) {
        free(shown[i]);
    }
}

/* A new scene has a block more: its light map keeps light of the old one's. */
static void revise(bk_device *device, const bk_lightmap_desc *desc) {
    bk_scene *scenes[2];
    bk_lightmap *maps[2] = {NULL, NULL}, *another = NULL, *refused = NULL;
    bk_lightmap_info info;
    bk_bake_params params;
    bk_bake_stats stats;
    float *kept, *fresh, *again;
    size_t count = 0;
    int i;
    bk_bake_params_init(&params);
    params.photon_count = 50000;
    bk_bake_stats_init(&stats);
    for (i = 0; i < 2; i++) {
        scenes[i] = room_with(device, i);
        CHECK_OK(bk_lightmap_create(scenes[i], desc, NULL, NULL, &maps[i]));
    }
    /* Where there is no light to be kept, all is baked. */
    CHECK_OK(bk_bake_changed_from(maps[1], maps[0], &params, 0.03f, NULL, NULL, &stats));
    CHECK(stats.kept_texels == 0);
    fresh = light_of(maps[1], &count);

    CHECK_OK(bk_bake(maps[0], &params, NULL, NULL, NULL));
    CHECK_OK(bk_lightmap_create_from(scenes[1], desc, maps[0], NULL, NULL, &another));
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(maps[1], &info));
    CHECK(info.kept_charts == 0);
    CHECK_OK(bk_lightmap_get_info(another, &info));
    CHECK(info.kept_charts > 0 && info.kept_charts < info.charts);
    CHECK_OK(bk_bake_changed_from(another, maps[0], &params, 0.03f, NULL, NULL, &stats));
    CHECK(stats.kept_texels > info.texels / 10 && stats.kept_texels < info.texels);
    kept = light_of(another, &count);
    CHECK(difference(kept, fresh, count) < 0.005);

    /* Refused, and nothing lost. */
    CHECK_ERROR(bk_lightmap_create_from(scenes[1], desc, NULL, NULL, NULL, &refused), BK_ERROR_INVALID_ARGUMENT,
                "earlier is NULL");
    CHECK(refused == NULL);
    CHECK_ERROR(bk_lightmap_create_from(NULL, desc, maps[0], NULL, NULL, &refused), BK_ERROR_INVALID_ARGUMENT, "scene");
    CHECK_ERROR(bk_bake_changed_from(another, another, &params, 0.03f, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT,
                "bk_bake_changed");
    CHECK_ERROR(bk_bake_changed_from(another, NULL, &params, 0.03f, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT,
                "earlier is NULL");
    CHECK_ERROR(bk_bake_changed_from(NULL, maps[0], &params, 0.03f, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT,
                "lightmap");
    CHECK_ERROR(bk_bake_changed_from(another, maps[0], &params, NAN, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT,
                "keep_error");
    params.checkpoint = "no-checkpoint";
    CHECK_ERROR(bk_bake_changed_from(another, maps[0], &params, 0.03f, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT,
                "checkpoint");
    params.checkpoint = NULL;
    params.texel_begin = 5;
    CHECK_ERROR(bk_bake_changed_from(another, maps[0], &params, 0.03f, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT,
                "all texels");
    again = light_of(another, &count);
    CHECK(memcmp(kept, again, count * sizeof *kept) == 0);

    revise_live(maps[0], another);

    free(kept), free(fresh), free(again);
    for (i = 0; i < 2; i++) {
        bk_lightmap_release(maps[i]);
        bk_scene_release(scenes[i]);
    }
    bk_lightmap_release(another);
}

int main(void) {
    bk_device *device = NULL;
    bk_scene *scene, *other;
    bk_lightmap *map = NULL;
    bk_lightmap_desc desc;
    bk_lightmap_info before, after;
    bk_bake_params params;
    bk_bake_stats stats;
    bk_live *live = NULL;
    bk_live_params live_params;
    float *old, *kept, *changed, *fresh, *followed;
    size_t count = 0;
    char plan[8192];
    CHECK_OK(bk_device_create(NULL, &device));
    scene = room(device);
    other = room(device);
    bk_lightmap_desc_init(&desc);
    desc.texels_per_unit = 16;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &map));
    bk_lightmap_info_init(&before);
    CHECK_OK(bk_lightmap_get_info(map, &before));
    bk_bake_params_init(&params);
    params.photon_count = 50000;
    params.stitch = 0;
    bk_bake_stats_init(&stats);

    /* Without light all is baked; again, nothing is. */
    CHECK_OK(bk_bake_changed(map, &params, 0.05f, NULL, NULL, &stats));
    CHECK(stats.kept_texels == 0);
    old = light_of(map, &count);
    CHECK_OK(bk_bake_changed(map, &params, 0.05f, NULL, NULL, &stats));
    CHECK(stats.kept_texels == before.texels);
    kept = light_of(map, &count);
    CHECK(memcmp(old, kept, count * sizeof *old) == 0);

    /* Pages stay, and so does the light until it is baked. */
    move_block(scene, 2.0f);
    CHECK_OK(bk_lightmap_follow(map, scene, NULL, NULL));
    CHECK_OK(bk_lightmap_follow(map, scene, NULL, NULL));
    bk_lightmap_info_init(&after);
    CHECK_OK(bk_lightmap_get_info(map, &after));
    CHECK(after.texels == before.texels && after.page_count == before.page_count && after.width == before.width);
    free(kept);
    kept = light_of(map, &count);
    CHECK_OK(bk_bake_changed(map, &params, 0.03f, NULL, NULL, &stats));
    changed = light_of(map, &count);
    CHECK(stats.kept_texels > before.texels / 10 && stats.kept_texels < before.texels);
    CHECK(bk_plan_describe(map, plan, sizeof plan) > 0 && strstr(plan, "left out: light of") != NULL);
    CHECK_OK(bk_bake(map, &params, NULL, NULL, &stats));
    CHECK(stats.kept_texels == 0);
    fresh = light_of(map, &count);
    CHECK(difference(old, kept, count) < 0.01);
    CHECK(difference(changed, fresh, count) < 0.005);
    CHECK(difference(old, fresh, count) > 4 * difference(changed, fresh, count));

    /* Refused, and nothing lost. */
    CHECK_ERROR(bk_lightmap_follow(map, other, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "another scene");
    CHECK_ERROR(bk_lightmap_follow(map, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "scene");
    CHECK_ERROR(bk_lightmap_follow(NULL, scene, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "lightmap");
    CHECK_ERROR(bk_bake_changed(map, &params, -1.0f, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "keep_error");
    CHECK_ERROR(bk_bake_changed(map, &params, NAN, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "keep_error");
    params.checkpoint = "no-checkpoint";
    CHECK_ERROR(bk_bake_changed(map, &params, 0.03f, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "checkpoint");
    params.checkpoint = NULL;
    params.texel_end = 5;
    CHECK_ERROR(bk_bake_changed(map, &params, 0.03f, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "all texels");
    params.texel_end = 0;
    /* Other parameters: all is baked. */
    params.gather_rays = 32;
    CHECK_OK(bk_bake_changed(map, &params, 10.0f, NULL, NULL, &stats));
    CHECK(stats.kept_texels == 0);

    revise(device, &desc);

    /* Live light follows. */
    bk_live_params_init(&live_params);
    live_params.mode = BK_LIVE_UNIFORM;
    live_params.photon_count = 50000;
    live_params.max_rounds = 1;
    live_params.lod_count = 3;
    CHECK_OK(bk_live_create(map, &live_params, NULL, NULL, &live));
    finish(live);
    free(old), free(fresh);
    old = shown_by(live, map);
    move_block(scene, 1.0f);
    CHECK_OK(bk_live_follow(live, map, 0.03f, NULL, NULL));
    CHECK_OK(bk_lightmap_follow(map, scene, NULL, NULL));
    CHECK_ERROR(bk_live_follow(live, map, -0.5f, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "keep_error");
    CHECK_ERROR(bk_live_follow(live, map, NAN, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "keep_error");
    CHECK_ERROR(bk_live_follow(live, NULL, 0.03f, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "lightmap");
    CHECK_ERROR(bk_live_follow(NULL, map, 0.03f, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "live");
    CHECK_OK(bk_live_follow(live, map, 0.03f, NULL, NULL));
    finish(live);
    followed = shown_by(live, map);
    bk_live_release(live);
    CHECK_OK(bk_live_create(map, &live_params, NULL, NULL, &live));
    finish(live);
    fresh = shown_by(live, map);
    CHECK(difference(followed, fresh, count) < 0.005);
    CHECK(difference(old, fresh, count) > 4 * difference(followed, fresh, count));
    /* One of another light map of the same scene. */
    {
        bk_lightmap *another = NULL;
        CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &another));
        CHECK_ERROR(bk_live_follow(live, another, 0.03f, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "another light map");
        bk_lightmap_release(another);
    }
    bk_live_release(live);

    free(old), free(kept), free(changed), free(fresh), free(followed);
    bk_lightmap_release(map);
    bk_scene_release(scene);
    bk_scene_release(other);
    bk_device_release(device);
    return check_report("edits");
}
