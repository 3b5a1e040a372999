/* What comes out of a light map: padding around the caller's own charts, the validity layer, results and checkpoints
 * on disk. C99. */
#include "check.h"
#include <math.h>
#include <stdlib.h>

enum { PAGE = 128 };

static const uint32_t LIGHT_LAYERS[4] = {BK_LAYER_COMBINED, BK_LAYER_INDIRECT, BK_LAYER_DIRECT, BK_LAYER_RADIANCE};

typedef struct {
    float position[3], uv[2];
} vertex;

/* A room of 4 x 3 x 5 whose six faces have light map coordinates of their own, in two rows of three cells. */
static const float GAP = 0.02f;

static bk_scene *room(bk_device *device, float grey) {
    static const int FACES[6][4] = {{0, 4, 5, 1}, {2, 3, 7, 6}, {0, 1, 3, 2}, {4, 6, 7, 5}, {0, 2, 6, 4}, {1, 5, 7, 3}};
    static const int QUAD[6] = {0, 1, 2, 0, 2, 3};
    vertex vertices[24];
    uint32_t indices[36], id;
    bk_material_desc material;
    bk_mesh_desc mesh;
    bk_light_desc light;
    bk_scene *scene = NULL;
    int face, i;

    for (face = 0; face < 6; face++) {
        float u = (float)(face % 3) / 3.0f, v = (float)(face / 3) / 2.0f;
        for (i = 0; i < 4; i++) {
            vertex *at = &vertices[4 * face + i];
            int corner = FACES[face][i];
            at->position[0] = (float)(corner & 1) * 4.0f;
            at->position[1] = (float)(corner >> 1 & 1) * 3.0f;
            at->position[2] = (float)(corner >> 2) * 5.0f;
            at->uv[0] = i == 1 || i == 2 ? u + 1.0f / 3.0f - GAP : u + GAP;
            at->uv[1] = i >= 2 ? v + 0.5f - GAP : v + GAP;
        }
        for (i = 0; i < 6; i++) indices[6 * face + i] = (uint32_t)(4 * face + QUAD[i]);
    }
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    material.albedo[0] = material.albedo[1] = material.albedo[2] = grey;
    CHECK_OK(bk_scene_add_material(scene, &material, &id));
    bk_mesh_desc_init(&mesh);
    mesh.positions = vertices[0].position;
    mesh.position_stride = sizeof(vertex);
    mesh.vertex_count = 24;
    mesh.indices = indices;
    mesh.triangle_count = 12;
    mesh.lightmap_uvs = vertices[0].uv;
    mesh.lightmap_uv_stride = sizeof(vertex);
    mesh.material = id;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, &id));
    bk_light_desc_init(&light);
    light.type = BK_LIGHT_RECT;
    light.position[0] = 1.5f;
    light.position[1] = 2.99f;
    light.position[2] = 2.0f;
    light.edge_u[0] = light.edge_v[2] = 1.0f;
    light.edge_u[1] = light.edge_u[2] = light.edge_v[0] = light.edge_v[1] = 0.0f;
    light.color[0] = light.color[1] = light.color[2] = 10.0f;
    CHECK_OK(bk_scene_add_light(scene, &light, &id));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

static bk_lightmap *lightmap_of(const bk_scene *scene, uint32_t padding) {
    bk_lightmap_desc desc;
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc_init(&desc);
    desc.page_size = PAGE;
    desc.padding = padding;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    return lightmap;
}

/* A bake in a moment that runs every stage. */
static bk_bake_params quick(void) {
    bk_bake_params params;
    bk_bake_params_init(&params);
    params.photon_count = 20000;
    params.direct_samples = 4;
    return params;
}

static float *read_rgb(const bk_lightmap *lightmap, uint32_t layer) {
    float *pixels = (float *)malloc(sizeof(float) * 3 * PAGE * PAGE);
    CHECK_OK(bk_lightmap_read(lightmap, 0, layer, BK_FORMAT_RGB32F, pixels, 0));
    return pixels;
}

