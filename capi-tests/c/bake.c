/*
 * A bake from beginning to end in C99: a room described by hand, queried, baked with progress,
 * cancelled and baked again, read out and saved.
 *
 *     bake_c OUT_PREFIX
 */
#include "check.h"

#include <math.h>
#include <stdlib.h>

enum { PAGE = 64, DIRECTIONS = 100 };

/* ---- Callbacks ---- */

struct progress {
    float fraction;  /* last reported */
    float cancel_at; /* fraction at which to cancel */
    int calls, fell, stages;
    char stage[64];
};

static int32_t on_progress(void *user, float fraction, const char *stage) {
    struct progress *p = (struct progress *)user;
    p->calls++;
    p->fell += fraction < p->fraction || fraction > 1.0f;
    p->fraction = fraction;
    if (strcmp(p->stage, stage) != 0) {
        p->stages++;
        snprintf(p->stage, sizeof p->stage, "%s", stage);
    }
    return fraction < p->cancel_at;
}

static struct progress progress_until(float cancel_at) {
    struct progress p;
    memset(&p, 0, sizeof p);
    p.cancel_at = cancel_at;
    return p;
}

static int32_t on_memory(void *user, int64_t bytes) {
    /* Several calls come at a time. */
    __atomic_fetch_add((int64_t *)user, bytes, __ATOMIC_SEQ_CST);
    return 1;
}

/* ---- The scene: an open box, 2 x 2 x 2, z up, seen from inside, red and green side walls ---- */

struct vertex {
    float position[3];
    float unrelated[2];
};

static const struct vertex BOX[8] = {
    {{-1, -1, 0}, {0, 0}}, {{1, -1, 0}, {0, 0}}, {{-1, 1, 0}, {0, 0}}, {{1, 1, 0}, {0, 0}},
    {{-1, -1, 2}, {0, 0}}, {{1, -1, 2}, {0, 0}}, {{-1, 1, 2}, {0, 0}}, {{1, 1, 2}, {0, 0}},
};

/* Floor, ceiling, back (+y), left (-x), right (+x); counter-clockwise from inside. */
static const uint32_t TRIANGLES[10][3] = {
    {0, 1, 3}, {0, 3, 2}, {4, 6, 7}, {4, 7, 5}, {2, 3, 7}, {2, 7, 6}, {0, 2, 6}, {0, 6, 4}, {1, 5, 7}, {1, 7, 3},
};

static bk_scene *make_scene(bk_device *device) {
    bk_scene *scene = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh;
    bk_light_desc light;
    uint32_t white = BK_NONE, red = BK_NONE, green = BK_NONE, id = BK_NONE;
    uint32_t materials[10];
    int i;

    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    CHECK(material.struct_size == sizeof material && material.albedo[0] == 0.5f);
    for (i = 0; i < 3; i++) material.albedo[i] = 0.7f;
    CHECK_OK(bk_scene_add_material(scene, &material, &white));
    material.albedo[1] = material.albedo[2] = 0.1f;
    CHECK_OK(bk_scene_add_material(scene, &material, &red));
    material.albedo[0] = 0.1f;
    material.albedo[1] = 0.7f;
    CHECK_OK(bk_scene_add_material(scene, &material, &green));
    CHECK(white == 0 && red == 1 && green == 2);

    for (i = 0; i < 10; i++) materials[i] = i < 6 ? white : i < 8 ? red : green;
    bk_mesh_desc_init(&mesh);
    mesh.positions = BOX[0].position;
    mesh.position_stride = sizeof(struct vertex);
    mesh.vertex_count = 8;
    mesh.indices = TRIANGLES[0];
    mesh.triangle_count = 10;
    mesh.triangle_materials = materials;
    mesh.flags = BK_MESH_STRICT;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, &id));
    CHECK(id == 0 && bk_scene_mesh_count(scene) == 1);

    bk_light_desc_init(&light);
    light.type = BK_LIGHT_RECT;
    light.position[0] = light.position[1] = -0.25f;
    light.position[2] = 1.9f;
    light.edge_u[1] = 0.5f; /* y x x = -z: it shines down */
    light.edge_v[0] = 0.5f;
    for (i = 0; i < 3; i++) light.color[i] = 10.0f;
    CHECK_OK(bk_scene_add_light(scene, &light, &id));
    CHECK(id == 0 && bk_scene_light_count(scene) == 1);
    return scene;
}

