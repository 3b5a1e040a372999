/*
 * Live updates under attack, in C99: references given back while work goes on, also in callbacks; vertices so far
 * away that digits run out.
 *
 *     live_faults OUT_PREFIX
 */
#define _POSIX_C_SOURCE 200809L /* threads and clocks */
#include "check.h"

#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <time.h>

static const char *prefix = "";

static void sleep_ms(long ms) {
    struct timespec t;
    t.tv_sec = ms / 1000;
    t.tv_nsec = ms % 1000 * 1000000;
    nanosleep(&t, NULL);
}

/* ---- A device whose callbacks are counted, and may give a live object back ---- */

struct watch {
    pthread_mutex_t lock;
    pthread_t main_thread;
    int64_t bytes;
    long calls;
    /* Given back in the next memory callback: of any thread; of a thread other than the main one. */
    bk_live *release_anywhere;
    bk_live *release_elsewhere;
    /* Callbacks to refuse: the n-th from now, 0: none. */
    long refuse;
};

static int32_t on_memory(void *user, int64_t bytes) {
    struct watch *w = (struct watch *)user;
    bk_live *live = NULL;
    int32_t granted = 1;
    pthread_mutex_lock(&w->lock);
    w->calls++;
    if (bytes > 0 && w->refuse > 0 && --w->refuse == 0) granted = 0;
    if (granted) w->bytes += bytes;
    if (w->release_anywhere != NULL) {
        live = w->release_anywhere;
        w->release_anywhere = NULL;
    } else if (w->release_elsewhere != NULL && !pthread_equal(pthread_self(), w->main_thread)) {
        live = w->release_elsewhere;
        w->release_elsewhere = NULL;
    }
    pthread_mutex_unlock(&w->lock);
    bk_live_release(live);
    return granted;
}

static void watch_init(struct watch *w) {
    memset(w, 0, sizeof *w);
    pthread_mutex_init(&w->lock, NULL);
    w->main_thread = pthread_self();
}

static long calls(struct watch *w) {
    long n;
    pthread_mutex_lock(&w->lock);
    n = w->calls;
    pthread_mutex_unlock(&w->lock);
    return n;
}

static int64_t bytes(struct watch *w) {
    int64_t n;
    pthread_mutex_lock(&w->lock);
    n = w->bytes;
    pthread_mutex_unlock(&w->lock);
    return n;
}

/* Threads of this process; 0 where that cannot be told. */
static int threads(void) {
    char line[256];
    int n = 0;
    FILE *f = fopen("/proc/self/status", "r");
    if (f == NULL) return 0;
    while (fgets(line, sizeof line, f) != NULL) {
        if (sscanf(line, "Threads: %d", &n) == 1) break;
    }
    fclose(f);
    return n;
}

/* Whether no more than `n` threads are left. The system counts a thread for some milliseconds after it was joined. */
static int threads_end(int n) {
    int i;
    for (i = 0; i < 10000 && threads() > n; i++) sleep_ms(1);
    return threads() <= n;
}

/* ---- The Cornell box ---- */

struct box {
    bk_device *device;
    bk_scene *scene;
    bk_lightmap *lightmap;
};

static struct box make_box(struct watch *w, uint32_t texels_per_unit) {
    struct box box = {NULL, NULL, NULL};
    bk_device_desc desc;
    bk_lightmap_desc map;
    bk_device_desc_init(&desc);
    desc.num_threads = 2;
    desc.memory = on_memory;
    desc.user = w;
    CHECK_OK(bk_device_create(&desc, &box.device));
    CHECK_OK(bk_scene_create(box.device, &box.scene));
    CHECK_OK(bk_scene_load_builtin(box.scene, "cornell"));
    CHECK_OK(bk_scene_commit(box.scene, NULL, NULL));
    bk_lightmap_desc_init(&map);
    map.page_size = 256;
    map.texels_per_unit = (float)texels_per_unit;
    CHECK_OK(bk_lightmap_create(box.scene, &map, NULL, NULL, &box.lightmap));
    return box;
}

static void release_box(struct box *box) {
    bk_lightmap_release(box->lightmap);
    bk_scene_release(box->scene);
    bk_device_release(box->device);
}

static bk_live_params many_rounds(uint32_t background) {
    bk_live_params params;
    bk_live_params_init(&params);
    params.background = background;
    params.photon_count = 5000;
    params.max_rounds = 1024;
    return params;
}