static float *read_validity(const bk_lightmap *lightmap) {
    float *validity = (float *)malloc(sizeof(float) * PAGE * PAGE);
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_VALIDITY, BK_FORMAT_R32F, validity, 0));
    return validity;
}

/* What a shader sees at (u, v). */
static double bilinear(const float *pixels, double u, double v) {
    double x = u * PAGE - 0.5, y = v * PAGE - 0.5;
    int x0 = (int)floor(x), y0 = (int)floor(y);
    double fx = x - x0, fy = y - y0;
    const float *a = pixels + 3 * (y0 * PAGE + x0), *b = a + 3 * PAGE;
    return (a[0] * (1.0 - fx) + a[3] * fx) * (1.0 - fy) + (b[0] * (1.0 - fx) + b[3] * fx) * fy;
}

/* The floor lies at the page's corner: two of its edges look outwards, two at other charts. The light stands in its
 * middle, so that opposite edges are lit alike. */
static void edges_of_given_charts_are_not_dark(bk_device *device) {
    bk_scene *scene = room(device, 0.75f);
    bk_lightmap *lightmap = lightmap_of(scene, 2);
    bk_bake_params params = quick();
    double least = 1.0;
    int layer, i;

    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    for (layer = 0; layer < 4; layer++) {
        float *pixels = read_rgb(lightmap, LIGHT_LAYERS[layer]);
        for (i = 0; i < 20; i++) {
            double along = (i + 0.5) / 20.0, width = 1.0 / 3.0 - 2.0 * GAP, height = 0.5 - 2.0 * GAP;
            /* A texel inside, at least, is a chart's own light. */
            double texel = 1.5 / PAGE, u = GAP + along * width, v = GAP + along * height;
            double u0 = GAP, u1 = GAP + width, v0 = GAP, v1 = GAP + height;
            if (along < 0.1 || along > 0.9) continue;
            least = fmin(least, bilinear(pixels, u0, v) / bilinear(pixels, u0 + texel, v));
            least = fmin(least, bilinear(pixels, u1, v) / bilinear(pixels, u1 - texel, v));
            least = fmin(least, bilinear(pixels, u, v0) / bilinear(pixels, u, v0 + texel));
            least = fmin(least, bilinear(pixels, u, v1) / bilinear(pixels, u, v1 - texel));
        }
        free(pixels);
    }
    printf("least light at an edge by that a texel and a half inside: %.3f\n", least);
    CHECK(least > 0.85);
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
}

/* 1 for covered, 0.5 for padding, 0 elsewhere; before a bake too. */
static void validity_tells_covered_filled_and_empty(bk_device *device) {
    bk_scene *scene = room(device, 0.75f);
    bk_lightmap *lightmap = lightmap_of(scene, 1);
    bk_bake_params params = quick();
    float *light = (float *)malloc(sizeof(float) * 3 * PAGE * PAGE), *before, *after, *positions, *normals;
    uint32_t *triangles = (uint32_t *)malloc(sizeof(uint32_t) * PAGE * PAGE);
    uint64_t wrong = 0, count[3] = {0, 0, 0};
    int i, layer;

    for (layer = 0; layer < 4; layer++) {
        CHECK_ERROR(bk_lightmap_read(lightmap, 0, LIGHT_LAYERS[layer], BK_FORMAT_RGB32F, light, 0),
                    BK_ERROR_INVALID_STATE, "baked");
    }
    before = read_validity(lightmap);
    positions = read_rgb(lightmap, BK_LAYER_POSITION);
    normals = read_rgb(lightmap, BK_LAYER_NORMAL);
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_TRIANGLE, BK_FORMAT_R32U, triangles, 0));
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, light, 0));
    after = read_validity(lightmap);
    for (i = 0; i < PAGE * PAGE; i++) {
        const float *n = normals + 3 * i;
        float length = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
        int covered = triangles[i] != BK_NONE;
        wrong += before[i] != after[i] || (after[i] == 1.0f) != covered || (after[i] > 0.0f) != (light[3 * i] > 0.0f);
        wrong += fabsf(length - (covered ? 1.0f : 0.0f)) > 1e-5f;
        wrong += !covered && (positions[3 * i] != 0.0f || positions[3 * i + 1] != 0.0f);
        count[(int)(2.0f * after[i])]++;
    }
    printf("%u texels empty, %u filled, %u covered\n", (unsigned)count[0], (unsigned)count[1], (unsigned)count[2]);
    CHECK(wrong == 0);
    CHECK(count[0] > 0 && count[1] > 500 && count[2] > 0);
    free(light);
    free(before);
    free(after);
    free(positions);
    free(normals);
    free(triangles);
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
}