static void commit(bk_scene *scene) {
    struct progress p = progress_until(-1.0f);
    bk_scene_stats stats;
    float lower[3], upper[3];

    CHECK_ERROR(bk_scene_commit(scene, on_progress, &p), BK_ERROR_CANCELLED, "cancelled");
    p = progress_until(2.0f);
    CHECK_OK(bk_scene_commit(scene, on_progress, &p));
    CHECK(p.calls > 0 && p.fell == 0 && p.fraction == 1.0f);

    bk_scene_stats_init(&stats);
    CHECK_OK(bk_scene_get_stats(scene, &stats));
    CHECK(stats.triangles == 10 && stats.skipped_degenerate == 0 && stats.nodes > 0 && stats.bytes > 0);
    CHECK(stats.struct_size == sizeof stats && stats.sah_cost > 0.0f && stats.build_seconds >= 0.0);
    CHECK_OK(bk_scene_bounds(scene, lower, upper));
    CHECK(lower[0] == -1.0f && lower[2] == 0.0f && upper[1] == 1.0f && upper[2] == 2.0f);
}

static void trace(const bk_scene *scene) {
    bk_ray ray = {{0.25f, -0.5f, 1.0f}, 0.0f, {0.0f, 0.0f, -2.0f}, INFINITY};
    bk_ray rays[DIRECTIONS];
    bk_hit hit, hits[DIRECTIONS], gathered[DIRECTIONS];
    float directions[DIRECTIONS][3];
    uint8_t occluded[DIRECTIONS];
    bk_mesh_view view;
    int i, same = 0;

    bk_intersect(scene, &ray, &hit);
    CHECK(hit.t == 0.5f && hit.mesh == 0 && hit.triangle == 0 && hit.instance == BK_NONE);
    CHECK(fabsf(hit.u - 0.375f) < 1e-6f && fabsf(hit.v - 0.25f) < 1e-6f);
    CHECK(bk_occluded(scene, &ray) == 1);
    ray.tmax = 0.49f;
    bk_intersect(scene, &ray, &hit);
    CHECK(hit.t == INFINITY && hit.triangle == BK_NONE && hit.mesh == BK_NONE);
    CHECK(bk_occluded(scene, &ray) == 0);

    for (i = 0; i < DIRECTIONS; i++) {
        float a = 0.37f * (float)i;
        float d[3] = {cosf(a), sinf(a), 0.02f * (float)(i - DIRECTIONS / 2)};
        memcpy(directions[i], d, sizeof d);
        rays[i] = ray;
        memcpy(rays[i].direction, d, sizeof d);
        rays[i].tmax = 10.0f;
    }
    CHECK_OK(bk_intersect_many(scene, rays, DIRECTIONS, BK_RAYS_PARALLEL, hits));
    CHECK_OK(bk_occluded_many(scene, rays, DIRECTIONS, 0, occluded));
    CHECK_OK(bk_gather(scene, ray.origin, directions[0], DIRECTIONS, 10.0f, 0, gathered));
    for (i = 0; i < DIRECTIONS; i++) {
        int hits_something = hits[i].triangle != BK_NONE;
        same += occluded[i] == hits_something && gathered[i].triangle == hits[i].triangle &&
                (!hits_something || fabsf(gathered[i].t - hits[i].t) <= 1e-5f * hits[i].t);
    }
    CHECK(same == DIRECTIONS);

    bk_mesh_view_init(&view);
    CHECK_OK(bk_scene_get_mesh(scene, 0, &view));
    CHECK(view.vertex_count == 8 && view.triangle_count == 10);
    CHECK(view.positions[3 * 7] == 1.0f && view.indices[3 * 9 + 1] == 7);
}

