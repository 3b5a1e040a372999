/*
 * Live updates in C99: bad input, two threads at once, reading, saving and restoring, and a soak: many
 * updates with a moving camera and lights that are switched, after which neither memory has grown nor
 * light drifted.
 *
 *     live OUT_PREFIX [UPDATES]
 */
#define _POSIX_C_SOURCE 200809L /* threads and clocks */
#include "check.h"

#include <float.h>
#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <time.h>

enum { PAGE = 128, LIGHTS = 2 };

static const char *prefix = "";

/* ---- Accounts ---- */

struct accounts {
    pthread_mutex_t lock;
    int64_t bytes;
};

static int32_t on_memory(void *user, int64_t bytes) {
    struct accounts *a = (struct accounts *)user;
    pthread_mutex_lock(&a->lock);
    a->bytes += bytes;
    pthread_mutex_unlock(&a->lock);
    return 1;
}

/* Resident memory of the process in bytes; 0 where that cannot be told. */
static long resident(void) {
    long pages = 0;
    FILE *f = fopen("/proc/self/statm", "r");
    if (f == NULL) return 0;
    if (fscanf(f, "%*s %ld", &pages) != 1) pages = 0;
    fclose(f);
    return pages * 4096;
}

/* ---- The scene: a closed box, 2 x 2 x 2, with two lamps in it ---- */

static bk_light_desc lamp(int i, float power) {
    bk_light_desc light;
    bk_light_desc_init(&light);
    light.type = BK_LIGHT_POINT;
    light.position[0] = i == 0 ? -0.5f : 0.6f;
    light.position[1] = 0.3f;
    light.position[2] = 1.5f;
    light.color[0] = power;
    light.color[1] = power * (i == 0 ? 1.0f : 0.5f);
    light.color[2] = power * 0.7f;
    return light;
}

static bk_scene *make_scene(bk_device *device) {
    static const float corners[8][3] = {
        {-1, -1, 0}, {1, -1, 0}, {-1, 1, 0}, {1, 1, 0}, {-1, -1, 2}, {1, -1, 2}, {-1, 1, 2}, {1, 1, 2},
    };
    static const uint32_t triangles[12][3] = {
        {0, 1, 3}, {0, 3, 2}, {4, 6, 7}, {4, 7, 5}, {2, 3, 7}, {2, 7, 6},
        {0, 2, 6}, {0, 6, 4}, {1, 5, 7}, {1, 7, 3}, {0, 4, 5}, {0, 5, 1},
    };
    bk_scene *scene = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh;
    int i;

    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = corners[0];
    mesh.vertex_count = 8;
    mesh.indices = triangles[0];
    mesh.triangle_count = 12;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    for (i = 0; i < LIGHTS; i++) {
        bk_light_desc light = lamp(i, 5.0f);
        CHECK_OK(bk_scene_add_light(scene, &light, NULL));
    }
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

static bk_lightmap *make_lightmap(bk_scene *scene) {
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;
    bk_lightmap_desc_init(&desc);
    desc.page_size = PAGE;
    desc.texels_per_unit = 16.0f;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    return lightmap;
}

static bk_live_params quick(void) {
    bk_live_params params;
    bk_live_params_init(&params);
    params.mode = BK_LIVE_POSITION;
    params.photon_count = 20000;
    params.max_rounds = 2;
    params.seed = 3;
    return params;
}

static bk_camera camera_at(int i) {
    bk_camera camera;
    bk_camera_init(&camera);
    camera.position[0] = 0.3f * sinf(0.01f * (float)i);
    camera.position[2] = 1.0f;
    camera.forward[0] = cosf(0.1f * (float)i);
    camera.forward[1] = sinf(0.1f * (float)i);
    camera.forward[2] = 0.8f * sinf(0.037f * (float)i);
    camera.up[1] = 0.0f;
    camera.up[2] = 1.0f;
    camera.fov_y = 1.4f;
    return camera;
}

static uint32_t page_count(bk_lightmap *lightmap) {
    bk_lightmap_info info;
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(lightmap, &info));
    return info.page_count;
}

