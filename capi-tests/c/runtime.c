/*
 * What the library's surroundings may do to it: floating-point states, small stacks, forks, callbacks that call
 * back, deep trees, commits that fail, and many meshes.
 *
 *     runtime FOLDER/ [TEST]
 *
 * FOLDER: where files are written. TEST: the number of a test to run alone, from 0.
 */
#define _POSIX_C_SOURCE 200809L
#define _DEFAULT_SOURCE
#include "check.h"

#include <fenv.h>
#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>
#ifdef __SSE2__
#include <xmmintrin.h>
#endif

#define ARGUMENT BK_ERROR_INVALID_ARGUMENT
#define STATE BK_ERROR_INVALID_STATE

static const char *folder;

static bk_device *device_of(uint32_t threads) {
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.num_threads = threads;
    CHECK_OK(bk_device_create(&desc, &device));
    return device;
}

static bk_scene *box(bk_device *device) {
    bk_scene *scene = NULL;
    CHECK_OK(bk_scene_create(device, &scene));
    CHECK_OK(bk_scene_load_builtin(scene, "cornell"));
    return scene;
}

static bk_scene *committed_box(bk_device *device) {
    bk_scene *scene = box(device);
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

static void small_bake_params(bk_bake_params *params) {
    bk_bake_params_init(params);
    params->photon_count = 3000;
    params->gather_rays = 16;
    params->direct_samples = 2;
}

/* FNV-1a */
static uint64_t hash(uint64_t sum, const void *data, size_t size) {
    const unsigned char *bytes = (const unsigned char *)data;
    size_t i;
    for (i = 0; i < size; i++) {
        sum = (sum ^ bytes[i]) * 0x100000001b3u;
    }
    return sum;
}

/* Rays from inside the box, in all directions. */
#define RAYS 512
static bk_ray rays[RAYS];
static float directions[RAYS][3];

static void make_rays(void) {
    uint32_t i, k, state = 1;
    for (i = 0; i < RAYS; i++) {
        for (k = 0; k < 3; k++) {
            state = state * 1664525u + 1013904223u;
            rays[i].direction[k] = directions[i][k] = (float)(state >> 8) / 16777216.0f - 0.5f;
            rays[i].origin[k] = 0.5f;
        }
        rays[i].tmin = 0.0f;
        rays[i].tmax = INFINITY;
    }
}

/* ---- Floating-point states ---- */

#ifdef __SSE2__

static unsigned state_of_caller, state_in_callback;
static int strange_callbacks;

static int32_t look_at_state(void *user, float fraction, const char *stage) {
    (void)user, (void)fraction, (void)stage;
    if ((_mm_getcsr() & ~0x3fu) != state_in_callback) {
        strange_callbacks++;
    }
    /* The library does not compute in what a callback leaves behind. */
    _mm_setcsr(0x7f80);
    return 1;
}

static void check_state(const char *after) {
    if ((_mm_getcsr() & ~0x3fu) != state_of_caller) {
        fprintf(stderr, "%s changed the floating-point state %x to %x\n", after, state_of_caller, _mm_getcsr());
        checks_failed++;
    }
    checks_done++;
}

/* All that a scene and a bake compute, with the device made in one state and the calls in another. */
static uint64_t bits(unsigned at_creation, unsigned at_calls) {
    static bk_hit hits[RAYS];
    static uint8_t occluded[RAYS];
    static float texels[128 * 128 * 3], estimates[RAYS][3];
    uint64_t sum = 0xcbf29ce484222325u;
    bk_device *device;
    bk_scene *scene;
    bk_lightmap *lightmap;
    bk_photon_map *map = NULL;
    bk_photon_params photons;
    bk_bake_params params;
    bk_lightmap_info info;
    bk_hit hit;
    uint32_t page;
    _mm_setcsr(at_creation);
    device = device_of(2);
    state_of_caller = state_in_callback = at_calls;
    strange_callbacks = 0;
    _mm_setcsr(at_calls);
    scene = box(device);
    CHECK_OK(bk_scene_commit(scene, look_at_state, NULL));
    check_state("bk_scene_commit");
    bk_intersect(scene, rays, &hit);
    check_state("bk_intersect");
    sum = hash(sum, &hit, sizeof hit);
    CHECK(bk_occluded(scene, rays) == 1);
    check_state("bk_occluded");
    CHECK_OK(bk_intersect_many(scene, rays, RAYS, 0, hits));
    check_state("bk_intersect_many");
    sum = hash(sum, hits, sizeof hits);
    CHECK_OK(bk_intersect_many(scene, rays, RAYS, BK_RAYS_PARALLEL, hits));
    sum = hash(sum, hits, sizeof hits);
    CHECK_OK(bk_occluded_many(scene, rays, RAYS, 0, occluded));
    check_state("bk_occluded_many");
    sum = hash(sum, occluded, sizeof occluded);
    CHECK_OK(bk_gather(scene, rays[0].origin, directions[0], RAYS, INFINITY, 0, hits));
    check_state("bk_gather");
    sum = hash(sum, hits, sizeof hits);
    bk_photon_params_init(&photons);
    photons.photon_count = 5000;
    CHECK_OK(bk_photon_map_create(scene, &photons, NULL, NULL, &map));
    CHECK_OK(bk_photon_map_estimate(map, directions[0], directions[0], RAYS, estimates[0]));
    check_state("bk_photon_map_estimate");
    sum = hash(sum, estimates, sizeof estimates);
    lightmap = small_lightmap(scene, 128);
    small_bake_params(&params);
    CHECK_OK(bk_bake(lightmap, &params, look_at_state, NULL, NULL));
    check_state("bk_bake");
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(lightmap, &info));
    for (page = 0; page < info.page_count; page++) {
        CHECK_OK(bk_lightmap_read(lightmap, page, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, texels, 0));
        sum = hash(sum, texels, sizeof texels);
    }
    CHECK(strange_callbacks == 0);
    bk_photon_map_release(map);
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
    bk_device_release(device);
    check_state("a release");
    _mm_setcsr(0x1f80);
    return sum;
}