static void photons(const bk_scene *scene) {
    const float positions[2][3] = {{0, 0, 0}, {0, 0, 0}};
    const float normals[2][3] = {{0, 0, 1}, {0, 0, -1}};
    float irradiance[2][3];
    bk_photon_map *map = NULL;
    bk_photon_params params;
    bk_photon_view view;
    struct progress p = progress_until(-1.0f);

    bk_photon_params_init(&params);
    params.photon_count = 20000;
    params.seed = 7;
    CHECK_ERROR(bk_photon_map_create(scene, &params, on_progress, &p, &map), BK_ERROR_CANCELLED, "cancelled");
    CHECK(map == NULL);
    p = progress_until(2.0f);
    CHECK_OK(bk_photon_map_create(scene, &params, on_progress, &p, &map));
    CHECK(p.calls > 0 && p.fell == 0);
    bk_photon_view_init(&view);
    CHECK_OK(bk_photon_map_get_photons(map, &view));
    CHECK(view.count > 0 && view.radius > 0.0f && view.power[0] > 0.0f);
    CHECK(fabsf(view.position[0]) <= 1.001f);
    CHECK_OK(bk_photon_map_estimate(map, positions[0], normals[0], 2, irradiance[0]));
    CHECK(irradiance[0][0] > 0.1f && irradiance[1][0] == 0.0f);
    bk_photon_map_retain(map);
    bk_photon_map_release(map);
    bk_photon_map_release(map);
}

/* ---- The light map ---- */

static float *read_rgb(const bk_lightmap *lightmap, uint32_t layer) {
    float *pixels = (float *)malloc(sizeof(float) * 3 * PAGE * PAGE);
    CHECK_OK(bk_lightmap_read(lightmap, 0, layer, BK_FORMAT_RGB32F, pixels, 0));
    return pixels;
}

static double half_value(uint16_t bits) {
    int exponent = bits >> 10 & 31, fraction = bits & 1023;
    double magnitude = exponent ? ldexp(1024 + fraction, exponent - 25) : ldexp(fraction, -24);
    return bits & 0x8000 ? -magnitude : magnitude;
}

static void read_layers(const bk_lightmap *lightmap, uint64_t texels) {
    float *combined = read_rgb(lightmap, BK_LAYER_COMBINED), *direct = read_rgb(lightmap, BK_LAYER_DIRECT);
    float *indirect = read_rgb(lightmap, BK_LAYER_INDIRECT), *normal = read_rgb(lightmap, BK_LAYER_NORMAL);
    float *position = read_rgb(lightmap, BK_LAYER_POSITION), *radiance = read_rgb(lightmap, BK_LAYER_RADIANCE);
    float *validity = (float *)malloc(sizeof(float) * PAGE * PAGE);
    uint32_t *triangle = (uint32_t *)malloc(sizeof(uint32_t) * PAGE * PAGE);
    enum { HALF_STRIDE = PAGE * 8 + 24 };
    unsigned char *half = (unsigned char *)malloc((size_t)HALF_STRIDE * PAGE);
    uint64_t covered = 0, wrong_sum = 0, wrong_half = 0, dark = 0, off_surface = 0, padding_touched = 0;
    double floor_sum = 0.0, floor_count = 0.0;
    int i, c;

    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_VALIDITY, BK_FORMAT_R32F, validity, 0));
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_TRIANGLE, BK_FORMAT_R32U, triangle, 0));
    memset(half, 0xab, (size_t)HALF_STRIDE * PAGE);
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGBA16F, half, HALF_STRIDE));

    for (i = 0; i < PAGE * PAGE; i++) {
        uint16_t h[4];
        memcpy(h, half + (size_t)(i / PAGE) * HALF_STRIDE + (size_t)(i % PAGE) * 8, 8);
        for (c = 0; c < 3; c++) {
            float e = combined[3 * i + c];
            wrong_sum += !(fabsf(e - direct[3 * i + c] - indirect[3 * i + c]) <= 1e-5f * e);
            wrong_half += !(fabs(half_value(h[c]) - e) <= e / 2048.0 + 1e-7);
        }
        wrong_half += half_value(h[3]) != 1.0;
        if (triangle[i] == BK_NONE) continue;
        covered++;
        dark += !(combined[3 * i] > 0.0f) || !(radiance[3 * i] > 0.0f) || !(validity[i] > 0.0f);
        if (triangle[i] < 2) {
            off_surface += fabsf(position[3 * i + 2]) > 1e-6f || normal[3 * i + 2] != 1.0f;
            floor_sum += direct[3 * i];
            floor_count += 1.0;
        }
    }
    for (i = 0; i < PAGE; i++) {
        for (c = PAGE * 8; c < HALF_STRIDE; c++) padding_touched += half[(size_t)i * HALF_STRIDE + (size_t)c] != 0xab;
    }
    CHECK(covered == texels);
    CHECK(wrong_sum == 0);
    CHECK(wrong_half == 0);
    CHECK(dark == 0);
    CHECK(off_surface == 0);
    CHECK(padding_touched == 0);
    /* The mean of L cos^2 / r^2 over light and floor, integrated numerically: 0.5014 W/m2. */
    CHECK(floor_count > 0.0 && fabs(floor_sum / floor_count - 0.5014) < 0.01);

    free(combined), free(direct), free(indirect), free(normal), free(position), free(radiance);
    free(validity), free(triangle), free(half);
}

