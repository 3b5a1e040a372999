/*
 * Scene files and the cache of unwraps: an opened scene has the hits and the light of the one that was saved, and what is
 * refused.
 *
 *     scene_files FOLDER/
 */
#include "check.h"

#include <math.h>
#include <stdlib.h>

#define ARGUMENT BK_ERROR_INVALID_ARGUMENT
#define STATE BK_ERROR_INVALID_STATE
#define IO BK_ERROR_IO

#define PAGE 64
#define RAYS 256

static char file_name[512], folder_name[512];

static bk_device *device_with(const char *scratch) {
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.num_threads = 2;
    desc.cache_folder = folder_name;
    desc.scratch_folder = scratch;
    CHECK_OK(bk_device_create(&desc, &device));
    return device;
}

static bk_device *device_with_cache(void) {
    return device_with(NULL);
}

/* A room, and a heap of instances of a bent sheet in it: all that files hold but images. */
static bk_scene *described_scene(bk_device *device) {
    bk_scene *scene = NULL;
    bk_mesh_desc mesh;
    float sheet[7 * 7][3];
    uint32_t triangles[2 * 6 * 6][3], count = 0, number = 0;
    int x, y;
    CHECK_OK(bk_scene_create(device, &scene));
    CHECK_OK(bk_scene_load_builtin(scene, "cornell"));
    for (y = 0; y < 7; y++) {
        for (x = 0; x < 7; x++) {
            float *at = sheet[7 * y + x];
            at[0] = 0.1f * x;
            at[1] = 0.1f * y;
            at[2] = 0.05f * (float)((x * 5 + y * 3) % 4);
            if (x < 6 && y < 6) {
                uint32_t a = 7 * y + x, cells[2][3];
                cells[0][0] = cells[1][0] = a;
                cells[0][1] = a + 1;
                cells[0][2] = cells[1][1] = a + 8;
                cells[1][2] = a + 7;
                memcpy(triangles[count], cells, sizeof cells);
                count += 2;
            }
        }
    }
    bk_mesh_desc_init(&mesh);
    mesh.positions = sheet[0];
    mesh.vertex_count = 49;
    mesh.indices = triangles[0];
    mesh.triangle_count = count;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, &number));
    for (x = 0; x < 3; x++) {
        float transform[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1, 1};
        transform[9] += (float)x;
        CHECK_OK(bk_scene_add_instance(scene, number, transform, NULL));
    }
    return scene;
}

static void trace(const bk_scene *scene, bk_hit hits[RAYS]) {
    bk_ray rays[RAYS];
    int i, k;
    for (i = 0; i < RAYS; i++) {
        bk_ray *ray = &rays[i];
        float angle = 0.1f * (float)i;
        for (k = 0; k < 3; k++) {
            ray->origin[k] = 1.5f + 0.01f * (float)((i * (k + 3)) % 50);
        }
        ray->tmin = 0.0f;
        ray->direction[0] = cosf(angle);
        ray->direction[1] = sinf(angle);
        ray->direction[2] = cosf(3.0f * angle);
        ray->tmax = INFINITY;
    }
    memset(hits, 0, RAYS * sizeof hits[0]);
    CHECK_OK(bk_intersect_many(scene, rays, RAYS, 0, hits));
}

static float *baked(const bk_scene *scene, float *pixels) {
    bk_lightmap *lightmap = small_lightmap(scene, PAGE);
    bk_bake_params params;
    bk_bake_params_init(&params);
    params.photon_count = 2000;
    params.gather_rays = 8;
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, pixels, 0));
    bk_lightmap_release(lightmap);
    return pixels;
}

static int32_t never(void *user, float fraction, const char *stage) {
    (void)user, (void)fraction, (void)stage;
    return 0;
}