static void the_callers_floating_point_state_neither_matters_nor_changes(void) {
    /* The default; flushing denormals; rounding down, up and to zero; all of it with exceptions that kill. */
    static const unsigned states[] = {0x1f80, 0x9fc0, 0x3f80, 0x5f80, 0x7f80, 0xffc0 & ~(1u << 7 | 1u << 9 | 1u << 10)};
    uint64_t expected = bits(0x1f80, 0x1f80);
    size_t i;
    for (i = 1; i < sizeof states / sizeof *states; i++) {
        CHECK(bits(0x1f80, states[i]) == expected);
        CHECK(bits(states[i], 0x1f80) == expected);
    }
}

#else

static void the_callers_floating_point_state_neither_matters_nor_changes(void) {
    static bk_hit hits[2][RAYS];
    bk_device *device = device_of(1);
    bk_scene *scene = committed_box(device);
    CHECK_OK(bk_intersect_many(scene, rays, RAYS, 0, hits[0]));
    fesetround(FE_UPWARD);
    CHECK_OK(bk_intersect_many(scene, rays, RAYS, 0, hits[1]));
    CHECK(fegetround() == FE_UPWARD);
    fesetround(FE_TONEAREST);
    CHECK(memcmp(hits[0], hits[1], sizeof hits[0]) == 0);
    bk_scene_release(scene);
    bk_device_release(device);
}

#endif

/* ---- Calls from callbacks ---- */

typedef struct {
    bk_lightmap *other;
    bk_live *live;
    float *texels;
    int calls, inside, entered_again, failed;
} Reader;

static int32_t read_in_callback(void *user, float fraction, const char *stage) {
    Reader *reader = (Reader *)user;
    (void)fraction, (void)stage;
    reader->calls++;
    reader->entered_again += reader->inside;
    reader->inside = 1;
    if (bk_lightmap_read(reader->other, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, reader->texels, 0) != BK_OK ||
        bk_live_read(reader->live, 0, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, 0, reader->texels, 0) != BK_OK) {
        reader->failed++;
    }
    reader->inside = 0;
    return 1;
}