/* Sum of all that is shown, over the pages. */
static double energy(bk_live *live, uint32_t pages) {
    static float texels[PAGE * PAGE][3];
    double sum = 0.0;
    uint32_t page;
    int i, wrong = 0;
    for (page = 0; page < pages; page++) {
        CHECK_OK(bk_live_read(live, page, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, NULL, texels, 0));
        for (i = 0; i < PAGE * PAGE; i++) {
            const float *t = texels[i];
            wrong += !(t[0] >= 0.0f && t[1] >= 0.0f && t[2] >= 0.0f && t[0] + t[1] + t[2] < FLT_MAX);
            sum += t[0] + t[1] + t[2];
        }
    }
    CHECK(wrong == 0);
    return sum;
}

/* Updates until all is done under the lights of now. */
static void finish(bk_live *live) {
    bk_live_stats stats;
    bk_budget budget;
    int i;
    bk_live_stats_init(&stats);
    bk_budget_init(&budget);
    budget.milliseconds = 50.0f;
    for (i = 0; i < 10000; i++) {
        bk_camera camera = camera_at(i);
        CHECK_OK(bk_live_update(live, &camera, &budget, &stats));
        if (stats.finished == 1.0f && stats.light_pending == 0) break;
    }
    CHECK(stats.finished == 1.0f);
    /* What was promoted last is still fading in. */
    budget.milliseconds = 1000.0f;
    for (i = 0; i < 100 && stats.blocks_changed > 0; i++) {
        bk_camera camera = camera_at(0);
        CHECK_OK(bk_live_update(live, &camera, &budget, &stats));
    }
}

/* ---- Bad input ---- */

static void bad_input(bk_scene *scene, bk_lightmap *lightmap) {
    const bk_result refused = BK_ERROR_INVALID_ARGUMENT;
    bk_live *live = NULL;
    bk_live_params params = quick();
    bk_camera good = camera_at(0), camera;
    bk_budget budget;
    bk_live_stats stats;
    bk_rect rect, rects[4];
    bk_cell_info info;
    float texels[16][3], nowhere[3] = {100.0f, 0.0f, 0.0f}, nan3[3];
    uint8_t few[1];
    size_t count = 77;
    double before;
    uint32_t pages = page_count(lightmap);

    bk_live_stats_init(&stats);
    bk_cell_info_init(&info);
    bk_budget_init(&budget);
    CHECK(budget.milliseconds == 4.0f && budget.rays == 0 && budget.max_dirty_bytes == 0);
    nan3[0] = nan3[1] = nan3[2] = NAN;

    CHECK_ERROR(bk_live_create(NULL, &params, NULL, NULL, &live), refused, "lightmap");
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, NULL), refused, "out");
    params.struct_size = 0;
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, &live), refused, "struct_size");
    params = quick();
    params.mode = 17;
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, &live), refused, "mode is 17");
    params = quick();
    params.lod_count = 5;
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, &live), refused, "lod_count is 5");
    params = quick();
    params.promote_threshold = 3;
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, &live), refused, "promote_threshold is 3");
    params = quick();
    params.cell_size = -1.0f;
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, &live), refused, "cell_size");
    params.cell_size = 1e-6f;
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, &live), refused, "cell_size");
    params = quick();
    params.background = 2;
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, &live), refused, "background");
    params = quick();
    params.blur = 1000;
    CHECK_ERROR(bk_live_create(lightmap, &params, NULL, NULL, &live), refused, "blur");
    CHECK(live == NULL);

    params = quick();
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &live));
    before = energy(live, pages);
    CHECK(before > 0.0);

    CHECK_ERROR(bk_live_update(NULL, &good, NULL, NULL), refused, "live");
    CHECK_ERROR(bk_live_update(live, NULL, NULL, NULL), refused, "camera");