static void an_opened_scene_is_the_saved_one(void) {
    bk_device *device = device_with_cache();
    bk_scene *scene = described_scene(device);
    bk_hit hits[RAYS], again[RAYS];
    bk_scene_stats stats, opened;
    bk_open_params params;
    float *pixels[2] = {NULL, NULL};
    uint32_t round;
    pixels[0] = (float *)malloc(PAGE * PAGE * 3 * sizeof(float));
    pixels[1] = (float *)malloc(PAGE * PAGE * 3 * sizeof(float));
    CHECK_ERROR(bk_scene_save(scene, file_name, NULL, NULL), STATE, "not committed");
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    CHECK_ERROR(bk_scene_save(scene, file_name, never, NULL), BK_ERROR_CANCELLED, "");
    CHECK_OK(bk_scene_save(scene, file_name, NULL, NULL));
    bk_scene_stats_init(&stats);
    CHECK_OK(bk_scene_get_stats(scene, &stats));
    CHECK(stats.mapped_bytes == 0);
    trace(scene, hits);
    baked(scene, pixels[0]);
    for (round = 0; round < 3; round++) {
        /* The last time, rays wait at parts of the file, and charts lie in files. */
        bk_device *own = round == 2 ? device_with(folder_name) : device;
        bk_scene *other = NULL;
        uint32_t map = round > 0;
        CHECK_OK(bk_scene_create(own, &other));
        bk_open_params_init(&params);
        CHECK(params.map == 1 && params.ray_queues == 0);
        params.map = map;
        params.ray_queues = round == 2;
        CHECK_ERROR(bk_scene_open(other, file_name, &params, never, NULL), BK_ERROR_CANCELLED, "");
        CHECK_OK(bk_scene_open(other, file_name, &params, NULL, NULL));
        bk_scene_stats_init(&opened);
        CHECK_OK(bk_scene_get_stats(other, &opened));
        CHECK(opened.triangles == stats.triangles && opened.bvh_bytes == stats.bvh_bytes);
        CHECK((opened.mapped_bytes > 0) == (map == 1));
        CHECK(bk_scene_mesh_count(other) == bk_scene_mesh_count(scene));
        CHECK(bk_scene_instance_count(other) == 3 && bk_scene_light_count(other) == bk_scene_light_count(scene));
        trace(other, again);
        CHECK(memcmp(hits, again, sizeof hits) == 0);
        /* Its unwraps come from the cache. */
        CHECK(memcmp(pixels[0], baked(other, pixels[1]), PAGE * PAGE * 3 * sizeof(float)) == 0);
        CHECK_ERROR(bk_scene_open(other, file_name, NULL, NULL, NULL), STATE, "committed already");
        /* Over the file that is mapped: that stays as it was for this scene. */
        CHECK_OK(bk_scene_save(other, file_name, NULL, NULL));
        trace(other, again);
        CHECK(memcmp(hits, again, sizeof hits) == 0);
        bk_scene_release(other);
        if (own != device) {
            bk_device_release(own);
        }
    }
    free(pixels[0]);
    free(pixels[1]);
    bk_scene_release(scene);
    bk_device_release(device);
}

static unsigned char *read_all(const char *path, long *size) {
    unsigned char *bytes;
    FILE *file = fopen(path, "rb");
    if (file == NULL) return NULL;
    fseek(file, 0, SEEK_END);
    *size = ftell(file);
    rewind(file);
    bytes = (unsigned char *)malloc((size_t)*size);
    CHECK(fread(bytes, 1, (size_t)*size, file) == (size_t)*size);
    fclose(file);
    return bytes;
}

/* With a scratch folder, meshes and trees lie in files there, and are those of memory, bit for bit. */
static void trees_in_scratch_files(void) {
    bk_device *devices[2];
    char name[2][600];
    unsigned char *files[2];
    long size[2] = {0, 0};
    bk_hit hits[2][RAYS];
    int i;
    devices[0] = device_with(NULL);
    devices[1] = device_with(folder_name);
    for (i = 0; i < 2; i++) {
        bk_scene *scene = described_scene(devices[i]);
        bk_scene_stats stats;
        CHECK_OK(bk_scene_load_builtin(scene, "hall:20000"));
        CHECK_ERROR(bk_scene_commit(scene, never, NULL), BK_ERROR_CANCELLED, "");
        CHECK_OK(bk_scene_commit(scene, NULL, NULL));
        bk_scene_stats_init(&stats);
        CHECK_OK(bk_scene_get_stats(scene, &stats));
        CHECK((stats.mapped_bytes > stats.bytes / 2) == (i == 1) && stats.mapped_bytes < stats.bytes);
        CHECK(stats.kept_triangles == 0);
        trace(scene, hits[i]);
        snprintf(name[i], sizeof name[i], "%s.%d", file_name, i);
        CHECK_OK(bk_scene_save(scene, name[i], NULL, NULL));
        files[i] = read_all(name[i], &size[i]);
        bk_scene_release(scene);
        bk_device_release(devices[i]);
    }
    CHECK(memcmp(hits[0], hits[1], sizeof hits[0]) == 0);
    CHECK(size[0] > 1000000 && size[0] == size[1] && memcmp(files[0], files[1], (size_t)size[0]) == 0);
    free(files[0]);
    free(files[1]);
    remove(name[0]);
    remove(name[1]);
}