static void light_maps_can_be_read_in_a_progress_callback(void) {
    uint32_t threads;
    for (threads = 1; threads <= 4; threads += 3) {
        bk_device *device = device_of(threads);
        bk_scene *scene = committed_box(device);
        bk_lightmap *lightmap = small_lightmap(scene, 64);
        Reader reader = {NULL, NULL, NULL, 0, 0, 0, 0};
        bk_bake_params params;
        bk_live_params live_params;
        int round;
        reader.other = small_lightmap(scene, 512);
        reader.texels = (float *)malloc(512 * 512 * 3 * sizeof(float));
        small_bake_params(&params);
        CHECK_OK(bk_bake(reader.other, &params, NULL, NULL, NULL));
        bk_live_params_init(&live_params);
        live_params.photon_count = 1000;
        CHECK_OK(bk_live_create(reader.other, &live_params, NULL, NULL, &reader.live));
        params.photon_count = 30000;
        for (round = 0; round < 10; round++) {
            CHECK_OK(bk_bake(lightmap, &params, read_in_callback, &reader, NULL));
        }
        CHECK(reader.calls > 10);
        CHECK(reader.entered_again == 0);
        CHECK(reader.failed == 0);
        free(reader.texels);
        bk_live_release(reader.live);
        bk_lightmap_release(reader.other);
        bk_lightmap_release(lightmap);
        bk_scene_release(scene);
        bk_device_release(device);
    }
}

typedef struct {
    bk_device *device;
    bk_scene *scene;
    bk_lightmap *lightmap;
    bk_photon_map *photons;
    int released, calls_afterwards, is_over, calls_after_the_end;
    int64_t held;
} Handles;

static void release_all(Handles *handles) {
    handles->released = 1;
    bk_lightmap_release(handles->lightmap);
    bk_photon_map_release(handles->photons);
    bk_scene_release(handles->scene);
    bk_device_release(handles->device);
}

static int32_t release_in_progress(void *user, float fraction, const char *stage) {
    Handles *handles = (Handles *)user;
    (void)fraction, (void)stage;
    if (!handles->released) {
        release_all(handles);
    }
    handles->calls_afterwards++;
    return 1;
}

/* Set while a release is due in the next memory callback, on whatever thread it comes. */
static pthread_mutex_t memory_lock = PTHREAD_MUTEX_INITIALIZER;
static int release_is_due;

static int32_t release_in_memory(void *user, int64_t bytes) {
    Handles *handles = (Handles *)user;
    int due;
    pthread_mutex_lock(&memory_lock);
    handles->held += bytes;
    handles->calls_after_the_end += handles->is_over;
    due = release_is_due;
    release_is_due = 0;
    pthread_mutex_unlock(&memory_lock);
    if (due) {
        release_all(handles);
    }
    return 1;
}

static void all_handles_can_be_released_in_a_callback(void) {
    int in_memory, call;
    for (in_memory = 0; in_memory < 2; in_memory++) {
        for (call = 0; call < 2 + in_memory; call++) {
            Handles handles = {NULL, NULL, NULL, NULL, 0, 0, 0, 0, 0};
            bk_device_desc desc;
            bk_bake_params params;
            bk_photon_params photons;
            bk_photon_view view;
            bk_photon_map *more = NULL;
            bk_device_desc_init(&desc);
            desc.num_threads = 2;
            desc.memory = release_in_memory;
            desc.user = &handles;
            CHECK_OK(bk_device_create(&desc, &handles.device));
            handles.scene = committed_box(handles.device);
            handles.lightmap = small_lightmap(handles.scene, 64);
            bk_photon_params_init(&photons);
            photons.photon_count = 3000;
            CHECK_OK(bk_photon_map_create(handles.scene, &photons, NULL, NULL, &handles.photons));
            small_bake_params(&params);
            release_is_due = in_memory;
            if (call == 0) {
                CHECK_OK(bk_bake(handles.lightmap, &params, in_memory ? NULL : release_in_progress, &handles, NULL));
            } else if (call == 1) {
                CHECK_OK(bk_photon_map_create(handles.scene, &photons, in_memory ? NULL : release_in_progress, &handles,
                                              &more));
            } else {
                bk_photon_view_init(&view);
                CHECK_OK(bk_photon_map_get_photons(handles.photons, &view));
            }
            bk_photon_map_release(more);
            handles.is_over = 1;
            CHECK(handles.released == 1);
            CHECK(in_memory || handles.calls_afterwards > 1);
            CHECK(handles.held == 0);
            CHECK(handles.calls_after_the_end == 0);
        }
    }
}