#define REFUSED_CAMERA(field, value) \
    camera = good;                   \
    camera.field = (value);          \
    CHECK_ERROR(bk_live_update(live, &camera, &budget, &stats), refused, "camera")
    REFUSED_CAMERA(position[1], NAN);
    REFUSED_CAMERA(forward[0], INFINITY);
    REFUSED_CAMERA(up[2], NAN);
    REFUSED_CAMERA(fov_y, 0.0f);
    REFUSED_CAMERA(fov_y, -1.0f);
    REFUSED_CAMERA(fov_y, 3.2f);
    REFUSED_CAMERA(fov_y, NAN);
    REFUSED_CAMERA(width, 0);
    REFUSED_CAMERA(height, 0);
    REFUSED_CAMERA(struct_size, 4);
    camera = good;
    memcpy(camera.up, camera.forward, sizeof camera.up);
    CHECK_ERROR(bk_live_update(live, &camera, &budget, &stats), refused, "parallel");
    budget.milliseconds = -1.0f;
    CHECK_ERROR(bk_live_update(live, &good, &budget, &stats), refused, "milliseconds");
    budget.milliseconds = NAN;
    CHECK_ERROR(bk_live_update(live, &good, &budget, &stats), refused, "milliseconds");
    budget.milliseconds = 0.0f;
    budget.max_dirty_bytes = 1023;
    CHECK_ERROR(bk_live_update(live, &good, &budget, &stats), refused, "max_dirty_bytes is 1023");
    budget.max_dirty_bytes = 0;
    CHECK_OK(bk_live_update(live, &good, &budget, &stats));
    CHECK(stats.rays == 0 && stats.blocks_changed == 0);
    CHECK(stats.dirty_bytes == (uint64_t)8 * PAGE * PAGE * page_count(lightmap) && stats.dirty_bytes_left == 0);

    CHECK_ERROR(bk_live_dirty_rects(live, rects, 4, NULL), refused, "count");
    CHECK_ERROR(bk_live_dirty_rects(live, NULL, 4, &count), refused, "out");
    CHECK_OK(bk_live_dirty_rects(live, NULL, 0, &count));
    CHECK(count == 0);
    CHECK_OK(bk_live_dirty_rects(live, rects, 1, &count));
    CHECK(count == 1 && rects[0].width == PAGE && rects[0].height == PAGE && rects[0].lod == 2);

    memset(&rect, 0, sizeof rect);
    rect.width = rect.height = 4;
    CHECK_OK(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, &rect, texels, 0));
    CHECK_OK(bk_live_read(live, 0, 0, BK_LAYER_INDIRECT, BK_FORMAT_RGBA16F, &rect, texels, 40));
    CHECK_ERROR(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, &rect, NULL, 0), refused, "dst");
    CHECK_ERROR(bk_live_read(live, 0, 3, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, &rect, texels, 0), refused, "lod is 3");
    CHECK_ERROR(bk_live_read(live, pages, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, &rect, texels, 0), refused, "pages");
    CHECK_ERROR(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_R32U, &rect, texels, 0), refused, "format");
    CHECK_ERROR(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, 99, &rect, texels, 0), refused, "format");
    CHECK_ERROR(bk_live_read(live, 0, 2, BK_LAYER_NORMAL, BK_FORMAT_RGB32F, &rect, texels, 0), refused, "layer is Normal");
    CHECK_ERROR(bk_live_read(live, 0, 2, 99, BK_FORMAT_RGB32F, &rect, texels, 0), refused, "layer is 99");
    CHECK_ERROR(bk_live_read(live, 0, 2, BK_LAYER_L0, BK_FORMAT_RGB32F, &rect, texels, 0), BK_ERROR_INVALID_STATE,
                "without light by direction");
    CHECK_ERROR(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, &rect, texels, 47), refused, "row_stride is 47");
    rect.x = PAGE - 3;
    CHECK_ERROR(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, &rect, texels, 0), refused, "not within");
    rect.x = UINT32_MAX;
    CHECK_ERROR(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, &rect, texels, 0), refused, "not within");

    CHECK_OK(bk_live_cell_lods(live, &info, NULL, 0));
    CHECK(info.dimensions[0] * info.dimensions[1] * info.dimensions[2] > 1 && info.cell_size > 0.0f);
    CHECK_ERROR(bk_live_cell_lods(live, &info, few, 1), refused, "capacity is 1");
    CHECK_ERROR(bk_live_cell_lods(live, NULL, NULL, 0), refused, "info");
    CHECK(bk_live_lod_at(live, nowhere) == BK_NONE);
    CHECK(bk_live_lod_at(live, nan3) == BK_NONE);
    CHECK(bk_live_lod_at(live, NULL) == BK_NONE);
    CHECK_ERROR(bk_live_light_changed(live, LIGHTS), refused, "light 2");
    CHECK_ERROR(bk_live_pause(live, 2), refused, "paused");
    CHECK_ERROR(bk_live_save(live, NULL, NULL, NULL), refused, "path");
    CHECK_ERROR(bk_live_save(live, "no/such/folder/state", NULL, NULL), BK_ERROR_IO, "no/such/folder");
    CHECK_ERROR(bk_live_restore(live, "no/such/file", NULL, NULL), BK_ERROR_IO, "no/such/file");
    CHECK(energy(live, pages) == before);

    /* Inside a wall, outside, far away: there is little or nothing to see, and no harm. */
    bk_budget_init(&budget);
    camera = good;
    camera.position[2] = 0.0f;
    CHECK_OK(bk_live_update(live, &camera, &budget, &stats));
    camera.position[2] = 100.0f;
    CHECK_OK(bk_live_update(live, &camera, &budget, &stats));
    camera.position[2] = 1e18f;
    CHECK_OK(bk_live_update(live, &camera, &budget, NULL));
    bk_live_retain(live);
    bk_live_release(live);
    bk_live_release(live);
    bk_live_release(NULL);
    bk_live_retain(NULL);
    (void)scene;
}