static void uvs(const bk_lightmap *lightmap) {
    float corner_uvs[10 * 3 * 2];
    uint32_t pages[10];
    int i, outside = 0;

    CHECK_OK(bk_lightmap_mesh_uvs(lightmap, 0, corner_uvs, pages));
    for (i = 0; i < 60; i++) outside += !(corner_uvs[i] >= 0.0f && corner_uvs[i] <= 1.0f);
    for (i = 0; i < 10; i++) outside += pages[i] != 0;
    CHECK(outside == 0);
    CHECK_OK(bk_lightmap_mesh_uvs(lightmap, 0, NULL, pages));
    CHECK_OK(bk_lightmap_mesh_uvs(lightmap, 0, corner_uvs, NULL));
}

static void plan(const bk_lightmap *lightmap) {
    char text[4096], cut[8];
    size_t length = bk_plan_describe(lightmap, NULL, 0);
    CHECK(length > 0 && length < sizeof text);
    CHECK(bk_plan_describe(lightmap, text, sizeof text) == length && strlen(text) == length);
    CHECK(bk_plan_describe(lightmap, cut, sizeof cut) == length && strlen(cut) == sizeof cut - 1);
    CHECK(strncmp(text, cut, sizeof cut - 1) == 0);
}

static int file_exists(const char *prefix, const char *name) {
    char path[1024];
    FILE *file;
    snprintf(path, sizeof path, "%s%s", prefix, name);
    file = fopen(path, "rb");
    if (file) fclose(file);
    return file != NULL;
}