/* ---- Threads and forks ---- */

static int thread_count(void) {
    int n = -1;
    char line[200];
    FILE *file = fopen("/proc/self/status", "r");
    while (file != NULL && fgets(line, sizeof line, file) != NULL) {
        sscanf(line, "Threads: %d", &n);
    }
    if (file != NULL) {
        fclose(file);
    }
    return n;
}

static void no_thread_is_started_but_those_of_devices(void) {
    char path[1000];
    static float texels[64 * 64 * 3];
    uint32_t threads = 2, format;
    bk_device *device;
    bk_scene *scene, *loaded = NULL;
    bk_lightmap *lightmap;
    bk_live *live = NULL;
    bk_bake_params params;
    bk_live_params live_params;
    bk_camera camera;
    int before = thread_count(), expected = before + (int)threads;
    if (before < 0) {
        return; /* The system does not tell. */
    }
    device = device_of(threads);
    scene = committed_box(device);
    lightmap = small_lightmap(scene, 64);
    small_bake_params(&params);
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    CHECK(thread_count() == expected);
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, texels, 0));
    CHECK(thread_count() == expected);
    for (format = BK_FILE_EXR; format <= BK_FILE_GLB; format++) {
        CHECK_OK(bk_lightmap_save(lightmap, folder, format, NULL, NULL));
        CHECK(thread_count() == expected);
    }
    CHECK_OK(bk_scene_create(device, &loaded));
    snprintf(path, sizeof path, "%sscene.glb", folder);
    CHECK_OK(bk_scene_load_file(loaded, path, NULL, NULL, NULL, NULL));
    CHECK(thread_count() == expected);
    bk_live_params_init(&live_params);
    live_params.photon_count = 1000;
    CHECK_OK(bk_live_create(lightmap, &live_params, NULL, NULL, &live));
    bk_camera_init(&camera);
    camera.position[2] = 3.0f;
    CHECK_OK(bk_live_update(live, &camera, NULL, NULL));
    CHECK_OK(bk_live_read(live, 0, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, 0, texels, 0));
    snprintf(path, sizeof path, "%sruntime.live", folder);
    CHECK_OK(bk_live_save(live, path, NULL, NULL));
    CHECK_OK(bk_live_restore(live, path, NULL, NULL));
    CHECK(thread_count() == expected);
    bk_live_release(live);
    bk_lightmap_release(lightmap);
    bk_scene_release(loaded);
    bk_scene_release(scene);
    bk_device_release(device);
    CHECK(thread_count() == before);
}

static void too_many_threads_are_refused(void) {
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.num_threads = 1025;
    CHECK_ERROR(bk_device_create(&desc, &device), ARGUMENT, "num_threads is 1025, more than 1024");
    desc.num_threads = 256;
    CHECK_OK(bk_device_create(&desc, &device));
    CHECK(bk_device_num_threads(device) == 256);
    bk_device_release(device);
    /* The number of cores does not depend on the environment. */
    setenv("RAYON_NUM_THREADS", "1000", 1);
    device = device_of(0);
    CHECK(bk_device_num_threads(device) >= 1 && bk_device_num_threads(device) != 1000);
    bk_device_release(device);
    unsetenv("RAYON_NUM_THREADS");
}