/* ---- All lights out, and on again ---- */

static void switch_light(bk_scene *scene, bk_live *live, int i, float power) {
    bk_light_desc light = lamp(i, power);
    CHECK_OK(bk_scene_set_light(scene, (uint32_t)i, &light));
    CHECK_OK(bk_live_light_changed(live, (uint32_t)i));
}

static void lights_out(bk_scene *scene, bk_lightmap *lightmap) {
    bk_live *live = NULL;
    bk_live_params params = quick();
    uint32_t pages = page_count(lightmap);
    double lit;
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &live));
    finish(live);
    lit = energy(live, pages);
    switch_light(scene, live, 0, 0.0f);
    switch_light(scene, live, 1, 0.0f);
    finish(live);
    CHECK(energy(live, pages) == 0.0);
    switch_light(scene, live, 0, 5.0f);
    switch_light(scene, live, 1, 5.0f);
    finish(live);
    CHECK(energy(live, pages) == lit);
    bk_live_release(live);

    /* Nothing shines at first. */
    {
        bk_light_desc dark = lamp(0, 0.0f), other = lamp(1, 0.0f);
        CHECK_OK(bk_scene_set_light(scene, 0, &dark));
        CHECK_OK(bk_scene_set_light(scene, 1, &other));
    }
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &live));
    finish(live);
    CHECK(energy(live, pages) == 0.0);
    switch_light(scene, live, 0, 5.0f);
    switch_light(scene, live, 1, 5.0f);
    finish(live);
    CHECK(energy(live, pages) == lit);
    bk_live_release(live);
}

/* ---- Two threads at once ---- */

struct at_once {
    bk_live *live;
    int done, refused, other;
};

static void *update_often(void *user) {
    struct at_once *a = (struct at_once *)user;
    bk_budget budget;
    int i;
    bk_budget_init(&budget);
    budget.milliseconds = 1.0f;
    for (i = 0; i < 300; i++) {
        bk_camera camera = camera_at(i);
        bk_result result = bk_live_update(a->live, &camera, &budget, NULL);
        a->done += result == BK_OK;
        a->refused += result == BK_ERROR_INVALID_STATE && strstr(bk_last_error(), "at the same time") != NULL;
        a->other += result != BK_OK && result != BK_ERROR_INVALID_STATE;
    }
    return NULL;
}