/* A scene that is described again has the trees of a file. */
static void trees_of_an_earlier_scene(void) {
    bk_device *device = device_with_cache();
    bk_scene *earlier = described_scene(device), *scene = described_scene(device), *file = NULL;
    bk_scene_stats stats;
    bk_hit hits[RAYS], again[RAYS];
    CHECK_ERROR(bk_scene_commit_from(scene, earlier, NULL, NULL), STATE, "not committed");
    CHECK_ERROR(bk_scene_commit_from(scene, scene, NULL, NULL), STATE, "not committed");
    CHECK_ERROR(bk_scene_commit_from(NULL, earlier, NULL, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_commit_from(scene, NULL, NULL, NULL), ARGUMENT, "earlier is NULL");
    CHECK_OK(bk_scene_commit(earlier, NULL, NULL));
    trace(earlier, hits);
    CHECK_OK(bk_scene_save(earlier, file_name, NULL, NULL));
    bk_scene_release(earlier);
    CHECK_OK(bk_scene_create(device, &file));
    CHECK_OK(bk_scene_open(file, file_name, NULL, NULL, NULL));
    CHECK_ERROR(bk_scene_commit_from(scene, file, never, NULL), BK_ERROR_CANCELLED, "");
    CHECK_OK(bk_scene_commit_from(scene, file, NULL, NULL));
    CHECK_ERROR(bk_scene_commit_from(scene, file, NULL, NULL), STATE, "committed already");
    bk_scene_release(file);
    bk_scene_stats_init(&stats);
    CHECK_OK(bk_scene_get_stats(scene, &stats));
    /* Of three instances with 72 triangles one counts. */
    CHECK(stats.kept_triangles > 72 && stats.kept_triangles == stats.triangles - 2 * 72);
    trace(scene, again);
    CHECK(memcmp(hits, again, sizeof hits) == 0);
    bk_scene_release(scene);
    bk_device_release(device);
}

static void what_is_refused(void) {
    bk_device *device = device_with_cache();
    bk_scene *scene = NULL;
    bk_open_params params;
    bk_device_desc desc;
    char name[600];
    FILE *file;
    CHECK_OK(bk_scene_create(device, &scene));
    CHECK_ERROR(bk_scene_open(NULL, file_name, NULL, NULL, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_open(scene, NULL, NULL, NULL, NULL), ARGUMENT, "path is NULL");
    CHECK_ERROR(bk_scene_save(NULL, file_name, NULL, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_save(scene, NULL, NULL, NULL), ARGUMENT, "path is NULL");
    bk_open_params_init(NULL);
    bk_open_params_init(&params);
    params.map = 2;
    CHECK_ERROR(bk_scene_open(scene, file_name, &params, NULL, NULL), ARGUMENT, "map is 2");
    params.struct_size = 0;
    CHECK_ERROR(bk_scene_open(scene, file_name, &params, NULL, NULL), ARGUMENT, "struct_size");
    CHECK_ERROR(bk_scene_open(scene, "/nowhere/at/all", NULL, NULL, NULL), IO, "/nowhere/at/all");
    CHECK_ERROR(bk_scene_open(scene, folder_name, NULL, NULL, NULL), IO, "folder");
    snprintf(name, sizeof name, "%s-damaged", file_name);
    file = fopen(name, "wb");
    fputs("bk-scene, but nothing of the sort, and long enough to have a foot", file);
    fclose(file);
    CHECK_ERROR(bk_scene_open(scene, name, NULL, NULL, NULL), IO, "damaged");
    /* What was refused can be used. */
    CHECK_OK(bk_scene_open(scene, file_name, NULL, NULL, NULL));
    bk_scene_release(scene);
    scene = described_scene(device);
    CHECK_ERROR(bk_scene_open(scene, file_name, NULL, NULL, NULL), STATE, "not empty");
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    CHECK_ERROR(bk_scene_save(scene, "/nowhere/at/all", NULL, NULL), IO, "/nowhere/at/all");
#ifdef __linux__
    CHECK_ERROR(bk_scene_save(scene, "/dev/full", NULL, NULL), IO, "/dev/full");
#endif
    bk_scene_release(scene);
    bk_device_release(device);
    bk_device_desc_init(&desc);
    CHECK(desc.cache_folder == NULL);
    desc.cache_folder = "\xff\xfe";
    CHECK_ERROR(bk_device_create(&desc, &device), ARGUMENT, "cache_folder");
    bk_device_desc_init(&desc);
    CHECK(desc.scratch_folder == NULL);
    desc.scratch_folder = "\xff\xfe";
    CHECK_ERROR(bk_device_create(&desc, &device), ARGUMENT, "scratch_folder");
}

int main(int argc, char **argv) {
    const char *folder = argc > 1 ? argv[1] : "";
    snprintf(file_name, sizeof file_name, "%sroom.bkscene", folder);
    snprintf(folder_name, sizeof folder_name, "%sunwraps", folder);
    an_opened_scene_is_the_saved_one();
    /* (The folder was made for the cache.) */
    trees_in_scratch_files();
    trees_of_an_earlier_scene();
    what_is_refused();
    return check_report("scene_files");
}