static void a_forked_child_gets_errors_for_work_and_answers_to_queries(void) {
    bk_device *device = device_of(2);
    bk_scene *described = box(device), *scene = committed_box(device);
    bk_lightmap *lightmap = small_lightmap(scene, 64);
    bk_live *live = NULL;
    bk_bake_params params;
    bk_live_params live_params;
    bk_camera camera;
    bk_budget budget;
    bk_hit expected, hit;
    pid_t child;
    int status = -1;
    small_bake_params(&params);
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    bk_live_params_init(&live_params);
    live_params.photon_count = 1000;
    live_params.background = 1;
    CHECK_OK(bk_live_create(lightmap, &live_params, NULL, NULL, &live));
    bk_camera_init(&camera);
    camera.position[2] = 3.0f;
    bk_budget_init(&budget);
    CHECK_OK(bk_live_update(live, &camera, &budget, NULL));
    bk_intersect(scene, rays, &expected);
    fflush(NULL);
    child = fork();
    if (child == 0) {
        static bk_hit hits[RAYS];
        bk_device *own;
        bk_scene *own_scene = NULL;
        bk_photon_map *map = NULL;
        bk_lightmap *another = NULL;
        alarm(60);
        checks_failed = 0;
        CHECK_OK(bk_scene_create(device, &own_scene));
        CHECK_ERROR(bk_scene_commit(described, NULL, NULL), STATE, "fork");
        CHECK_ERROR(bk_bake(lightmap, NULL, NULL, NULL, NULL), STATE, "fork");
        CHECK_ERROR(bk_lightmap_save(lightmap, folder, BK_FILE_PNG, NULL, NULL), STATE, "fork");
        CHECK_ERROR(bk_scene_load_file(own_scene, "none.obj", NULL, NULL, NULL, NULL), STATE, "fork");
        bk_scene_release(own_scene);
        CHECK_ERROR(bk_photon_map_create(scene, NULL, NULL, NULL, &map), STATE, "fork");
        CHECK_ERROR(bk_lightmap_create(scene, NULL, NULL, NULL, &another), STATE, "fork");
        CHECK_ERROR(bk_intersect_many(scene, rays, RAYS, BK_RAYS_PARALLEL, hits), STATE, "fork");
        CHECK_ERROR(bk_live_update(live, &camera, &budget, NULL), STATE, "fork");
        CHECK_ERROR(bk_live_pause(live, 1), STATE, "fork");
        bk_intersect(scene, rays, &hit);
        CHECK(memcmp(&hit, &expected, sizeof hit) == 0);
        CHECK_OK(bk_intersect_many(scene, rays, RAYS, 0, hits));
        CHECK(memcmp(hits, &expected, sizeof hit) == 0);
        own = device_of(2);
        own_scene = committed_box(own);
        bk_scene_release(own_scene);
        bk_device_release(own);
        bk_live_release(live);
        bk_lightmap_release(lightmap);
        bk_scene_release(described);
        bk_scene_release(scene);
        bk_device_release(device);
        _exit(checks_failed != 0);
    }
    CHECK(child > 0 && waitpid(child, &status, 0) == child);
    CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 0);
    /* The parent goes on as before. */
    CHECK_OK(bk_scene_commit(described, NULL, NULL));
    CHECK_OK(bk_live_update(live, &camera, &budget, NULL));
    bk_live_release(live);
    bk_lightmap_release(lightmap);
    bk_scene_release(described);
    bk_scene_release(scene);
    bk_device_release(device);
}

/* ---- Small stacks ---- */

#define STACK (64u << 10)

static bk_scene *stack_scene;
static bk_photon_map *stack_photons;

