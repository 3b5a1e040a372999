/*
 * Live updates from several threads at once, in C99: one updates, one reads, one switches a light, retains and
 * releases, while the pool works in the background and a thread recomputes indirect light. Beside its checks it is
 * what a race detector is run on (see sanitize.sh): charts are the caller's, so that the library needs no features.
 *
 *     live_races OUT_PREFIX [UPDATES]
 */
#define _POSIX_C_SOURCE 200809L /* threads */
#include "check.h"

#include <pthread.h>
#include <stdlib.h>
#include <time.h>

enum { PAGE = 64, SIDES = 6 };

struct race {
    pthread_mutex_t lock;
    int is_over;
    int64_t bytes;
    bk_scene *scene;
    bk_live *live;
    uint32_t pages;
    long reads, busy, wrong, changes;
};

static int32_t on_memory(void *user, int64_t bytes) {
    struct race *r = (struct race *)user;
    pthread_mutex_lock(&r->lock);
    r->bytes += bytes;
    pthread_mutex_unlock(&r->lock);
    return 1;
}

static int is_over(struct race *r) {
    int over;
    pthread_mutex_lock(&r->lock);
    over = r->is_over;
    pthread_mutex_unlock(&r->lock);
    return over;
}

static void sleep_a_moment(void) {
    struct timespec t = {0, 1000000};
    nanosleep(&t, NULL);
}

static bk_light_desc lamp(float power) {
    bk_light_desc light;
    bk_light_desc_init(&light);
    light.type = BK_LIGHT_POINT;
    light.position[0] = 0.3f;
    light.position[2] = 0.4f;
    light.color[0] = light.color[1] = light.color[2] = power;
    return light;
}

