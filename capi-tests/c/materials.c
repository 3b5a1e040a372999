/*
 * Textures, grates and stained glass in C99: a floor below a sheet below a lamp, whatever the sheet is of.
 */
#include "check.h"

#include <math.h>
#include <stdlib.h>

enum { PAGE = 32 };

static const float CORNERS[4][2] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
static const float LIGHTMAP_UVS[4][2] = {{0.1f, 0.1f}, {0.9f, 0.1f}, {0.9f, 0.9f}, {0.1f, 0.9f}};
static const uint32_t INDICES[2][3] = {{0, 1, 2}, {0, 2, 3}};

/* A unit square at height z that looks up; texture coordinates are x and y. */
static void add_square(bk_scene *scene, float z, uint32_t material, uint32_t page) {
    float positions[4][3];
    const uint32_t pages[2] = {page, page};
    bk_mesh_desc mesh;
    int i;
    for (i = 0; i < 4; i++) {
        positions[i][0] = CORNERS[i][0];
        positions[i][1] = CORNERS[i][1];
        positions[i][2] = z;
    }
    bk_mesh_desc_init(&mesh);
    mesh.positions = positions[0];
    mesh.vertex_count = 4;
    mesh.uvs = CORNERS[0];
    mesh.lightmap_uvs = LIGHTMAP_UVS[0];
    mesh.lightmap_page = pages;
    mesh.indices = INDICES[0];
    mesh.triangle_count = 2;
    mesh.material = material;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
}

/* Left half green and opaque, right half red and clear: 2 x 1 texels in rows of 12 bytes. */
static uint32_t add_texture(bk_scene *scene, uint32_t height) {
    static const uint8_t texels[2][12] = {
        {0, 255, 0, 255, 255, 0, 0, 0, 9, 9, 9, 9},
        {0, 255, 0, 255, 255, 0, 0, 0, 9, 9, 9, 9},
    };
    uint32_t id = BK_NONE;
    bk_texture_desc texture;
    bk_texture_desc_init(&texture);
    CHECK(texture.struct_size == sizeof texture && texture.format == BK_TEXTURE_RGBA8_SRGB);
    texture.width = 2;
    texture.height = height;
    texture.data = texels;
    texture.row_stride = 12;
    CHECK_OK(bk_scene_add_texture(scene, &texture, &id));
    return id;
}