static void bake(const bk_scene *scene, const char *prefix) {
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;
    bk_lightmap_info info;
    bk_bake_params params, several;
    bk_bake_stats stats;
    struct progress p = progress_until(-1.0f);
    float *first, *second;
    double sum, error;
    size_t i;

    bk_lightmap_desc_init(&desc);
    desc.page_size = PAGE;
    desc.texels_per_unit = 8.0f;
    desc.gather_divisor = 2;
    desc.radiance_divisor = 2;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, on_progress, &p, &lightmap), BK_ERROR_CANCELLED, "cancelled");
    CHECK(lightmap == NULL);
    p = progress_until(2.0f);
    CHECK_OK(bk_lightmap_create(scene, &desc, on_progress, &p, &lightmap));
    CHECK(p.calls > 0 && p.fell == 0);
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(lightmap, &info));
    CHECK(info.page_count == 1 && info.width == PAGE && info.height == PAGE);
    CHECK(info.charts > 0 && info.unwrapped_charts == info.charts && info.texels > 0);

    bk_bake_params_init(&params);
    params.photon_count = 50000;
    params.gather_rays = 32;
    params.seed = 3;
    p = progress_until(0.5f);
    CHECK_ERROR(bk_bake(lightmap, &params, on_progress, &p, NULL), BK_ERROR_CANCELLED, "cancelled");
    CHECK(p.fraction >= 0.5f && p.fraction < 1.0f);
    first = (float *)malloc(sizeof(float) * 3 * PAGE * PAGE);
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, first, 0), BK_ERROR_INVALID_STATE,
                "baked");
    free(first);

    p = progress_until(2.0f);
    bk_bake_stats_init(&stats);
    CHECK_OK(bk_bake(lightmap, &params, on_progress, &p, &stats));
    CHECK(p.calls > 0 && p.fell == 0 && p.stages >= 3 && p.fraction == 1.0f);
    CHECK(stats.photons_emitted == 50000 && stats.photons_stored > 0 && stats.gather.rays > 0);
    CHECK(stats.seconds > 0.0 && stats.peak_bytes > 0);
    read_layers(lightmap, info.texels);
    uvs(lightmap);
    plan(lightmap);

    /* The same seed gives the same bits. */
    first = read_rgb(lightmap, BK_LAYER_COMBINED);
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    second = read_rgb(lightmap, BK_LAYER_COMBINED);
    CHECK(memcmp(first, second, sizeof(float) * 3 * PAGE * PAGE) == 0);
    CHECK(stats.passes == 1 && stats.error == 0.0);
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_ERROR, BK_FORMAT_RGB32F, second, 0), BK_ERROR_INVALID_STATE,
                "one pass");
    free(first);
    free(second);

    /* Of several passes the error is known, and a quality leaves the seed as it is. */
    several = params;
    several.seed = 9;
    CHECK_OK(bk_quality_set(BK_QUALITY_PREVIEW, NULL, &several));
    CHECK(several.seed == 9 && several.direct_samples < params.direct_samples && several.passes == 1);
    several.photon_count = 20000;
    several.passes = 3;
    CHECK_OK(bk_bake(lightmap, &several, NULL, NULL, &stats));
    CHECK(stats.passes == 3 && stats.error > 0.0 && stats.error < 1.0 && stats.photons_emitted == 60000);
    first = read_rgb(lightmap, BK_LAYER_COMBINED);
    second = read_rgb(lightmap, BK_LAYER_ERROR);
    for (i = 0, sum = 0.0, error = 0.0; i < 3 * PAGE * PAGE; ++i) {
        CHECK(second[i] >= 0.0f);
        sum += first[i];
        error += second[i];
    }
    CHECK(error > 0.0 && error < 0.2 * sum);
    free(first);
    free(second);
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, &stats));

    CHECK_OK(bk_lightmap_save(lightmap, prefix, BK_FILE_EXR, NULL, NULL));
    CHECK(file_exists(prefix, "page0-combined.exr") && file_exists(prefix, "page0-radiance.exr"));
    CHECK_OK(bk_lightmap_save(lightmap, prefix, BK_FILE_PNG, NULL, NULL));
    CHECK(file_exists(prefix, "page0-direct.png") && file_exists(prefix, "page0-indirect.png"));
    CHECK_OK(bk_lightmap_save(lightmap, prefix, BK_FILE_GLB, NULL, NULL));
    CHECK(file_exists(prefix, "scene.glb"));

    bk_lightmap_release(lightmap);
}

/* ---- Both sides of a two-sided shelf in the box, across it at half its height ---- */

static const float SHELF[4][3] = {{-0.8f, -0.8f, 1}, {0.8f, -0.8f, 1}, {0.8f, 0.8f, 1}, {-0.8f, 0.8f, 1}};
static const uint32_t SHELF_TRIANGLES[2][3] = {{0, 1, 2}, {0, 2, 3}};

static bk_lightmap *both_sides_of(const bk_scene *scene, uint32_t both, bk_lightmap_info *info) {
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;
    bk_lightmap_desc_init(&desc);
    CHECK(desc.both_sides == 1);
    desc.page_size = PAGE;
    desc.texels_per_unit = 8.0f;
    desc.gather_divisor = desc.radiance_divisor = 2;
    desc.both_sides = both;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    bk_lightmap_info_init(info);
    CHECK_OK(bk_lightmap_get_info(lightmap, info));
    return lightmap;
}