/* All layers of light and validity have the same bits. */
static int same_light(const bk_lightmap *a, const bk_lightmap *b) {
    int same = 1, layer;
    for (layer = 0; layer < 4; layer++) {
        float *x = read_rgb(a, LIGHT_LAYERS[layer]), *y = read_rgb(b, LIGHT_LAYERS[layer]);
        same &= memcmp(x, y, sizeof(float) * 3 * PAGE * PAGE) == 0;
        free(x);
        free(y);
    }
    {
        float *x = read_validity(a), *y = read_validity(b);
        same &= memcmp(x, y, sizeof(float) * PAGE * PAGE) == 0;
        free(x);
        free(y);
    }
    return same;
}

static int32_t cancel(void *user, float fraction, const char *stage) {
    (void)user;
    (void)fraction;
    (void)stage;
    return 0;
}

static void layouts_come_back(bk_device *device, const char *folder) {
    bk_scene *scene = room(device, 0.75f), *darker = room(device, 0.5f);
    bk_lightmap *made = lightmap_of(scene, 2), *loaded = NULL;
    bk_bake_params params = quick();
    const bk_result refused = BK_ERROR_INVALID_ARGUMENT;
    bk_lightmap_desc desc;
    char path[1024];
    FILE *file;

    bk_lightmap_desc_init(&desc);
    desc.page_size = PAGE;
    desc.padding = 2;
    snprintf(path, sizeof path, "%slayout", folder);
    CHECK_OK(bk_lightmap_save_layout(made, path, NULL, NULL));
    CHECK_OK(bk_lightmap_load_layout(scene, &desc, path, NULL, NULL, &loaded));
    CHECK_OK(bk_bake(made, &params, NULL, NULL, NULL));
    CHECK_OK(bk_bake(loaded, &params, NULL, NULL, NULL));
    CHECK(same_light(made, loaded));
    bk_lightmap_release(loaded);

    CHECK_ERROR(bk_lightmap_save_layout(NULL, path, NULL, NULL), refused, "lightmap is NULL");
    CHECK_ERROR(bk_lightmap_save_layout(made, NULL, NULL, NULL), refused, "path is NULL");
    CHECK_ERROR(bk_lightmap_load_layout(NULL, &desc, path, NULL, NULL, &loaded), refused, "scene is NULL");
    CHECK_ERROR(bk_lightmap_load_layout(scene, &desc, path, NULL, NULL, NULL), refused, "out is NULL");
    CHECK_ERROR(bk_lightmap_load_layout(scene, &desc, NULL, NULL, NULL, &loaded), refused, "path is NULL");
    CHECK(loaded == NULL);
    CHECK_ERROR(bk_lightmap_load_layout(scene, NULL, path, NULL, NULL, &loaded), refused, "page_size");
    CHECK_ERROR(bk_lightmap_load_layout(darker, &desc, path, NULL, NULL, &loaded), refused, "the scene's materials");
    CHECK_ERROR(bk_lightmap_load_layout(scene, &desc, path, cancel, NULL, &loaded), BK_ERROR_CANCELLED, "");
    file = fopen(path, "r+b");
    CHECK(file != NULL && fseek(file, 300, SEEK_SET) == 0 && fputs("damage", file) >= 0);
    if (file) fclose(file);
    CHECK_ERROR(bk_lightmap_load_layout(scene, &desc, path, NULL, NULL, &loaded), BK_ERROR_IO, "is damaged");
    bk_lightmap_release(made);
    bk_scene_release(scene);
    bk_scene_release(darker);
}