static void two_threads(bk_lightmap *lightmap) {
    bk_live *live = NULL, *alone = NULL;
    bk_live_params params = quick();
    struct at_once a[2];
    pthread_t threads[2];
    uint32_t pages = page_count(lightmap);
    int i;
    memset(a, 0, sizeof a);
    params.background = 1;
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &live));
    for (i = 0; i < 2; i++) {
        a[i].live = live;
        CHECK(pthread_create(&threads[i], NULL, update_often, &a[i]) == 0);
    }
    for (i = 0; i < 2; i++) {
        pthread_join(threads[i], NULL);
        CHECK(a[i].done + a[i].refused == 300 && a[i].other == 0);
    }
    CHECK(a[0].done + a[1].done > 0 && a[0].refused + a[1].refused > 0);
    finish(live);
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &alone));
    finish(alone);
    CHECK(energy(live, pages) == energy(alone, pages));
    bk_live_release(live);
    bk_live_release(alone);
}

/* ---- Saving and restoring ---- */

static void save_and_restore(bk_lightmap *lightmap) {
    bk_live *live = NULL, *other = NULL;
    bk_live_params params = quick();
    uint32_t pages = page_count(lightmap);
    char path[4096];
    snprintf(path, sizeof path, "%sstate", prefix);
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &live));
    finish(live);
    CHECK_OK(bk_live_save(live, path, NULL, NULL));
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &other));
    CHECK(energy(other, pages) != energy(live, pages));
    CHECK_OK(bk_live_restore(other, path, NULL, NULL));
    CHECK(energy(other, pages) == energy(live, pages));
    bk_live_release(other);
    params.seed = 4;
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &other));
    CHECK_ERROR(bk_live_restore(other, path, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "other parameters");
    bk_live_release(other);
    bk_live_release(live);
    CHECK(remove(path) == 0);
}

/* ---- Soak ---- */

static void soak(bk_scene *scene, bk_lightmap *lightmap, int updates, struct accounts *accounts) {
    bk_live *live = NULL;
    bk_live_params params = quick();
    bk_live_stats stats;
    bk_budget budget;
    bk_rect rects[16];
    uint32_t pages = page_count(lightmap);
    double first, brightest = 0.0, dimmest = DBL_MAX;
    int64_t held = 0, most = 0;
    long warm = 0, end;
    int i, settle = updates / 10 < 500 ? updates / 10 : 500;

    bk_live_stats_init(&stats);
    bk_budget_init(&budget);
    budget.milliseconds = 0.0f;
    budget.rays = 3000;
    params.background = 1;
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &live));
    finish(live);
    first = energy(live, pages);
    for (i = 0; i < updates; i++) {
        bk_camera camera = camera_at(i);
        size_t count = 16;
        if (i % 97 == 0) switch_light(scene, live, (i / 97) % LIGHTS, (i / 97) % 4 < 2 ? 1.0f : 5.0f);
        CHECK_OK(bk_live_update(live, &camera, &budget, &stats));
        while (count == 16) CHECK_OK(bk_live_dirty_rects(live, rects, 16, &count));
        if (i % 1000 == 999) {
            double now = energy(live, pages);
            brightest = fmax(brightest, now);
            dimmest = fmin(dimmest, now);
        }
        if (i == settle) {
            finish(live);
            held = accounts->bytes;
            warm = resident();
        }
        if (accounts->bytes > most) most = accounts->bytes;
    }
    switch_light(scene, live, 0, 5.0f);
    switch_light(scene, live, 1, 5.0f);
    finish(live);
    end = resident();
    printf("soak: %d updates; accounts %.2f MB, at the end %.2f, at most %.2f; resident %.1f MB, at the end %.1f; "
           "energy %.9g, at the end %.9g, between %.4g and %.4g\n",
           updates, (double)held * 1e-6, (double)accounts->bytes * 1e-6, (double)most * 1e-6, (double)warm * 1e-6,
           (double)end * 1e-6, first, energy(live, pages), dimmest, brightest);
    CHECK(energy(live, pages) == first);
    /* One step of the accounts, for what two states at the same point may differ in. */
    CHECK(accounts->bytes <= held + (2 << 20));
    CHECK(brightest < 3.0 * first);
    bk_live_release(live);
}