static void *run_all_queries(void *unused) {
    static bk_hit hits[RAYS];
    static uint8_t occluded[RAYS];
    static float estimates[RAYS][3];
    bk_hit hit;
    (void)unused;
    bk_intersect(stack_scene, rays, &hit);
    CHECK(bk_occluded(stack_scene, rays) == 1);
    CHECK_OK(bk_intersect_many(stack_scene, rays, RAYS, 0, hits));
    CHECK(memcmp(&hit, hits, sizeof hit) == 0);
    CHECK_OK(bk_intersect_many(stack_scene, rays, RAYS, BK_RAYS_PARALLEL, hits));
    CHECK_OK(bk_occluded_many(stack_scene, rays, RAYS, 0, occluded));
    CHECK_OK(bk_gather(stack_scene, rays[0].origin, directions[0], RAYS, INFINITY, 0, hits));
    CHECK_OK(bk_photon_map_estimate(stack_photons, directions[0], directions[0], RAYS, estimates[0]));
    CHECK_ERROR(bk_gather(stack_scene, NULL, directions[0], RAYS, INFINITY, 0, hits), ARGUMENT, "origin");
    return NULL;
}

static void a_stack_of_64_kb_is_enough_for_every_query(void) {
    static const uint32_t isas[] = {BK_ISA_PORTABLE, BK_ISA_AVX2, BK_ISA_AVX512};
    int isa, compact;
    for (isa = 0; isa < 3; isa++) {
        for (compact = 0; compact < 2; compact++) {
            bk_device *device = NULL;
            bk_device_desc desc;
            bk_build_params build;
            bk_photon_params photons;
            pthread_attr_t attributes;
            pthread_t thread;
            bk_device_desc_init(&desc);
            desc.num_threads = 1;
            desc.isa = isas[isa];
            if (bk_device_create(&desc, &device) != BK_OK) {
                continue; /* The machine does not have it. */
            }
            stack_scene = box(device);
            bk_build_params_init(&build);
            build.compact = (uint32_t)compact;
            CHECK_OK(bk_scene_set_build(stack_scene, &build));
            CHECK_OK(bk_scene_commit(stack_scene, NULL, NULL));
            bk_photon_params_init(&photons);
            photons.photon_count = 3000;
            CHECK_OK(bk_photon_map_create(stack_scene, &photons, NULL, NULL, &stack_photons));
            pthread_attr_init(&attributes);
            CHECK(pthread_attr_setstacksize(&attributes, STACK) == 0);
            CHECK(pthread_create(&thread, &attributes, run_all_queries, NULL) == 0);
            pthread_join(thread, NULL);
            pthread_attr_destroy(&attributes);
            bk_photon_map_release(stack_photons);
            bk_scene_release(stack_scene);
            bk_device_release(device);
        }
    }
}

/* ---- Commits ---- */

/* Triangles around the origin, of sizes that grow from 10^least to 10^most: the tree gets as deep as it may. */
static void commit_nested(uint32_t n, uint32_t bins, uint32_t threads, double least, double most, uint32_t compact) {
    float *positions = (float *)malloc(n * 9 * sizeof(float));
    uint32_t *indices = (uint32_t *)malloc(n * 3 * sizeof(uint32_t));
    bk_device *device = device_of(threads);
    bk_scene *scene = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh;
    bk_build_params build;
    uint32_t i, k, state = 1;
    for (i = 0; i < n; i++) {
        float size = (float)pow(10.0, least + (most - least) * i / n);
        for (k = 0; k < 9; k++) {
            state = state * 1664525u + 1013904223u;
            positions[9 * i + k] = size * ((float)(state >> 8) / 16777216.0f - 0.5f);
        }
        for (k = 0; k < 3; k++) {
            indices[3 * i + k] = 3 * i + k;
        }
    }
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = positions;
    mesh.vertex_count = 3 * n;
    mesh.indices = indices;
    mesh.triangle_count = n;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    bk_build_params_init(&build);
    build.quality = BK_BUILD_QUALITY_HIGH;
    build.bins = bins;
    build.compact = compact;
    CHECK_OK(bk_scene_set_build(scene, &build));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    CHECK_OK(bk_mesh_set_positions(scene, 0, positions, 3 * n, 0));
    CHECK_OK(bk_scene_refit(scene));
    bk_scene_release(scene);
    bk_device_release(device);
    free(positions);
    free(indices);
}