static void shards_come_back_as_one_bake(bk_device *device, const char *folder) {
    bk_scene *scene = room(device, 0.75f), *darker = room(device, 0.5f);
    bk_lightmap *whole = lightmap_of(scene, 2), *shard = lightmap_of(scene, 2), *all = lightmap_of(scene, 2);
    bk_lightmap *other = lightmap_of(darker, 2);
    bk_bake_params params = quick();
    bk_lightmap_info info;
    char path[2][1024];
    FILE *file;
    int i;

    CHECK_ERROR(bk_lightmap_save_result(all, "x", NULL, NULL), BK_ERROR_INVALID_STATE, "baked");
    CHECK_OK(bk_bake(whole, &params, NULL, NULL, NULL));
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(whole, &info));
    for (i = 0; i < 2; i++) {
        snprintf(path[i], sizeof path[i], "%sshard%d", folder, i);
        params.texel_begin = i == 0 ? 0 : info.texels / 3;
        params.texel_end = i == 0 ? info.texels / 3 : info.texels;
        bk_lightmap_release(shard);
        shard = lightmap_of(scene, 2);
        CHECK_OK(bk_bake(shard, &params, NULL, NULL, NULL));
        CHECK_OK(bk_lightmap_save_result(shard, path[i], NULL, NULL));
    }
    CHECK_OK(bk_lightmap_load_result(all, path[1], NULL, NULL));
    CHECK(!same_light(whole, all));
    CHECK_OK(bk_lightmap_load_result(all, path[0], NULL, NULL));
    CHECK(same_light(whole, all));

    CHECK_ERROR(bk_lightmap_load_result(NULL, path[0], NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "lightmap is NULL");
    CHECK_ERROR(bk_lightmap_load_result(all, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "path is NULL");
    CHECK_ERROR(bk_lightmap_save_result(all, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "path is NULL");
    CHECK_ERROR(bk_lightmap_load_result(all, "/no/such/file", NULL, NULL), BK_ERROR_IO, "/no/such/file");
    CHECK_ERROR(bk_lightmap_load_result(all, path[0], cancel, NULL), BK_ERROR_CANCELLED, "");
    CHECK_ERROR(bk_lightmap_load_result(other, path[0], NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "the scene's materials");
    file = fopen(path[0], "r+b");
    CHECK(file != NULL && fseek(file, 5000, SEEK_SET) == 0 && fputs("damage", file) >= 0);
    if (file) fclose(file);
    CHECK_ERROR(bk_lightmap_load_result(all, path[0], NULL, NULL), BK_ERROR_IO, "is damaged");
    CHECK(same_light(whole, all));
    bk_lightmap_release(whole);
    bk_lightmap_release(shard);
    bk_lightmap_release(all);
    bk_lightmap_release(other);
    bk_scene_release(scene);
    bk_scene_release(darker);
}

static int32_t cancel_late(void *user, float fraction, const char *stage) {
    (void)user;
    (void)stage;
    return fraction < 0.5f;
}

/* Killed processes: kill_resume.c. */
static void a_cancelled_bake_goes_on_from_its_checkpoint(bk_device *device, const char *folder) {
    bk_scene *scene = room(device, 0.75f);
    bk_lightmap *whole = lightmap_of(scene, 2), *again = lightmap_of(scene, 2);
    bk_bake_params params = quick();
    bk_bake_stats stats;
    char path[1024];

    snprintf(path, sizeof path, "%scheckpoint", folder);
    remove(path);
    CHECK_OK(bk_bake(whole, &params, NULL, NULL, NULL));
    params.checkpoint = path;
    CHECK_ERROR(bk_bake(again, &params, cancel_late, NULL, NULL), BK_ERROR_CANCELLED, "");
    params.seed = 1;
    CHECK_ERROR(bk_bake(again, &params, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "seed (0, here 1)");
    params.seed = 0;
    params.checkpoint_seconds = -1.0f;
    CHECK_ERROR(bk_bake(again, &params, NULL, NULL, NULL), BK_ERROR_INVALID_ARGUMENT, "checkpoint_seconds is -1");
    params.checkpoint_seconds = 0.0f;
    bk_bake_stats_init(&stats);
    CHECK_OK(bk_bake(again, &params, NULL, NULL, &stats));
    CHECK(stats.photons.rays == 0);
    CHECK(same_light(whole, again));
    params.checkpoint = folder;
    CHECK_ERROR(bk_bake(again, &params, NULL, NULL, NULL), BK_ERROR_IO, folder);
    bk_lightmap_release(whole);
    bk_lightmap_release(again);
    bk_scene_release(scene);
}

/* The smallest of denoisers: the mean over 9 x 9 texels of the same chart. */
static void smooth(const float *from, const uint32_t *charts, const float *validity, float *to) {
    int x, y, dx, dy, c;
    for (y = 0; y < PAGE; y++) {
        for (x = 0; x < PAGE; x++) {
            int at = y * PAGE + x, n = 0;
            to[3 * at] = to[3 * at + 1] = to[3 * at + 2] = 0.0f;
            for (dy = -4; dy <= 4; dy++) {
                for (dx = -4; dx <= 4; dx++) {
                    const int near = at + dy * PAGE + dx;
                    if (x + dx < 0 || x + dx >= PAGE || y + dy < 0 || y + dy >= PAGE) continue;
                    if (charts[near] != charts[at] || validity[near] != 1.0f) continue;
                    for (c = 0; c < 3; c++) to[3 * at + c] += from[3 * near + c];
                    n++;
                }
            }
            for (c = 0; c < 3; c++) to[3 * at + c] = n > 0 ? to[3 * at + c] / (float)n : NAN;
        }
    }
}

/* The root of the mean square of relative differences of covered texels. */
static double difference(const float *a, const float *b, const float *validity) {
    double sum = 0.0, n = 0.0;
    int i;
    for (i = 0; i < PAGE * PAGE; i++) {
        if (validity[i] == 1.0f) {
            double relative = (double)a[3 * i] / (double)b[3 * i] - 1.0;
            sum += relative * relative, n += 1.0;
        }
    }
    return sqrt(sum / n);
}

static void denoised_light_is_handed_back(bk_device *device) {
    static const uint32_t HALVES[2] = {BK_LAYER_FIRST_HALF, BK_LAYER_SECOND_HALF};
    const bk_result refused = BK_ERROR_INVALID_ARGUMENT;
    const uint32_t indirect = BK_LAYER_INDIRECT, twice[2] = {BK_LAYER_DIRECT, BK_LAYER_DIRECT};
    bk_scene *scene = room(device, 0.8f);
    bk_lightmap *lightmap = lightmap_of(scene, 2);
    bk_bake_params params = quick();
    uint32_t *charts = (uint32_t *)malloc(sizeof(uint32_t) * PAGE * PAGE);
    float *out = (float *)malloc(sizeof(float) * 3 * PAGE * PAGE);
    uint16_t *halves = (uint16_t *)calloc(8 * PAGE * PAGE, sizeof(uint16_t));
    float *truth, *noisy, *half[2], *validity, *now;
    double before, after;
    int i;

    CHECK_ERROR(bk_lightmap_write(lightmap, &indirect, 1, BK_FORMAT_RGB32F, out, NULL, NULL), BK_ERROR_INVALID_STATE,
                "has not been baked");
    params.blur_radius = 0;
    params.gather_rays = 4096;
    params.photon_count = 200000;
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    truth = read_rgb(lightmap, BK_LAYER_INDIRECT);
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_INDIRECT | BK_LAYER_FIRST_HALF, BK_FORMAT_RGB32F, out, 0),
                BK_ERROR_INVALID_STATE, "one pass");
    params.gather_rays = 1;
    params.passes = 2;
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    noisy = read_rgb(lightmap, BK_LAYER_INDIRECT);
    validity = read_validity(lightmap);
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_CHART, BK_FORMAT_R32U, charts, 0));
    for (i = 0; i < PAGE * PAGE; i++) CHECK((charts[i] == BK_NONE) == (validity[i] == 0.0f));
    for (i = 0; i < 2; i++) half[i] = read_rgb(lightmap, BK_LAYER_INDIRECT | HALVES[i]);
    for (i = 0; i < 3 * PAGE * PAGE; i++) {
        CHECK(fabs((double)(half[0][i] + half[1][i] - 2.0f * noisy[i])) <= 1e-4 * (double)noisy[i] + 1e-6);
    }
    /* Each half has twice the variance of the light, and so has their difference twice that of a half. */
    before = difference(noisy, truth, validity);
    after = difference(half[0], half[1], validity);
    CHECK(before > 0.01 && after > 1.5 * before && after < 3.0 * before);
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_RADIANCE | BK_LAYER_FIRST_HALF, BK_FORMAT_RGB32F, out, 0), refused,
                "no halves");
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_DIRECT | 0x300, BK_FORMAT_RGB32F, out, 0), refused, "both halves");

    smooth(noisy, charts, validity, out);
    CHECK_OK(bk_lightmap_write(lightmap, &indirect, 1, BK_FORMAT_RGB32F, out, NULL, NULL));
    now = read_rgb(lightmap, BK_LAYER_INDIRECT);
    after = difference(now, truth, validity);
    CHECK(after < 0.7 * before);
    for (i = 0; i < 3 * PAGE * PAGE; i++) {
        if (validity[i / 3] == 1.0f && now[i] != out[i]) CHECK(0);
    }
    CHECK_OK(bk_lightmap_write(lightmap, &indirect, 1, BK_FORMAT_RGBA16F, halves, NULL, NULL));
    free(now);
    now = read_rgb(lightmap, BK_LAYER_INDIRECT);
    for (i = 0; i < 3 * PAGE * PAGE; i++) CHECK(now[i] == 0.0f);
    CHECK_OK(bk_lightmap_write(lightmap, NULL, 0, BK_FORMAT_RGB32F, NULL, NULL, NULL));
    CHECK_ERROR(bk_lightmap_write(NULL, &indirect, 1, BK_FORMAT_RGB32F, out, NULL, NULL), refused, "lightmap");
    CHECK_ERROR(bk_lightmap_write(lightmap, NULL, 1, BK_FORMAT_RGB32F, out, NULL, NULL), refused, "layers");
    CHECK_ERROR(bk_lightmap_write(lightmap, &indirect, 1, BK_FORMAT_RGB32F, NULL, NULL, NULL), refused, "texels");
    CHECK_ERROR(bk_lightmap_write(lightmap, &indirect, 1, BK_FORMAT_R32F, out, NULL, NULL), refused, "format is 3");
    CHECK_ERROR(bk_lightmap_write(lightmap, twice, 2, BK_FORMAT_RGBA16F, halves, NULL, NULL), refused, "as an earlier one");
    for (i = 0; i < 3 * PAGE * PAGE; i++) out[i] = -1.0f;
    CHECK_ERROR(bk_lightmap_write(lightmap, &indirect, 1, BK_FORMAT_RGB32F, out, NULL, NULL), refused, "at texel");

    free(truth), free(noisy), free(half[0]), free(half[1]), free(validity), free(now), free(charts), free(out), free(halves);
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
}

int main(int argc, char **argv) {
    bk_device *device = NULL;
    if (argc != 2) {
        fprintf(stderr, "usage: lightmap_files FOLDER/\n");
        return 2;
    }
    CHECK_OK(bk_device_create(NULL, &device));
    edges_of_given_charts_are_not_dark(device);
    validity_tells_covered_filled_and_empty(device);
    denoised_light_is_handed_back(device);
    layouts_come_back(device, argv[1]);
    shards_come_back_as_one_bake(device, argv[1]);
    a_cancelled_bake_goes_on_from_its_checkpoint(device, argv[1]);
    bk_device_release(device);
    return check_report("lightmap_files");
}