/* Reads what an update gives out into a copy of the pages; returns its bytes. */
static uint64_t refresh(bk_live *live, float *copy) {
    bk_rect rects[16];
    uint64_t bytes = 0;
    size_t count, i;
    do {
        CHECK_OK(bk_live_dirty_rects(live, rects, 16, &count));
        for (i = 0; i < count; i++) {
            const bk_rect *r = &rects[i];
            float *first = copy + 3 * (((size_t)r->page * PAGE + r->y) * PAGE + r->x);
            CHECK_OK(bk_live_read(live, r->page, r->lod, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, r, first, PAGE * 3 * sizeof(float)));
            bytes += (uint64_t)8 * r->width * r->height;
        }
    } while (count == 16);
    return bytes;
}

/* With a limit of bytes per update: it is kept, also when the light changes, and all comes in the end. */
static void limited(bk_scene *scene, bk_lightmap *lightmap, uint32_t background) {
    bk_live *live = NULL;
    bk_live_params params = quick();
    bk_live_stats stats;
    bk_budget budget;
    uint32_t pages = page_count(lightmap), page;
    size_t floats = (size_t)3 * PAGE * PAGE;
    float *copy = (float *)malloc(pages * floats * sizeof *copy);
    float *now = (float *)malloc(floats * sizeof *now);
    int i;
    CHECK(copy != NULL && now != NULL);
    if (copy == NULL || now == NULL) return;
    memset(copy, 0x7f, pages * floats * sizeof *copy);
    params.background = background;
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &live));
    bk_live_stats_init(&stats);
    bk_budget_init(&budget);
    budget.milliseconds = 0.0f;
    budget.rays = 20000;
    budget.max_dirty_bytes = 40000;
    for (i = 0; i <= 150 || stats.dirty_bytes_left > 0; i++) {
        bk_camera camera = camera_at(i);
        uint64_t bytes;
        if (i == 50) switch_light(scene, live, 0, 1.0f);
        if (i == 100) switch_light(scene, live, 0, 5.0f);
        if (i == 150) {
            finish(live);
            budget.rays = 0;
        }
        CHECK_OK(bk_live_update(live, &camera, &budget, &stats));
        bytes = refresh(live, copy);
        CHECK(bytes == stats.dirty_bytes && bytes <= budget.max_dirty_bytes);
        CHECK(bytes > 0 || stats.dirty_bytes_left == 0);
    }
    for (page = 0; page < pages; page++) {
        CHECK_OK(bk_live_read(live, page, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, NULL, now, 0));
        CHECK(memcmp(now, copy + page * floats, floats * sizeof *now) == 0);
    }
    bk_live_release(live);
    free(copy);
    free(now);
}

int main(int argc, char **argv) {
    struct accounts accounts = {PTHREAD_MUTEX_INITIALIZER, 0};
    int updates = argc > 2 ? atoi(argv[2]) : 2000;
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_scene *scene;
    bk_lightmap *lightmap;
    if (argc > 1) prefix = argv[1];

    bk_device_desc_init(&desc);
    desc.num_threads = 2;
    desc.memory = on_memory;
    desc.user = &accounts;
    CHECK_OK(bk_device_create(&desc, &device));
    scene = make_scene(device);
    lightmap = make_lightmap(scene);
    if (checks_failed > 0) return check_report("live");
    bad_input(scene, lightmap);
    lights_out(scene, lightmap);
    two_threads(lightmap);
    save_and_restore(lightmap);
    limited(scene, lightmap, 0);
    limited(scene, lightmap, 1);
    soak(scene, lightmap, updates, &accounts);
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
    bk_device_release(device);
    CHECK(accounts.bytes == 0);
    return check_report("live");
}