static void deep_trees_do_not_overflow_stacks(void) {
    commit_nested(100000, 64, 2, -3.0, 3.0, 0);
    commit_nested(5000, 2, 1, -30.0, 12.0, 0);
    commit_nested(5000, 2, 4, -30.0, 12.0, 1);
}

static int refuse_memory;

static int32_t maybe_refuse(void *user, int64_t bytes) {
    (void)user;
    return bytes < 0 || !refuse_memory;
}

static int32_t cancel(void *user, float fraction, const char *stage) {
    (void)user, (void)fraction, (void)stage;
    return 0;
}

static void a_commit_that_fails_can_be_repeated(void) {
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_scene *scene;
    bk_mesh_desc mesh;
    uint32_t meshes;
    bk_device_desc_init(&desc);
    desc.num_threads = 2;
    desc.memory = maybe_refuse;
    CHECK_OK(bk_device_create(&desc, &device));
    scene = box(device);
    meshes = bk_scene_mesh_count(scene);
    /* No triangles, no vertices, and no such material. */
    bk_mesh_desc_init(&mesh);
    mesh.material = BK_NONE;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "material 4294967295");
    mesh.material = 0;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    CHECK(bk_scene_mesh_count(scene) == meshes + 1);
    refuse_memory = 1;
    CHECK_ERROR(bk_scene_commit(scene, NULL, NULL), BK_ERROR_OUT_OF_MEMORY, "refused");
    refuse_memory = 0;
    CHECK_ERROR(bk_scene_commit(scene, cancel, NULL), BK_ERROR_CANCELLED, "cancelled");
    CHECK(bk_scene_mesh_count(scene) == meshes + 1);
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    bk_scene_release(scene);
    bk_device_release(device);
}

/* ---- Many meshes ---- */

/* Processor time of adding meshes of one triangle: unlike time on a clock, it is the same on a busy machine. */
static double seconds_to_add(uint32_t meshes) {
    static const float positions[9] = {0.0f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f};
    static const uint32_t indices[3] = {0, 1, 2};
    bk_device *device = device_of(1);
    bk_scene *scene = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh;
    clock_t start;
    double seconds;
    uint32_t i;
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = positions;
    mesh.vertex_count = 3;
    mesh.indices = indices;
    mesh.triangle_count = 1;
    start = clock();
    for (i = 0; i < meshes; i++) {
        CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    }
    seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
    bk_scene_release(scene);
    bk_device_release(device);
    return seconds;
}

/* 16 times as many meshes: 16 times the time, where it grew with the square 256 times. */
static void adding_meshes_takes_time_in_proportion(void) {
    double few = seconds_to_add(5000), many = seconds_to_add(80000);
    CHECK(many < 64.0 * few);
}

int main(int argc, char **argv) {
    static void (*const tests[])(void) = {
        /* First, while no other test has started a thread. */
        no_thread_is_started_but_those_of_devices,
        the_callers_floating_point_state_neither_matters_nor_changes,
        light_maps_can_be_read_in_a_progress_callback,
        all_handles_can_be_released_in_a_callback,
        too_many_threads_are_refused,
        a_forked_child_gets_errors_for_work_and_answers_to_queries,
        a_stack_of_64_kb_is_enough_for_every_query,
        deep_trees_do_not_overflow_stacks,
        a_commit_that_fails_can_be_repeated,
        adding_meshes_takes_time_in_proportion,
    };
    size_t i;
    folder = argc > 1 ? argv[1] : "";
    /* A deadlock is a failure too. */
    alarm(600);
    make_rays();
    for (i = 0; i < sizeof tests / sizeof *tests; i++) {
        if (argc < 3 || i == (size_t)atoi(argv[2])) {
            tests[i]();
        }
    }
    return check_report("runtime");
}