/* The texel in the middle of a triangle. */
static const float *middle(const float *pixels, const float corner_uvs[6]) {
    int x = (int)((corner_uvs[0] + corner_uvs[2] + corner_uvs[4]) / 3.0f * PAGE);
    int y = (int)((corner_uvs[1] + corner_uvs[3] + corner_uvs[5]) / 3.0f * PAGE);
    return pixels + 3 * (y * PAGE + x);
}

static void both_sides(bk_device *device) {
    bk_scene *scene = make_scene(device);
    bk_material_desc material;
    bk_mesh_desc mesh;
    bk_lightmap *lightmap;
    bk_lightmap_info info;
    bk_bake_params params;
    uint32_t two_sided, id, pages[10], back_pages[10];
    uint8_t own[10];
    float front[60], back[60], *normal, *combined;

    bk_material_desc_init(&material);
    material.flags = BK_MATERIAL_TWO_SIDED;
    CHECK_OK(bk_scene_add_material(scene, &material, &two_sided));
    bk_mesh_desc_init(&mesh);
    mesh.positions = SHELF[0];
    mesh.vertex_count = 4;
    mesh.indices = SHELF_TRIANGLES[0];
    mesh.triangle_count = 2;
    mesh.material = two_sided;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, &id));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));

    lightmap = both_sides_of(scene, 0, &info);
    CHECK(info.both_sided_charts == 0 && info.back_texels == 0);
    CHECK_OK(bk_lightmap_mesh_uvs(lightmap, id, front, pages));
    CHECK_OK(bk_lightmap_mesh_back_uvs(lightmap, id, back, back_pages, own));
    CHECK(memcmp(front, back, 12 * sizeof(float)) == 0 && pages[1] == back_pages[1] && own[0] == 0 && own[1] == 0);
    bk_lightmap_release(lightmap);

    lightmap = both_sides_of(scene, 1, &info);
    CHECK(info.both_sided_charts == 1 && info.back_texels >= 12 * 12 && info.page_count == 1);

    CHECK_OK(bk_lightmap_mesh_uvs(lightmap, id, front, pages));
    CHECK_OK(bk_lightmap_mesh_back_uvs(lightmap, id, back, back_pages, own));
    CHECK(own[0] == 1 && own[1] == 1 && memcmp(front, back, 12 * sizeof(float)) != 0 && back_pages[0] == 0);
    bk_bake_params_init(&params);
    params.photon_count = 50000;
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    normal = read_rgb(lightmap, BK_LAYER_NORMAL);
    combined = read_rgb(lightmap, BK_LAYER_COMBINED);
    CHECK(middle(normal, front)[2] == 1.0f && middle(normal, back)[2] == -1.0f);
    /* The lamp hangs above. */
    CHECK(middle(combined, front)[0] > 3.0f * middle(combined, back)[0] && middle(combined, back)[0] > 0.0f);
    free(normal);
    free(combined);

    /* The walls of the box are one-sided. */
    CHECK_OK(bk_lightmap_mesh_uvs(lightmap, 0, front, pages));
    CHECK_OK(bk_lightmap_mesh_back_uvs(lightmap, 0, back, back_pages, own));
    CHECK(memcmp(front, back, sizeof back) == 0 && memcmp(pages, back_pages, sizeof pages) == 0 && own[9] == 0);
    CHECK_OK(bk_lightmap_mesh_back_uvs(lightmap, 0, NULL, NULL, NULL));
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
}

int main(int argc, char **argv) {
    const char *prefix = argc > 1 ? argv[1] : "";
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_scene *scene;
    int64_t balance = 0;

    CHECK(bk_version() == BK_VERSION);
    bk_device_desc_init(&desc);
    desc.num_threads = 2;
    desc.memory = on_memory;
    desc.user = &balance;
    CHECK_OK(bk_device_create(&desc, &device));
    CHECK(bk_device_isa(device) != BK_ISA_AUTO && bk_device_num_threads(device) == 2);

    both_sides(device);
    scene = make_scene(device);
    bk_device_release(device); /* the scene keeps it alive */
    commit(scene);
    trace(scene);
    photons(scene);
    bake(scene, prefix);
    CHECK(balance > 0);
    bk_scene_release(scene);
    CHECK(balance == 0);
    return check_report("bake_c");
}