/* The inside of a cube from -1 to 1; each side has a sixth of the page. */
static bk_scene *make_scene(bk_device *device) {
    float positions[SIDES * 4][3], uvs[SIDES * 4][2];
    uint32_t indices[SIDES * 2][3], pages[SIDES * 2];
    bk_scene *scene = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh;
    bk_light_desc light = lamp(3.0f);
    uint32_t side, k;
    for (side = 0; side < SIDES; side++) {
        uint32_t axis = side / 2, a = (axis + 1) % 3, b = (axis + 2) % 3;
        float away = side % 2 == 0 ? -1.0f : 1.0f;
        for (k = 0; k < 4; k++) {
            /* Counter-clockwise as seen from the middle. */
            float u = k == 1 || k == 2 ? 1.0f : 0.0f, v = k >= 2 ? 1.0f : 0.0f;
            positions[4 * side + k][axis] = away;
            positions[4 * side + k][a] = away * (1.0f - 2.0f * u);
            positions[4 * side + k][b] = 2.0f * v - 1.0f;
            uvs[4 * side + k][0] = ((float)(side % 3) + 0.1f + 0.8f * u) / 3.0f;
            uvs[4 * side + k][1] = ((float)(side / 3) + 0.1f + 0.8f * v) / 2.0f;
        }
        for (k = 0; k < 2; k++) {
            indices[2 * side + k][0] = 4 * side;
            indices[2 * side + k][1] = 4 * side + 1 + k;
            indices[2 * side + k][2] = 4 * side + 2 + k;
            pages[2 * side + k] = 0;
        }
    }
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    material.flags = BK_MATERIAL_TWO_SIDED;
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = positions[0];
    mesh.vertex_count = SIDES * 4;
    mesh.indices = indices[0];
    mesh.triangle_count = SIDES * 2;
    mesh.lightmap_uvs = uvs[0];
    mesh.lightmap_page = pages;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    CHECK_OK(bk_scene_add_light(scene, &light, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

/* Reads what is shown, for as long as updates go on. */
static void *reader(void *user) {
    struct race *r = (struct race *)user;
    static float texels[PAGE * PAGE * 3];
    while (!is_over(r)) {
        long wrong = 0, i;
        bk_cell_info info;
        bk_result result;
        bk_cell_info_init(&info);
        result = bk_live_read(r->live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, NULL, texels, 0);
        for (i = 0; result == BK_OK && i < PAGE * PAGE * 3; i++) wrong += !(texels[i] >= 0.0f && texels[i] < 1e6f);
        bk_live_cell_lods(r->live, &info, NULL, 0);
        pthread_mutex_lock(&r->lock);
        if (result == BK_OK) r->reads++;
        else r->busy++;
        r->wrong += wrong + (result != BK_OK && result != BK_ERROR_INVALID_STATE);
        pthread_mutex_unlock(&r->lock);
        sleep_a_moment();
    }
    return NULL;
}

/* Switches the lamp, and counts references up and down. */
static void *switcher(void *user) {
    struct race *r = (struct race *)user;
    int i;
    for (i = 0; !is_over(r); i++) {
        bk_light_desc light = lamp(i % 2 == 0 ? 1.0f : 3.0f);
        bk_result changed, set;
        bk_live_retain(r->live);
        set = bk_scene_set_light(r->scene, 0, &light);
        changed = bk_live_light_changed(r->live, 0);
        if (i % 16 == 15 && bk_live_pause(r->live, 1) == BK_OK) {
            while (bk_live_pause(r->live, 0) != BK_OK) {
            }
        }
        bk_live_release(r->live);
        pthread_mutex_lock(&r->lock);
        if (changed == BK_OK) r->changes++;
        r->wrong += (set != BK_OK && set != BK_ERROR_INVALID_STATE);
        r->wrong += (changed != BK_OK && changed != BK_ERROR_INVALID_STATE);
        pthread_mutex_unlock(&r->lock);
        sleep_a_moment();
    }
    return NULL;
}

int main(int argc, char **argv) {
    int updates = argc > 2 ? atoi(argv[2]) : 200, i;
    struct race r;
    pthread_t threads[2];
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc map;
    bk_live_params params;
    bk_camera camera;
    bk_budget budget;
    long updated = 0;

    memset(&r, 0, sizeof r);
    pthread_mutex_init(&r.lock, NULL);
    bk_device_desc_init(&desc);
    desc.num_threads = 3;
    desc.memory = on_memory;
    desc.user = &r;
    CHECK_OK(bk_device_create(&desc, &device));
    r.scene = make_scene(device);
    bk_lightmap_desc_init(&map);
    map.page_size = PAGE;
    map.gather_divisor = map.radiance_divisor = 1;
    CHECK_OK(bk_lightmap_create(r.scene, &map, NULL, NULL, &lightmap));
    bk_live_params_init(&params);
    params.photon_count = 2000;
    params.background = 1;
    CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &r.live));
    if (checks_failed > 0) return check_report("live_races");

    pthread_create(&threads[0], NULL, reader, &r);
    pthread_create(&threads[1], NULL, switcher, &r);
    bk_camera_init(&camera);
    bk_budget_init(&budget);
    budget.milliseconds = 1.0f;
    for (i = 0; i < 100 * updates && updated < updates; i++) {
        bk_result result = bk_live_update(r.live, &camera, &budget, NULL);
        bk_rect rects[8];
        size_t count = 0;
        if (result == BK_OK) updated++;
        else CHECK(result == BK_ERROR_INVALID_STATE);
        /* The rest of a frame. */
        sleep_a_moment();
        bk_live_dirty_rects(r.live, rects, 8, &count);
    }
    pthread_mutex_lock(&r.lock);
    r.is_over = 1;
    pthread_mutex_unlock(&r.lock);
    pthread_join(threads[0], NULL);
    pthread_join(threads[1], NULL);
    printf("%ld updates, %ld reads (%ld refused), %ld changes of light\n", updated, r.reads, r.busy, r.changes);
    CHECK(updated > 0 && r.reads > 0 && r.changes > 0 && r.wrong == 0);
    bk_live_release(r.live);
    bk_lightmap_release(lightmap);
    bk_scene_release(r.scene);
    bk_device_release(device);
    CHECK(r.bytes == 0);
    return check_report("live_races");
}