static bk_camera inside(void) {
    bk_camera camera;
    bk_camera_init(&camera);
    camera.position[0] = 0.278f;
    camera.position[1] = 0.27f;
    camera.position[2] = 0.5f;
    return camera;
}

static bk_live *make_live(struct box *box, const bk_live_params *params) {
    bk_live *live = NULL;
    bk_camera camera = inside();
    bk_budget budget;
    bk_budget_init(&budget);
    budget.milliseconds = 1.0f;
    CHECK_OK(bk_live_create(box->lightmap, params, NULL, NULL, &live));
    CHECK_OK(bk_live_update(live, &camera, &budget, NULL));
    return live;
}

/* Changes the lamp, so that indirect light is recomputed on a thread of its own. */
static void change_light(struct box *box, bk_live *live) {
    bk_light_desc light;
    bk_light_desc_init(&light);
    light.type = BK_LIGHT_POINT;
    light.position[0] = 0.278f;
    light.position[1] = 0.4f;
    light.position[2] = 0.28f;
    light.color[0] = light.color[1] = light.color[2] = 1.0f;
    CHECK_OK(bk_scene_set_light(box->scene, 0, &light));
    CHECK_OK(bk_live_light_changed(live, 0));
}

/* ---- References ---- */

/* The last release joins all threads: no callback comes after it, no thread is left. */
static void last_release(uint32_t background, int relight) {
    int round, before = threads();
    for (round = 0; round < 5; round++) {
        struct watch w;
        struct box box;
        bk_live *live;
        long at_release;
        bk_live_params params = many_rounds(background);
        watch_init(&w);
        box = make_box(&w, 40);
        live = make_live(&box, &params);
        if (relight) change_light(&box, live);
        /* Now the live object alone keeps scene and device. */
        release_box(&box);
        bk_live_release(live);
        at_release = calls(&w);
        CHECK(bytes(&w) == 0);
        CHECK(threads_end(before));
        sleep_ms(15);
        CHECK(calls(&w) == at_release);
    }
}

/* A callback may give the last reference back, whatever thread it is on; no call waits for itself. */
static void release_in_callbacks(const char *path) {
    struct watch w;
    struct box box;
    bk_live *live;
    bk_live_params params = many_rounds(1);
    bk_lightmap *other = NULL;
    bk_lightmap_desc desc;
    bk_bake_params bake;
    bk_camera camera = inside();
    int i;

    watch_init(&w);
    box = make_box(&w, 40);

    /* In a callback of another call on the device, while the pool works in the background. */
    live = make_live(&box, &params);
    w.release_anywhere = live;
    bk_lightmap_desc_init(&desc);
    desc.page_size = 256;
    desc.texels_per_unit = 40.0f;
    CHECK_OK(bk_lightmap_create(box.scene, &desc, NULL, NULL, &other));
    CHECK(w.release_anywhere == NULL);
    live = make_live(&box, &params);
    w.release_anywhere = live;
    bk_bake_params_init(&bake);
    bake.photon_count = 5000;
    bake.gather_rays = 16;
    CHECK_OK(bk_bake(other, &bake, NULL, NULL, NULL));
    CHECK(w.release_anywhere == NULL);
    bk_lightmap_release(other);

    /* In callbacks of its own calls. */
    live = make_live(&box, &params);
    CHECK_OK(bk_live_save(live, path, NULL, NULL));
    w.release_anywhere = live;
    CHECK_OK(bk_live_restore(live, path, NULL, NULL));
    if (w.release_anywhere != NULL) { /* There was nothing to ask for. */
        w.release_anywhere = NULL;
        bk_live_release(live);
    }
    CHECK(remove(path) == 0);
    live = make_live(&box, &params);
    w.release_anywhere = live;
    for (i = 0; i < 20 && w.release_anywhere != NULL; i++) CHECK_OK(bk_live_update(live, &camera, NULL, NULL));
    if (w.release_anywhere != NULL) {
        w.release_anywhere = NULL;
        bk_live_release(live);
    }

    /* On the thread that recomputes indirect light. That work ends soon, and lets go of all. */
    live = make_live(&box, &params);
    CHECK_OK(bk_live_pause(live, 1));
    CHECK_OK(bk_live_pause(live, 0));
    pthread_mutex_lock(&w.lock);
    w.release_elsewhere = live;
    pthread_mutex_unlock(&w.lock);
    change_light(&box, live);
    for (i = 0; i < 10000; i++) {
        int given_back;
        pthread_mutex_lock(&w.lock);
        given_back = w.release_elsewhere == NULL;
        pthread_mutex_unlock(&w.lock);
        if (given_back) break;
        sleep_ms(1);
    }
    CHECK(w.release_elsewhere == NULL);
    release_box(&box);
    for (i = 0; i < 10000 && bytes(&w) != 0; i++) sleep_ms(1);
    CHECK(bytes(&w) == 0);
}