/* The floor, the sheet above it if `sheet` says so, and the lamp. */
static bk_scene *make_scene(bk_device *device, const bk_material_desc *floor, const bk_material_desc *sheet) {
    bk_scene *scene = NULL;
    bk_light_desc light;
    uint32_t id = BK_NONE;
    CHECK_OK(bk_scene_create(device, &scene));
    CHECK(add_texture(scene, 1) == 0 && add_texture(scene, 2) == 1);
    CHECK_OK(bk_scene_add_material(scene, floor, &id));
    add_square(scene, 0.0f, id, 0);
    CHECK_OK(bk_scene_add_material(scene, sheet ? sheet : floor, &id));
    /* Elsewhere if there is none, so that scenes are of one size. */
    add_square(scene, sheet ? 0.5f : -0.5f, id, 1);
    bk_light_desc_init(&light);
    light.position[0] = light.position[1] = 0.5f;
    light.position[2] = 1.0f;
    CHECK_OK(bk_scene_add_light(scene, &light, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

/* Page 0 of a layer after a bake; `bits` receives what was left out. */
static float *baked(const bk_scene *scene, uint32_t layer, uint32_t *bits) {
    float *pixels = (float *)calloc((size_t)PAGE * PAGE * 3, sizeof(float));
    bk_lightmap *lightmap = small_lightmap(scene, PAGE);
    bk_bake_params params;
    bk_bake_stats stats;
    bk_bake_params_init(&params);
    bk_bake_stats_init(&stats);
    params.photon_count = 5000;
    params.gather_rays = 16;
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, &stats));
    CHECK_OK(bk_lightmap_read(lightmap, 0, layer, BK_FORMAT_RGB32F, pixels, 0));
    *bits = stats.left_out;
    bk_lightmap_release(lightmap);
    return pixels;
}

static void textured_floor(bk_device *device) {
    bk_material_desc material;
    bk_scene *scene;
    float *radiance;
    uint32_t bits;
    size_t left = ((size_t)PAGE / 2 * PAGE + PAGE * 3 / 10) * 3, right = ((size_t)PAGE / 2 * PAGE + PAGE * 7 / 10) * 3;

    bk_material_desc_init(&material);
    CHECK(material.albedo_texture == BK_NONE && material.alpha_cutoff == 0.0f && material.transmission[1] == 0.0f);
    material.albedo_texture = 0;
    material.albedo[0] = material.albedo[1] = material.albedo[2] = 1.0f;
    scene = make_scene(device, &material, NULL);
    radiance = baked(scene, BK_LAYER_RADIANCE, &bits);
    CHECK(!(bits & BK_LEFT_OUT_TEXTURES) && (bits & BK_LEFT_OUT_CUTOUTS) && (bits & BK_LEFT_OUT_TRANSMISSION));
    CHECK(radiance[left + 1] > 0.0f && radiance[left] < 0.2f * radiance[left + 1] && radiance[left + 2] == 0.0f);
    CHECK(radiance[right] > 0.0f && radiance[right + 1] < 0.2f * radiance[right] && radiance[right + 2] == 0.0f);
    free(radiance);
    bk_scene_release(scene);
}

static void grate(bk_device *device) {
    /* Down on the opaque half, and on the clear one. */
    const bk_ray rays[2] = {{{0.25f, 0.3f, 2.0f}, 0, {0, 0, -1}, INFINITY}, {{0.75f, 0.3f, 2.0f}, 0, {0, 0, -1}, INFINITY}};
    const bk_ray above[2] = {{{0.25f, 0.3f, 2.0f}, 0, {0, 0, -1}, 1.75f}, {{0.75f, 0.3f, 2.0f}, 0, {0, 0, -1}, 1.75f}};
    const float origin[3] = {0.75f, 0.3f, 2.0f}, down[3] = {0, 0, -1};
    bk_material_desc floor, sheet;
    bk_hit hits[2];
    uint8_t occluded[2];
    bk_scene *scene;
    float *direct;
    uint32_t bits;
    int x, lit = 0, dark = 0;

    bk_material_desc_init(&floor);
    bk_material_desc_init(&sheet);
    sheet.albedo_texture = 1;
    sheet.alpha_cutoff = 0.5f;
    scene = make_scene(device, &floor, &sheet);
    CHECK_OK(bk_intersect_many(scene, rays, 2, 0, hits));
    CHECK(hits[0].mesh == 1 && hits[0].t == 1.5f && hits[1].mesh == 0 && hits[1].t == 2.0f);
    bk_intersect(scene, &rays[1], &hits[0]);
    CHECK(memcmp(&hits[0], &hits[1], sizeof hits[0]) == 0);
    CHECK_OK(bk_gather(scene, origin, down, 1, INFINITY, 0, &hits[0]));
    CHECK(memcmp(&hits[0], &hits[1], sizeof hits[0]) == 0);
    CHECK_OK(bk_occluded_many(scene, above, 2, 0, occluded));
    CHECK(occluded[0] == 1 && occluded[1] == 0 && bk_occluded(scene, &above[0]) && !bk_occluded(scene, &above[1]));

    /* The lamp is half-way along x: the shadow is twice as large as its grate, and ends below the lamp. */
    direct = baked(scene, BK_LAYER_DIRECT, &bits);
    CHECK((bits & BK_LEFT_OUT_TRANSMISSION) && !(bits & BK_LEFT_OUT_CUTOUTS));
    for (x = 4; x < PAGE - 4; x++) {
        float e = direct[((size_t)PAGE / 2 * PAGE + x) * 3];
        if (x < PAGE / 2 - 1) dark += e == 0.0f;
        if (x > PAGE / 2) lit += e > 0.0f;
    }
    CHECK(dark == PAGE / 2 - 5 && lit == PAGE / 2 - 5);
    free(direct);
    bk_scene_release(scene);
}

static void glass(bk_device *device) {
    const float color[3] = {0.8f, 0.1f, 0.0f};
    bk_material_desc floor, pane;
    bk_scene *with, *without;
    float *colored, *full;
    uint32_t bits;
    int i, c, lit = 0;

    bk_material_desc_init(&floor);
    bk_material_desc_init(&pane);
    for (c = 0; c < 3; c++) {
        pane.albedo[c] = 0.2f;
        pane.transmission[c] = color[c];
    }
    without = make_scene(device, &floor, NULL);
    full = baked(without, BK_LAYER_DIRECT, &bits);
    CHECK((bits & BK_LEFT_OUT_TEXTURES) && (bits & BK_LEFT_OUT_CUTOUTS) && (bits & BK_LEFT_OUT_TRANSMISSION));
    with = make_scene(device, &floor, &pane);
    colored = baked(with, BK_LAYER_DIRECT, &bits);
    CHECK((bits & BK_LEFT_OUT_TEXTURES) && (bits & BK_LEFT_OUT_CUTOUTS) && !(bits & BK_LEFT_OUT_TRANSMISSION));
    for (i = 0; i < PAGE * PAGE; i++) {
        int same = 1;
        for (c = 0; c < 3; c++) {
            same &= fabsf(colored[3 * i + c] - color[c] * full[3 * i + c]) <= 1e-6f * full[3 * i + c];
        }
        if (!same) CHECK(!"direct light is multiplied with what the pane transmits");
        lit += full[3 * i] > 0.0f;
    }
    CHECK(lit > PAGE * PAGE / 2);
    free(colored);
    free(full);
    bk_scene_release(with);
    bk_scene_release(without);
}

int main(void) {
    bk_device *device = NULL;
    CHECK_OK(bk_device_create(NULL, &device));
    textured_floor(device);
    grate(device);
    glass(device);
    bk_device_release(device);
    return check_report("materials");
}