/* ---- Rectangles ---- */

/* Two vertices at 1e12, on charts of the caller's. */
static void rectangles_lie_on_their_page(void) {
    enum { PAGE = 69 };
    static const float positions[9][3] = {
        {-0.181412101f, 0.850117445f, 0.663000226f}, {0.847654462f, -0.26946497f, -0.350293398f},
        {-0.486251354f, 0.783537149f, 0.489554644f}, {-0.607310414f, -0.5540905f, -0.505483747f},
        {-0.121418476f, 0.623210907f, 0.210554957f}, {-0.3222574f, -0.592844248f, 0.260805964f},
        {1e12f, 0.250456214f, 0.0519696474f},        {-0.3222574f, -0.592844248f, 0.260805964f},
        {0.67608273f, 1e12f, -0.655815601f},
    };
    static const float uvs[9][2] = {
        {0.806745887f, 0.83921659f},   {0.999770641f, 0.24901998f},  {0.682752252f, 0.213277221f},
        {0.541915059f, 0.199798942f},  {0.120008349f, 0.482908249f}, {0.052069664f, 0.63998735f},
        {0.809175611f, 0.724074721f},  {0.052069664f, 0.63998735f},  {0.0754939318f, 0.612286091f},
    };
    static const uint32_t indices[9] = {0, 1, 2, 3, 4, 5, 6, 7, 8};
    static const uint32_t pages[3] = {2, 1, 1};
    bk_device *device = NULL;
    bk_scene *scene = NULL;
    bk_lightmap *lightmap = NULL;
    bk_live *live = NULL;
    bk_material_desc material;
    bk_light_desc light;
    bk_mesh_desc mesh;
    bk_lightmap_desc desc;
    bk_lightmap_info info;
    bk_live_params params;
    bk_camera camera;
    bk_budget budget;
    uint32_t both, k;

    CHECK_OK(bk_device_create(NULL, &device));
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_light_desc_init(&light);
    light.position[2] = 3.0f;
    CHECK_OK(bk_scene_add_light(scene, &light, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = positions[0];
    mesh.vertex_count = 9;
    mesh.indices = indices;
    mesh.triangle_count = 3;
    mesh.lightmap_uvs = uvs[0];
    mesh.lightmap_page = pages;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    bk_camera_init(&camera);
    camera.position[2] = 3.0f;
    bk_budget_init(&budget);
    budget.milliseconds = 0.0f;
    budget.rays = 20000;
    for (both = 0; both < 2; both++) {
        bk_lightmap_desc_init(&desc);
        desc.page_size = PAGE;
        desc.both_sides = both;
        CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
        bk_lightmap_info_init(&info);
        CHECK_OK(bk_lightmap_get_info(lightmap, &info));
        bk_live_params_init(&params);
        params.mode = BK_LIVE_POSITION;
        params.photon_count = 300;
        params.max_rounds = 2;
        CHECK_OK(bk_live_create(lightmap, &params, NULL, NULL, &live));
        for (k = 0; k < 4; k++) {
            bk_rect rects[16];
            size_t i, count = 16;
            CHECK_OK(bk_live_update(live, &camera, &budget, NULL));
            while (count == 16) {
                CHECK_OK(bk_live_dirty_rects(live, rects, 16, &count));
                for (i = 0; i < count; i++) {
                    CHECK(rects[i].page < info.page_count && rects[i].width > 0 && rects[i].height > 0);
                    CHECK((uint64_t)rects[i].x + rects[i].width <= PAGE && (uint64_t)rects[i].y + rects[i].height <= PAGE);
                }
            }
        }
        bk_live_release(live);
        bk_lightmap_release(lightmap);
    }
    bk_scene_release(scene);
    bk_device_release(device);
}

/* ---- Refused memory ---- */

static double energy(bk_live *live) {
    static float texels[256 * 256 * 3];
    double sum = 0.0;
    size_t i;
    CHECK_OK(bk_live_read(live, 0, 2, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, NULL, texels, 0));
    for (i = 0; i < 256 * 256 * 3; i++) sum += texels[i];
    return sum;
}

static void refuse(struct watch *w, long nth) {
    pthread_mutex_lock(&w->lock);
    w->refuse = nth;
    pthread_mutex_unlock(&w->lock);
}

/* Updates until nothing is left to do; how many were refused memory. */
static int finish(bk_live *live) {
    bk_camera camera = inside();
    bk_live_stats stats;
    bk_budget budget;
    int refused = 0, i;
    bk_live_stats_init(&stats);
    bk_budget_init(&budget);
    budget.milliseconds = 1000.0f;
    for (i = 0; i < 20000; i++) {
        bk_result result = bk_live_update(live, &camera, &budget, &stats);
        if (result == BK_ERROR_OUT_OF_MEMORY) refused++;
        else CHECK_OK(result);
        if (result == BK_OK && stats.finished == 1.0f && stats.blocks_changed == 0 && !stats.light_pending) break;
        if (stats.light_pending) sleep_ms(1);
    }
    CHECK(stats.finished == 1.0f);
    return refused;
}

/* Whatever request of memory is refused, the call fails or does without, and all goes on where it was. */
static void refusals(const char *path) {
    struct watch w;
    struct box box;
    bk_live *live = NULL;
    bk_live_params params;
    double expected;
    int64_t before;
    long n;
    int refused = 0;

    watch_init(&w);
    box = make_box(&w, 25);
    bk_live_params_init(&params);
    params.mode = BK_LIVE_POSITION;
    params.photon_count = 5000;
    params.max_rounds = 1;
    before = bytes(&w);
    /* Creating: one request after the other, until none is left to refuse. */
    for (n = 1; n < 100; n++) {
        bk_result result;
        refuse(&w, n);
        result = bk_live_create(box.lightmap, &params, NULL, NULL, &live);
        refuse(&w, 0);
        if (result == BK_OK) break;
        CHECK(result == BK_ERROR_OUT_OF_MEMORY && live == NULL);
        CHECK(bytes(&w) == before);
        refused++;
    }
    CHECK(refused > 0 && live != NULL);
    finish(live);
    CHECK_OK(bk_live_save(live, path, NULL, NULL));
    /* Going back: a refusal leaves what is shown. */
    expected = energy(live);
    refuse(&w, 1);
    CHECK_ERROR(bk_live_restore(live, path, NULL, NULL), BK_ERROR_OUT_OF_MEMORY, "live light");
    CHECK(energy(live) == expected);
    CHECK_OK(bk_live_restore(live, path, NULL, NULL));
    CHECK(energy(live) == expected);
    change_light(&box, live);
    finish(live);
    expected = energy(live);
    bk_live_release(live);

    /* Changing a light, with all that follows, and going back: the n-th request from now is refused. */
    for (n = 1; n < 8; n++) {
        bk_light_desc light;
        bk_light_desc_init(&light);
        light.color[0] = (float)n;
        light.position[0] = light.position[1] = light.position[2] = 0.2f;
        CHECK_OK(bk_scene_set_light(box.scene, 0, &light));
        CHECK_OK(bk_live_create(box.lightmap, &params, NULL, NULL, &live));
        refuse(&w, n);
        bk_light_desc_init(&light);
        light.type = BK_LIGHT_POINT;
        light.position[0] = 0.278f;
        light.position[1] = 0.4f;
        light.position[2] = 0.28f;
        light.color[0] = light.color[1] = light.color[2] = 1.0f;
        CHECK_OK(bk_scene_set_light(box.scene, 0, &light));
        while (bk_live_light_changed(live, 0) == BK_ERROR_OUT_OF_MEMORY) refused++;
        refused += finish(live);
        refuse(&w, 0);
        CHECK(energy(live) == expected);
        bk_live_release(live);
    }
    printf("%d requests of memory refused\n", refused);
    CHECK(remove(path) == 0);
    release_box(&box);
    CHECK(bytes(&w) == 0);
}

int main(int argc, char **argv) {
    char path[4096];
    if (argc > 1) prefix = argv[1];
    snprintf(path, sizeof path, "%sstate", prefix);
    last_release(0, 0);
    last_release(1, 0);
    last_release(0, 1);
    last_release(1, 1);
    release_in_callbacks(path);
    rectangles_lie_on_their_page();
    refusals(path);
    return check_report("live_faults");
}
