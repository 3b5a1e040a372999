/*
 * Bad input: every mistake gets its code and a sentence that names the culprit, nothing crashes, and
 * the object that was asked goes on working.
 *
 *     bad_input OUT_PREFIX
 */
#include "check.h"

#include <math.h>
#include <stdlib.h>

#define ARGUMENT BK_ERROR_INVALID_ARGUMENT
#define STATE BK_ERROR_INVALID_STATE

static const char *prefix = "";

/* ---- A scene that is fine: a floor of two triangles under a point light ---- */

static const float FLOOR[4][3] = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};
static const float FLOOR_UVS[4][2] = {{0.1f, 0.1f}, {0.9f, 0.1f}, {0.9f, 0.9f}, {0.1f, 0.9f}};
static const uint32_t FLOOR_INDICES[2][3] = {{0, 1, 2}, {0, 2, 3}};

static bk_mesh_desc floor_desc(void) {
    bk_mesh_desc mesh;
    bk_mesh_desc_init(&mesh);
    mesh.positions = FLOOR[0];
    mesh.vertex_count = 4;
    mesh.indices = FLOOR_INDICES[0];
    mesh.triangle_count = 2;
    return mesh;
}

static bk_light_desc lamp_desc(void) {
    bk_light_desc light;
    bk_light_desc_init(&light);
    light.position[0] = light.position[1] = 0.5f;
    light.position[2] = 1.0f;
    return light;
}

static bk_scene *empty_scene(bk_device *device) {
    bk_scene *scene = NULL;
    CHECK_OK(bk_scene_create(device, &scene));
    return scene;
}

static void add_floor(bk_scene *scene) {
    bk_material_desc material;
    bk_mesh_desc mesh = floor_desc();
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
}

static bk_scene *committed_scene(bk_device *device) {
    bk_scene *scene = empty_scene(device);
    bk_light_desc lamp = lamp_desc();
    add_floor(scene);
    CHECK_OK(bk_scene_add_light(scene, &lamp, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

static bk_bake_params quick_bake(void) {
    bk_bake_params params;
    bk_bake_params_init(&params);
    params.photon_count = 2000;
    params.gather_rays = 16;
    return params;
}

/* The scene is fine: it can be queried and baked. */
static void check_works(const bk_scene *scene) {
    const bk_ray down = {{0.5f, 0.25f, 0.5f}, 0.0f, {0, 0, -1}, INFINITY};
    bk_hit hit;
    bk_lightmap *lightmap = small_lightmap(scene, 32);
    bk_bake_params params = quick_bake();
    bk_intersect(scene, &down, &hit);
    CHECK(hit.t == 0.5f);
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    bk_lightmap_release(lightmap);
}

/* ---- Devices ---- */

static void devices(void) {
    bk_device *device = (bk_device *)&device;
    bk_device_desc desc;

    CHECK_ERROR(bk_device_create(NULL, NULL), ARGUMENT, "out is NULL");
    bk_device_desc_init(&desc);
    desc.struct_size = 0;
    CHECK_ERROR(bk_device_create(&desc, &device), ARGUMENT, "bk_device_desc.struct_size is 0");
    CHECK(device == NULL);
    desc.struct_size = sizeof desc + 4;
    CHECK_ERROR(bk_device_create(&desc, &device), ARGUMENT, "bk_device_desc.struct_size");
    bk_device_desc_init(&desc);
    desc.num_threads = 1000000;
    CHECK_ERROR(bk_device_create(&desc, &device), ARGUMENT, "num_threads is 1000000");
    bk_device_desc_init(&desc);
    desc.isa = 99;
    CHECK_ERROR(bk_device_create(&desc, &device), ARGUMENT, "isa is 99");
    CHECK(bk_device_isa(NULL) == BK_ISA_AUTO && strstr(bk_last_error(), "device is NULL"));
    CHECK(bk_device_num_threads(NULL) == 0);
    bk_device_desc_init(NULL);
    bk_device_retain(NULL);
    bk_device_release(NULL);
}

/* ---- NULL in every place ---- */

static void nulls(bk_device *device) {
    bk_scene *scene = committed_scene(device), *none = NULL;
    bk_lightmap *lightmap = small_lightmap(scene, 32), *no_lightmap = NULL;
    bk_photon_map *map = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh = floor_desc();
    bk_light_desc light = lamp_desc();
    bk_build_params build;
    bk_mesh_view view;
    bk_photon_view photon_view;
    bk_scene_stats stats;
    bk_lightmap_info info;
    bk_ray ray = {{0, 0, 0}, 0, {0, 0, 1}, 1};
    bk_hit hit;
    float vector[3] = {0, 0, 1};
    uint8_t occluded;

    bk_material_desc_init(&material);
    bk_build_params_init(&build);
    bk_mesh_view_init(&view);
    bk_photon_view_init(&photon_view);
    bk_scene_stats_init(&stats);
    bk_lightmap_info_init(&info);

    CHECK_ERROR(bk_scene_create(NULL, &none), ARGUMENT, "device is NULL");
    CHECK_ERROR(bk_scene_create(device, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_scene_add_material(NULL, &material, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_add_material(scene, NULL, NULL), ARGUMENT, "desc is NULL");
    CHECK_ERROR(bk_scene_add_mesh(NULL, &mesh, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_add_mesh(scene, NULL, NULL), ARGUMENT, "desc is NULL");
    CHECK_ERROR(bk_scene_add_light(NULL, &light, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_add_light(scene, NULL, NULL), ARGUMENT, "desc is NULL");
    CHECK_ERROR(bk_scene_set_light(NULL, 0, &light), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_set_light(scene, 0, NULL), ARGUMENT, "desc is NULL");
    CHECK_ERROR(bk_scene_load_file(NULL, "a.obj", NULL, NULL, NULL, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_load_file(scene, NULL, NULL, NULL, NULL, NULL), ARGUMENT, "path is NULL");
    CHECK_ERROR(bk_scene_load_builtin(NULL, "cornell"), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_load_builtin(scene, NULL), ARGUMENT, "name is NULL");
    CHECK_ERROR(bk_scene_set_build(NULL, &build), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_set_build(scene, NULL), ARGUMENT, "params is NULL");
    CHECK_ERROR(bk_scene_commit(NULL, NULL, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_get_stats(NULL, &stats), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_get_stats(scene, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_scene_bounds(NULL, vector, vector), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_bounds(scene, NULL, vector), ARGUMENT, "lower is NULL");
    CHECK_ERROR(bk_scene_bounds(scene, vector, NULL), ARGUMENT, "upper is NULL");
    CHECK_ERROR(bk_scene_get_mesh(NULL, 0, &view), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_get_mesh(scene, 0, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_scene_get_mesh(scene, 5, &view), ARGUMENT, "mesh 5");
    CHECK(bk_scene_mesh_count(NULL) == 0 && strstr(bk_last_error(), "scene is NULL"));
    CHECK(bk_scene_light_count(NULL) == 0);

    bk_intersect(NULL, &ray, &hit);
    CHECK(hit.triangle == BK_NONE && strstr(bk_last_error(), "scene is NULL"));
    bk_intersect(scene, NULL, &hit);
    CHECK(hit.triangle == BK_NONE && strstr(bk_last_error(), "ray is NULL"));
    bk_intersect(scene, &ray, NULL);
    CHECK(strstr(bk_last_error(), "out is NULL"));
    CHECK(bk_occluded(NULL, &ray) == 0 && bk_occluded(scene, NULL) == 0);
    CHECK_ERROR(bk_intersect_many(NULL, &ray, 1, 0, &hit), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_intersect_many(scene, NULL, 1, 0, &hit), ARGUMENT, "rays is NULL");
    CHECK_ERROR(bk_intersect_many(scene, &ray, 1, 0, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_intersect_many(scene, &ray, 1, 8, &hit), ARGUMENT, "flags is 0x8");
    CHECK_ERROR(bk_intersect_many(scene, &ray, 1, 0, (bk_hit *)(void *)&ray), ARGUMENT, "out overlaps rays");
    CHECK_ERROR(bk_intersect_many(scene, &ray, SIZE_MAX / 2, 0, &hit), ARGUMENT, "rays");
    CHECK_OK(bk_intersect_many(scene, NULL, 0, 0, NULL));
    CHECK_ERROR(bk_occluded_many(NULL, &ray, 1, 0, &occluded), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_occluded_many(scene, NULL, 1, 0, &occluded), ARGUMENT, "rays is NULL");
    CHECK_ERROR(bk_occluded_many(scene, &ray, 1, 0, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_occluded_many(scene, &ray, 1, 2, &occluded), ARGUMENT, "flags");
    CHECK_ERROR(bk_gather(NULL, vector, vector, 1, 1, 0, &hit), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_gather(scene, NULL, vector, 1, 1, 0, &hit), ARGUMENT, "origin is NULL");
    CHECK_ERROR(bk_gather(scene, vector, NULL, 1, 1, 0, &hit), ARGUMENT, "directions is NULL");
    CHECK_ERROR(bk_gather(scene, vector, vector, 1, 1, 0, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_gather(scene, vector, vector, 1, 1, 2, &hit), ARGUMENT, "flags");

    CHECK_ERROR(bk_photon_map_create(NULL, NULL, NULL, NULL, &map), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_photon_map_create(scene, NULL, NULL, NULL, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_photon_map_get_photons(NULL, &photon_view), ARGUMENT, "map is NULL");
    CHECK_ERROR(bk_photon_map_estimate(NULL, vector, vector, 1, vector), ARGUMENT, "map is NULL");

    CHECK_ERROR(bk_lightmap_create(NULL, NULL, NULL, NULL, &no_lightmap), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_lightmap_create(scene, NULL, NULL, NULL, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_lightmap_get_info(NULL, &info), ARGUMENT, "lightmap is NULL");
    CHECK_ERROR(bk_lightmap_get_info(lightmap, NULL), ARGUMENT, "out is NULL");
    CHECK_ERROR(bk_lightmap_mesh_uvs(NULL, 0, vector, NULL), ARGUMENT, "lightmap is NULL");
    CHECK_ERROR(bk_lightmap_mesh_uvs(lightmap, 3, NULL, NULL), ARGUMENT, "mesh 3");
    CHECK_ERROR(bk_lightmap_mesh_back_uvs(NULL, 0, vector, NULL, NULL), ARGUMENT, "lightmap is NULL");
    CHECK_ERROR(bk_lightmap_mesh_back_uvs(lightmap, 3, NULL, NULL, NULL), ARGUMENT, "mesh 3");
    CHECK_ERROR(bk_bake(NULL, NULL, NULL, NULL, NULL), ARGUMENT, "lightmap is NULL");
    CHECK_ERROR(bk_lightmap_read(NULL, 0, 0, BK_FORMAT_RGB32F, vector, 0), ARGUMENT, "lightmap is NULL");
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_NORMAL, BK_FORMAT_RGB32F, NULL, 0), ARGUMENT, "dst is NULL");
    CHECK_ERROR(bk_lightmap_save(NULL, "a", BK_FILE_EXR, NULL, NULL), ARGUMENT, "lightmap is NULL");
    CHECK_ERROR(bk_lightmap_save(lightmap, NULL, BK_FILE_EXR, NULL, NULL), ARGUMENT, "path_prefix is NULL");
    CHECK(bk_plan_describe(NULL, NULL, 0) == 0 && strstr(bk_last_error(), "lightmap is NULL"));
    CHECK(bk_plan_describe(lightmap, NULL, 5) == 0 && strstr(bk_last_error(), "dst is NULL"));

    bk_scene_release(NULL);
    bk_scene_retain(NULL);
    bk_photon_map_release(NULL);
    bk_photon_map_retain(NULL);
    bk_lightmap_release(NULL);
    bk_lightmap_retain(NULL);
    bk_mesh_desc_init(NULL);
    CHECK(strcmp(bk_result_string(12345), "unknown bk_result") == 0);

    check_works(scene);
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
}

/* ---- Structures of a size that never was ---- */

static void struct_sizes(bk_device *device) {
    bk_scene *scene = empty_scene(device);
    bk_lightmap *lightmap = NULL;
    bk_photon_map *map = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh = floor_desc();
    bk_light_desc light = lamp_desc();
    bk_build_params build;
    bk_photon_params photons;
    bk_photon_view photon_view;
    bk_mesh_view view;
    bk_lightmap_desc lightmap_desc;
    bk_bake_params bake = quick_bake();
    bk_bake_stats bake_stats;
    bk_load_info load;
    bk_scene_stats stats;
    bk_lightmap_info info;

    bk_material_desc_init(&material);
    bk_build_params_init(&build);
    material.struct_size = 0;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "bk_material_desc.struct_size is 0");
    mesh.struct_size += 1;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "bk_mesh_desc.struct_size");
    light.struct_size = 4;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "bk_light_desc.struct_size is 4");
    build.struct_size = 0;
    CHECK_ERROR(bk_scene_set_build(scene, &build), ARGUMENT, "bk_build_params.struct_size is 0");
    bk_build_params_init(&build);
    build.compact = 2;
    CHECK_ERROR(bk_scene_set_build(scene, &build), ARGUMENT, "compact is 2, not 0 or 1");
    bk_load_info_init(&load);
    load.struct_size = 1;
    CHECK_ERROR(bk_scene_load_file(scene, "a.obj", NULL, NULL, NULL, &load), ARGUMENT, "bk_load_info.struct_size is 1");

    add_floor(scene);
    light = lamp_desc();
    CHECK_OK(bk_scene_add_light(scene, &light, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    bk_scene_stats_init(&stats);
    stats.struct_size = 0;
    CHECK_ERROR(bk_scene_get_stats(scene, &stats), ARGUMENT, "bk_scene_stats.struct_size is 0");
    bk_mesh_view_init(&view);
    view.struct_size = 0;
    CHECK_ERROR(bk_scene_get_mesh(scene, 0, &view), ARGUMENT, "bk_mesh_view.struct_size is 0");
    bk_photon_params_init(&photons);
    photons.struct_size = 0;
    CHECK_ERROR(bk_photon_map_create(scene, &photons, NULL, NULL, &map), ARGUMENT, "bk_photon_params.struct_size is 0");
    bk_photon_params_init(&photons);
    photons.photon_count = 100;
    CHECK_OK(bk_photon_map_create(scene, &photons, NULL, NULL, &map));
    bk_photon_view_init(&photon_view);
    photon_view.struct_size = 0;
    CHECK_ERROR(bk_photon_map_get_photons(map, &photon_view), ARGUMENT, "bk_photon_view.struct_size is 0");
    bk_photon_map_release(map);
    bk_lightmap_desc_init(&lightmap_desc);
    lightmap_desc.struct_size = 0;
    CHECK_ERROR(bk_lightmap_create(scene, &lightmap_desc, NULL, NULL, &lightmap), ARGUMENT,
                "bk_lightmap_desc.struct_size is 0");
    bk_lightmap_desc_init(&lightmap_desc);
    lightmap_desc.both_sides = 2;
    CHECK_ERROR(bk_lightmap_create(scene, &lightmap_desc, NULL, NULL, &lightmap), ARGUMENT, "both_sides is 2, not 0 or 1");
    lightmap = small_lightmap(scene, 32);
    bk_lightmap_info_init(&info);
    info.struct_size = 0;
    CHECK_ERROR(bk_lightmap_get_info(lightmap, &info), ARGUMENT, "bk_lightmap_info.struct_size is 0");
    bake.struct_size = 0;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "bk_bake_params.struct_size is 0");
    bake = quick_bake();
    bake.stitch = 3;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "stitch is 3, not 0 or 1");
    bake.stitch = 1;
    bake.directional_indirect = 2;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "directional_indirect is 2, not 0 or 1");
    bake.directional_indirect = 0;
    bake.directional_direct = 5;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "directional_direct is 5, not 0 or 1");
    bake = quick_bake();
    CHECK_ERROR(bk_quality_set(4, NULL, &bake), ARGUMENT, "quality is 4, not one of the BK_QUALITY values");
    bake.struct_size = 3;
    CHECK_ERROR(bk_quality_set(0, NULL, &bake), ARGUMENT, "bk_bake_params.struct_size is 3");
    bake = quick_bake();
    bake.passes = 0;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "passes is 0, outside 1 to 4096");
    bake = quick_bake();
    bake.target_error = -0.1f;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "target_error is -0.1, not a finite number");
    bake.target_error = 0.1f;
    bake.texel_end = 1;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "target_error asks for all texels");
    bake = quick_bake();
    bk_bake_stats_init(&bake_stats);
    bake_stats.struct_size = 9999;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, &bake_stats), ARGUMENT, "bk_bake_stats.struct_size is 9999");
    bk_lightmap_release(lightmap);
    check_works(scene);
    bk_scene_release(scene);
}

/* ---- Materials, meshes, lights ---- */

static void materials(bk_scene *scene) {
    static const float bad[] = {1.0f, -0.1f, 2.0f};
    bk_material_desc material;
    size_t i;
    for (i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        bk_material_desc_init(&material);
        material.albedo[1] = bad[i];
        CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "albedo[1] is ");
    }
    bk_material_desc_init(&material);
    material.albedo[2] = NAN;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "albedo[2] is NaN");
    bk_material_desc_init(&material);
    material.emission[0] = -1.0f;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "emission contains -1");
    material.emission[0] = INFINITY;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "emission contains inf");
    bk_material_desc_init(&material);
    material.flags = 0x100;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "0x100");
    bk_material_desc_init(&material);
    material.transmission[2] = 0.75f;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "transmission[2] 0.75 are more than 1");
    material.transmission[2] = NAN;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "transmission[2] is NaN");
    bk_material_desc_init(&material);
    material.alpha_cutoff = 0.5f;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "there is no albedo_texture");
    material.albedo_texture = 0;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "albedo_texture 0 does not exist");
}

static void textures(bk_scene *scene) {
    static const uint8_t texels[4][4] = {{1, 2, 3, 4}, {5, 6, 7, 8}, {9, 10, 11, 12}, {13, 14, 15, 16}};
    bk_texture_desc texture;
    bk_material_desc material;
    uint32_t id = 77;
    bk_texture_desc_init(NULL);
    bk_texture_desc_init(&texture);
    CHECK_ERROR(bk_scene_add_texture(NULL, &texture, &id), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_add_texture(scene, NULL, &id), ARGUMENT, "desc is NULL");
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "width is 0");
    texture.width = 2;
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "height is 0");
    texture.height = 2;
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "data is NULL");
    texture.data = texels;
    texture.width = 0xffffffffu;
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "width is 4294967295");
    texture.width = 2;
    texture.height = 16385;
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "height is 16385");
    texture.height = 2;
    texture.row_stride = 7;
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "row_stride is 7");
    texture.row_stride = SIZE_MAX - 3;
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "row_stride is ");
    texture.row_stride = 0;
    texture.format = 99;
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "format is 99");
    texture.format = BK_TEXTURE_RGBA8_SRGB;
    texture.struct_size = 8;
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, &id), ARGUMENT, "bk_texture_desc.struct_size is 8");
    texture.struct_size = sizeof texture;
    CHECK(id == 77);
    CHECK_OK(bk_scene_add_texture(scene, &texture, &id));
    CHECK(id == 0);
    CHECK_OK(bk_scene_add_texture(scene, &texture, NULL));

    bk_material_desc_init(&material);
    material.albedo_texture = 2;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT,
                "albedo_texture 2 does not exist, the scene has 2 textures");
    material.albedo_texture = 1;
    material.albedo[0] = 1.01f;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "albedo[0] is 1.01");
    material.albedo[0] = 1.0f;
    material.alpha_cutoff = 1.5f;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "alpha_cutoff is 1.5");
    material.alpha_cutoff = 1.0f;
    material.emission[0] = 1.0f;
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), ARGUMENT, "cannot have cut-outs");
}

static void meshes(bk_scene *scene) {
    static const uint32_t out_of_range[2][3] = {{0, 1, 2}, {0, 2, 9}};
    static const uint32_t two_materials[2] = {0, 7};
    static const uint32_t pages[2] = {0, 0};
    float vertices[4][3];
    bk_mesh_desc mesh;

    mesh = floor_desc();
    mesh.indices = out_of_range[0];
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "triangle 1 names vertex 9");
    mesh = floor_desc();
    mesh.positions = NULL;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "positions is NULL");
    mesh = floor_desc();
    mesh.indices = NULL;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "indices is NULL");
    mesh = floor_desc();
    mesh.position_stride = 8;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "stride of positions is 8");
    mesh = floor_desc();
    mesh.vertex_count = SIZE_MAX / 4;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "positions");
    mesh = floor_desc();
    mesh.material = 3;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "material 3");
    mesh = floor_desc();
    mesh.triangle_materials = two_materials;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "triangle 1 names material 7");
    mesh = floor_desc();
    mesh.lightmap_page = pages;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "lightmap_page");
    mesh = floor_desc();
    mesh.flags = 2;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "flags");

    mesh = floor_desc();
    mesh.flags = BK_MESH_STRICT;
    mesh.positions = vertices[0];
    memcpy(vertices, FLOOR, sizeof vertices);
    vertices[3][1] = NAN;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "triangle 1 is degenerate or not finite");
    vertices[3][1] = INFINITY;
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "triangle 1 is degenerate or not finite");
    memcpy(vertices[3], vertices[2], sizeof vertices[3]);
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "triangle 1 is degenerate or not finite");
}

static void lights(bk_scene *scene) {
    bk_light_desc light;
    uint32_t lamp = BK_NONE;

    light = lamp_desc();
    light.type = 0;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "type is 0");
    light = lamp_desc();
    light.color[2] = -1.0f;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "color contains -1");
    light = lamp_desc();
    light.position[0] = NAN;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "position contains NaN");
    light = lamp_desc();
    light.type = BK_LIGHT_RECT;
    light.edge_u[0] = 1.0f;
    light.edge_v[0] = 2.0f;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "no area");
    light.edge_v[1] = INFINITY;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "edge_v contains inf");
    light = lamp_desc();
    light.type = BK_LIGHT_DIRECTIONAL;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "direction is zero");
    light.type = BK_LIGHT_SPOT;
    light.direction[2] = -1.0f;
    light.cone_inner = 1.0f;
    light.cone_outer = 0.5f;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "inner 1");
    light.cone_outer = 4.0f;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "outer 4");
    light.type = BK_LIGHT_DIRECTIONAL;
    light.angular_radius = 1.6f;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "angular radius is 1.6");
    light.angular_radius = NAN;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "angular radius is NaN");
    light.angular_radius = -0.1f;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "angular radius is -0.1");
    light = lamp_desc();
    light.type = BK_LIGHT_SKY;
    light.environment = 0;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "environment 0 does not exist");
    light.environment = BK_NONE;
    light.rotation = INFINITY;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "rotation contains inf");
    light.rotation = 0.0f;
    light.up[1] = 0.0f;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "up is zero");
    light.up[0] = NAN;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "up contains NaN");
    light.type = 6;
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), ARGUMENT, "type is 6");

    light = lamp_desc();
    CHECK_ERROR(bk_scene_set_light(scene, 0, &light), ARGUMENT, "light 0");
    CHECK_OK(bk_scene_add_light(scene, &light, &lamp));
    /* No release had a shorter structure. */
    light.struct_size = (uint32_t)offsetof(bk_light_desc, angular_radius);
    CHECK_ERROR(bk_scene_set_light(scene, lamp, &light), ARGUMENT, "bk_light_desc.struct_size");
    light = lamp_desc();
    CHECK_OK(bk_scene_set_light(scene, lamp, &light));
}

/* Images of skies. */
static void environments(bk_scene *scene) {
    float texels[2][8][3];
    bk_texture_desc image;
    bk_light_desc sky = lamp_desc();
    uint32_t id = BK_NONE;
    int i;

    for (i = 0; i < 2 * 8; i++) texels[i / 8][i % 8][0] = texels[i / 8][i % 8][1] = texels[i / 8][i % 8][2] = 1.0f;
    bk_texture_desc_init(&image);
    CHECK_ERROR(bk_scene_add_environment(NULL, &image, NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_add_environment(scene, NULL, NULL), ARGUMENT, "desc is NULL");
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "format is 0");
    image.format = 77;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "format is 77");
    image.format = BK_TEXTURE_RGB32F;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "width is 0");
    image.width = 4;
    image.height = 20000;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "height is 20000");
    image.height = 2;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "data is NULL");
    image.data = texels;
    image.row_stride = 47;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "row_stride is 47");
    image.row_stride = (size_t)-1;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "row_stride is");
    image.row_stride = sizeof texels[0];
    texels[1][2][1] = NAN;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "pixel (2, 1)");
    texels[1][2][1] = -1.0f;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "pixel (2, 1)");
    texels[1][2][1] = 1.0f;
    texels[1][4][0] = NAN; /* Beyond the row's four texels. */
    image.struct_size = 8;
    CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), ARGUMENT, "bk_texture_desc.struct_size is 8");
    image.struct_size = sizeof image;
    CHECK_OK(bk_scene_add_environment(scene, &image, &id));
    CHECK(id == 0);
    sky.type = BK_LIGHT_SKY;
    sky.environment = 1;
    CHECK_ERROR(bk_scene_add_light(scene, &sky, NULL), ARGUMENT, "environment 1 does not exist, the scene has 1");
    sky.environment = id;
    CHECK_OK(bk_scene_set_light(scene, 0, &sky));
    sky = lamp_desc();
    CHECK_OK(bk_scene_set_light(scene, 0, &sky));
}

/* An open floor under a sky gets pi times its radiance; the plan says what the scene needs. */
static void sky(bk_device *device) {
    const uint32_t distant = BK_LEFT_OUT_SKY | BK_LEFT_OUT_SUN_DISC | BK_LEFT_OUT_MANY_LIGHTS;
    float white[2][3] = {{0.5f, 0.5f, 0.5f}, {0.5f, 0.5f, 0.5f}};
    float pixels[32 * 32][3];
    int with_image, i;

    for (with_image = 0; with_image < 2; with_image++) {
        bk_scene *scene = empty_scene(device);
        bk_light_desc light = lamp_desc();
        bk_texture_desc image;
        bk_lightmap *lightmap;
        bk_bake_params params = quick_bake();
        bk_bake_stats stats;
        float brightest = 0.0f;

        bk_texture_desc_init(&image);
        image.format = BK_TEXTURE_RGB32F;
        image.width = 1;
        image.height = 2;
        image.data = white;
        add_floor(scene);
        light.type = BK_LIGHT_SKY;
        light.color[0] = light.color[1] = light.color[2] = with_image ? 2.0f : 1.0f;
        if (with_image) CHECK_OK(bk_scene_add_environment(scene, &image, &light.environment));
        CHECK_OK(bk_scene_add_light(scene, &light, NULL));
        light.type = BK_LIGHT_DIRECTIONAL;
        light.direction[2] = -1.0f;
        light.angular_radius = 0.01f;
        CHECK_OK(bk_scene_add_light(scene, &light, NULL));
        CHECK_OK(bk_scene_commit(scene, NULL, NULL));
        CHECK_ERROR(bk_scene_add_environment(scene, &image, NULL), STATE, "environments can be added");
        lightmap = small_lightmap(scene, 32);
        bk_bake_stats_init(&stats);
        CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, &stats));
        CHECK((stats.left_out & distant) == BK_LEFT_OUT_MANY_LIGHTS);
        CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_DIRECT, BK_FORMAT_RGB32F, pixels, 0));
        for (i = 0; i < 32 * 32; i++) brightest = pixels[i][0] > brightest ? pixels[i][0] : brightest;
        if (with_image) {
            CHECK(brightest > 4.5f && brightest < 6.5f);
        } else {
            CHECK(fabsf(brightest - 3.14159265f - 1.0f) < 1e-4f);
        }
        /* Away with both: the plan of the next bake leaves them out. */
        light.type = BK_LIGHT_POINT;
        light.position[2] = 1.0f;
        CHECK_OK(bk_scene_set_light(scene, 0, &light));
        CHECK_OK(bk_scene_set_light(scene, 1, &light));
        CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, &stats));
        CHECK((stats.left_out & distant) == distant);
        bk_lightmap_release(lightmap);
        bk_scene_release(scene);
    }
}

static void descriptions(bk_device *device) {
    bk_scene *scene = empty_scene(device);
    bk_build_params build;
    bk_light_desc light = lamp_desc();
    bk_material_desc material;
    bk_texture_desc texture;
    bk_mesh_desc mesh = floor_desc();
    const uint32_t texel = 0;

    bk_texture_desc_init(&texture);
    texture.width = texture.height = 1;
    texture.data = &texel;
    bk_material_desc_init(&material);
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), ARGUMENT, "material 0");
    CHECK_ERROR(bk_scene_commit(scene, NULL, NULL), STATE, "no triangles");
    add_floor(scene);
    materials(scene);
    textures(scene);
    meshes(scene);
    lights(scene);
    environments(scene);
    bk_build_params_init(&build);
    build.bins = 1;
    CHECK_ERROR(bk_scene_set_build(scene, &build), ARGUMENT, "bins is 1");
    build.bins = 16;
    build.max_leaf = 100;
    CHECK_ERROR(bk_scene_set_build(scene, &build), ARGUMENT, "max_leaf is 100");
    build.max_leaf = 4;
    build.quality = 2;
    CHECK_ERROR(bk_scene_set_build(scene, &build), ARGUMENT, "quality is 2");
    build.quality = BK_BUILD_QUALITY_HIGH;
    build.split_budget = 5;
    CHECK_ERROR(bk_scene_set_build(scene, &build), ARGUMENT, "split_budget is 5");
    build.split_budget = 1;
    CHECK_OK(bk_scene_set_build(scene, &build));
    CHECK_ERROR(bk_scene_load_builtin(scene, "teapot"), ARGUMENT, "teapot");
    CHECK(bk_scene_mesh_count(scene) == 1 && bk_scene_light_count(scene) == 1);
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));

    CHECK_ERROR(bk_scene_commit(scene, NULL, NULL), STATE, "committed already");
    CHECK_ERROR(bk_scene_add_material(scene, &material, NULL), STATE, "committed");
    CHECK_ERROR(bk_scene_add_texture(scene, &texture, NULL), STATE, "committed");
    CHECK_ERROR(bk_scene_add_mesh(scene, &mesh, NULL), STATE, "committed");
    CHECK_ERROR(bk_scene_add_light(scene, &light, NULL), STATE, "committed");
    CHECK_ERROR(bk_scene_load_builtin(scene, "cornell"), STATE, "committed");
    CHECK_ERROR(bk_scene_load_file(scene, "a.obj", NULL, NULL, NULL, NULL), STATE, "committed");
    CHECK_ERROR(bk_scene_set_build(scene, &build), STATE, "committed");
    CHECK_OK(bk_scene_set_light(scene, 0, &light));
    CHECK_ERROR(bk_scene_set_light(scene, 1, &light), ARGUMENT, "light 1");
    light.color[0] = NAN;
    CHECK_ERROR(bk_scene_set_light(scene, 0, &light), ARGUMENT, "color contains NaN");
    check_works(scene);
    bk_scene_release(scene);
}

/* ---- Queries and bakes before the commit ---- */

static void before_commit(bk_device *device) {
    bk_scene *scene = empty_scene(device);
    bk_lightmap *lightmap = NULL;
    bk_photon_map *map = NULL;
    bk_scene_stats stats;
    bk_mesh_view view;
    bk_ray ray = {{0, 0, 1}, 0, {0, 0, -1}, 10};
    bk_hit hit;
    uint8_t occluded;
    float vector[3] = {0, 0, 1};

    add_floor(scene);
    bk_intersect(scene, &ray, &hit);
    CHECK(hit.triangle == BK_NONE && strstr(bk_last_error(), "not committed"));
    CHECK(bk_occluded(scene, &ray) == 0);
    CHECK_ERROR(bk_intersect_many(scene, &ray, 1, 0, &hit), STATE, "not committed");
    CHECK_ERROR(bk_occluded_many(scene, &ray, 1, 0, &occluded), STATE, "not committed");
    CHECK_ERROR(bk_gather(scene, vector, vector, 1, 1.0f, 0, &hit), STATE, "not committed");
    bk_scene_stats_init(&stats);
    CHECK_ERROR(bk_scene_get_stats(scene, &stats), STATE, "not committed");
    CHECK_ERROR(bk_scene_bounds(scene, vector, vector), STATE, "not committed");
    bk_mesh_view_init(&view);
    CHECK_ERROR(bk_scene_get_mesh(scene, 0, &view), STATE, "not committed");
    CHECK_ERROR(bk_photon_map_create(scene, NULL, NULL, NULL, &map), STATE, "not committed");
    CHECK_ERROR(bk_lightmap_create(scene, NULL, NULL, NULL, &lightmap), STATE, "not committed");
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    check_works(scene);
    bk_scene_release(scene);
}

/* ---- Degenerate and non-finite triangles are skipped, counted and logged ---- */

static void on_log(void *user, uint32_t level, const char *message) {
    if (level == BK_LOG_WARNING && strstr(message, "3 of 5 triangles")) ++*(int *)user;
}

static void skipped_triangles(void) {
    static const float vertices[7][3] = {{0, 0, 0}, {1, 0, 0},     {1, 1, 0},         {0, 1, 0},
                                         {2, 0, 0}, {0, 0, NAN}, {0, -INFINITY, 0}};
    static const uint32_t indices[5][3] = {{0, 1, 2}, {0, 2, 3}, {0, 1, 4}, {0, 1, 5}, {0, 1, 6}};
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_scene *scene;
    bk_material_desc material;
    bk_mesh_desc mesh;
    bk_scene_stats stats;
    int warnings = 0;

    bk_device_desc_init(&desc);
    desc.log = on_log;
    desc.user = &warnings;
    CHECK_OK(bk_device_create(&desc, &device));
    scene = empty_scene(device);
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = vertices[0];
    mesh.vertex_count = 7;
    mesh.indices = indices[0];
    mesh.triangle_count = 5;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    bk_scene_stats_init(&stats);
    CHECK_OK(bk_scene_get_stats(scene, &stats));
    CHECK(stats.triangles == 5 && stats.skipped_degenerate == 3);
    CHECK(warnings == 1);
    check_works(scene);
    bk_scene_release(scene);

    scene = empty_scene(device);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    mesh.indices = indices[2];
    mesh.triangle_count = 3;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    CHECK_ERROR(bk_scene_commit(scene, NULL, NULL), STATE, "all 3 triangles");
    mesh = floor_desc();
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    bk_scene_release(scene);
    bk_device_release(device);
}

/* ---- Files ---- */

static void write_file(const char *path, const char *content) {
    FILE *file = fopen(path, "wb");
    CHECK(file != NULL);
    if (!file) return;
    fputs(content, file);
    fclose(file);
}

static void files(bk_device *device) {
    bk_scene *scene = empty_scene(device);
    bk_load_info info;
    bk_light_desc lamp = lamp_desc();
    char path[1024];

    CHECK_ERROR(bk_scene_load_file(scene, "no/such/file.obj", NULL, NULL, NULL, NULL), BK_ERROR_IO, "no/such/file.obj");
    CHECK_ERROR(bk_scene_load_file(scene, "no/such/file.ply", NULL, NULL, NULL, NULL), BK_ERROR_IO, "no/such/file.ply");
    CHECK_ERROR(bk_scene_load_file(scene, "no/such/file.glb", NULL, NULL, NULL, NULL), BK_ERROR_IO, "no/such/file.glb");
    CHECK_ERROR(bk_scene_load_file(scene, "scene.max", NULL, NULL, NULL, NULL), BK_ERROR_UNSUPPORTED, "scene.max");
    CHECK_ERROR(bk_scene_load_file(scene, "scene\xff.obj", NULL, NULL, NULL, NULL), ARGUMENT, "path is not UTF-8");
    snprintf(path, sizeof path, "%smalformed.obj", prefix);
    write_file(path, "v 0 0 0\nv 1 0 0\nf 1 2 77\n");
    CHECK_ERROR(bk_scene_load_file(scene, path, NULL, NULL, NULL, NULL), BK_ERROR_IO, "malformed.obj");
    snprintf(path, sizeof path, "%smalformed.ply", prefix);
    write_file(path, "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n0\n");
    CHECK_ERROR(bk_scene_load_file(scene, path, NULL, NULL, NULL, NULL), BK_ERROR_IO, "malformed.ply");
    snprintf(path, sizeof path, "%smalformed.glb", prefix);
    write_file(path, "glTF but not really");
    CHECK_ERROR(bk_scene_load_file(scene, path, NULL, NULL, NULL, NULL), BK_ERROR_IO, "malformed.glb");
    CHECK(bk_scene_mesh_count(scene) == 0);

    snprintf(path, sizeof path, "%sfloor.obj", prefix);
    write_file(path, "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n");
    bk_load_info_init(&info);
    CHECK_OK(bk_scene_load_file(scene, path, NULL, NULL, NULL, &info));
    CHECK(info.meshes == 1 && info.triangles == 2 && info.first_mesh == 0 && info.materials >= 1);
    CHECK_OK(bk_scene_load_file(scene, path, NULL, NULL, NULL, &info));
    CHECK(info.first_mesh == 1 && info.first_material >= 1);
    CHECK_OK(bk_scene_add_light(scene, &lamp, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    check_works(scene);
    bk_scene_release(scene);
}

/* ---- Light maps ---- */

static int32_t refuse_large(void *user, int64_t bytes) { return bytes < *(int64_t *)user; }

static void layouts(bk_device *device) {
    bk_scene *scene = committed_scene(device);
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;

    bk_lightmap_desc_init(&desc);
    desc.texels_per_unit = -1.0f;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap), ARGUMENT, "texels_per_unit is -1");
    desc.texels_per_unit = NAN;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap), ARGUMENT, "texels_per_unit is NaN");
    bk_lightmap_desc_init(&desc);
    desc.page_size = 7;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap), ARGUMENT, "page_size is 7");
    bk_lightmap_desc_init(&desc);
    desc.padding = 0;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap), ARGUMENT, "padding is 0");
    bk_lightmap_desc_init(&desc);
    desc.gather_divisor = 0;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap), ARGUMENT, "gather_divisor is 0");
    bk_lightmap_desc_init(&desc);
    desc.radiance_divisor = 1000;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap), ARGUMENT, "radiance_divisor is 1000");
    CHECK(lightmap == NULL);
    check_works(scene);
    bk_scene_release(scene);
}

/* The caller's own UVs: out of range and overlapping ones are counted, and baked all the same. */
static void bad_uvs(bk_device *device) {
    static const float outside[4][2] = {{0.1f, 0.1f}, {1.4f, 0.1f}, {0.9f, 0.9f}, {0.1f, 0.9f}};
    int overlapping;
    for (overlapping = 0; overlapping < 2; overlapping++) {
        bk_scene *scene = empty_scene(device);
        bk_lightmap *lightmap;
        bk_light_desc lamp = lamp_desc();
        bk_mesh_desc mesh = floor_desc();
        bk_bake_params params = quick_bake();
        bk_lightmap_info info;
        bk_material_desc material;

        bk_material_desc_init(&material);
        CHECK_OK(bk_scene_add_material(scene, &material, NULL));
        CHECK_OK(bk_scene_add_light(scene, &lamp, NULL));
        mesh.lightmap_uvs = overlapping ? FLOOR_UVS[0] : outside[0];
        CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
        if (overlapping) CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
        CHECK_OK(bk_scene_commit(scene, NULL, NULL));
        lightmap = small_lightmap(scene, 32);
        bk_lightmap_info_init(&info);
        CHECK_OK(bk_lightmap_get_info(lightmap, &info));
        if (overlapping) {
            CHECK(info.uv_overlapping_texels > 100 && info.uv_out_of_range == 0);
        } else {
            CHECK(info.uv_out_of_range >= 1 && info.uv_overlapping_texels == 0 && info.unwrapped_charts >= 1);
        }
        CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
        bk_lightmap_release(lightmap);
        bk_scene_release(scene);
    }
}

static void memory(void) {
    bk_device *device = NULL;
    bk_device_desc device_desc;
    bk_scene *scene;
    bk_lightmap *lightmap = NULL;
    bk_photon_map *map = NULL;
    bk_lightmap_desc desc;
    bk_bake_params bake = quick_bake();
    bk_photon_params photons;
    bk_light_desc lamp = lamp_desc();
    int64_t limit = 16;

    bk_device_desc_init(&device_desc);
    device_desc.memory = refuse_large;
    device_desc.user = &limit;
    CHECK_OK(bk_device_create(&device_desc, &device));
    scene = empty_scene(device);
    CHECK_ERROR(bk_scene_load_builtin(scene, "cornell"), BK_ERROR_OUT_OF_MEMORY, "refused");
    CHECK(bk_scene_mesh_count(scene) == 0);
    limit = (int64_t)1 << 30;
    add_floor(scene);
    CHECK_OK(bk_scene_add_light(scene, &lamp, NULL));
    limit = 16;
    CHECK_ERROR(bk_scene_commit(scene, NULL, NULL), BK_ERROR_OUT_OF_MEMORY, "refused");
    limit = (int64_t)1 << 30;
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));

    /* More texels than memory, and more than the monitor allows. */
    bk_lightmap_desc_init(&desc);
    desc.texels_per_unit = 1e9f;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap), BK_ERROR_OUT_OF_MEMORY, "texels");
    desc.texels_per_unit = 16.0f;
    desc.page_size = 32;
    limit = 16;
    CHECK_ERROR(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap), BK_ERROR_OUT_OF_MEMORY, "refused");
    CHECK(lightmap == NULL);
    bk_photon_params_init(&photons);
    photons.photon_count = 1000;
    CHECK_ERROR(bk_photon_map_create(scene, &photons, NULL, NULL, &map), BK_ERROR_OUT_OF_MEMORY, "refused");
    limit = (int64_t)1 << 30;
    photons.memory_budget = 100;
    CHECK_ERROR(bk_photon_map_create(scene, &photons, NULL, NULL, &map), BK_ERROR_OUT_OF_MEMORY, "budget");
    CHECK(map == NULL);

    lightmap = small_lightmap(scene, 32);
    bake.memory_budget = 100;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), BK_ERROR_OUT_OF_MEMORY, "budget");
    bake.memory_budget = 0;
    limit = 16;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), BK_ERROR_OUT_OF_MEMORY, "refused");
    limit = (int64_t)1 << 30;
    CHECK_OK(bk_bake(lightmap, &bake, NULL, NULL, NULL));
    bk_lightmap_release(lightmap);
    check_works(scene);
    bk_scene_release(scene);
    bk_device_release(device);
}

/* ---- Bakes ---- */

static void bakes(bk_device *device) {
    bk_scene *scene = committed_scene(device);
    bk_lightmap *lightmap = small_lightmap(scene, 32);
    bk_photon_map *map = NULL;
    bk_photon_params photons;
    bk_bake_params bake;
    float pixels[32 * 32][3];
    char path[1024];

    bk_photon_params_init(&photons);
    photons.radius = -1.0f;
    CHECK_ERROR(bk_photon_map_create(scene, &photons, NULL, NULL, &map), ARGUMENT, "radius is -1");
    bk_photon_params_init(&photons);
    photons.cone_k = 0.5f;
    CHECK_ERROR(bk_photon_map_create(scene, &photons, NULL, NULL, &map), ARGUMENT, "cone_k is 0.5");
    bk_photon_params_init(&photons);
    photons.flags = 4;
    CHECK_ERROR(bk_photon_map_create(scene, &photons, NULL, NULL, &map), ARGUMENT, "flags");

    bake = quick_bake();
    bake.radius = NAN;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "radius is NaN");
    bake = quick_bake();
    bake.direct_samples = 0;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "direct_samples is 0");
    bake = quick_bake();
    bake.gather_rays = 1u << 20;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "gather_rays is 1048576");
    bake = quick_bake();
    bake.texel_begin = 1u << 30;
    CHECK_ERROR(bk_bake(lightmap, &bake, NULL, NULL, NULL), ARGUMENT, "texel_begin 1073741824");

    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, pixels, 0), STATE, "baked");
    snprintf(path, sizeof path, "%sunbaked-", prefix);
    CHECK_ERROR(bk_lightmap_save(lightmap, path, BK_FILE_EXR, NULL, NULL), STATE, "baked");
    bake = quick_bake();
    CHECK_OK(bk_bake(lightmap, &bake, NULL, NULL, NULL));
    CHECK_ERROR(bk_lightmap_read(lightmap, 9, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, pixels, 0), ARGUMENT, "page is 9");
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, 77, BK_FORMAT_RGB32F, pixels, 0), ARGUMENT, "layer is 77");
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, 0, pixels, 0), ARGUMENT, "format is 0");
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_R32F, pixels, 0), ARGUMENT, "format is 3");
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_TRIANGLE, BK_FORMAT_RGB32F, pixels, 0), ARGUMENT, "Triangle");
    CHECK_ERROR(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, pixels, 32), ARGUMENT,
                "row_stride is 32");
    CHECK_ERROR(bk_lightmap_save(lightmap, path, 9, NULL, NULL), ARGUMENT, "file_format is 9");
    CHECK_ERROR(bk_lightmap_save(lightmap, "no/such/folder/x", BK_FILE_PNG, NULL, NULL), BK_ERROR_IO, "no/such/folder/x");
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, pixels, 0));
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
}

/* Without lights all is dark, and the plan says so. */
static void no_lights(bk_device *device) {
    bk_scene *scene = empty_scene(device);
    bk_lightmap *lightmap;
    bk_bake_params params = quick_bake();
    bk_bake_stats stats;
    float pixels[32 * 32][3];
    int i, lit = 0;

    add_floor(scene);
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    lightmap = small_lightmap(scene, 32);
    bk_bake_stats_init(&stats);
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, &stats));
    CHECK((stats.left_out & BK_LEFT_OUT_DIRECT) && (stats.left_out & BK_LEFT_OUT_INDIRECT));
    CHECK(stats.photons_emitted == 0 && stats.direct.rays == 0);
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, pixels, 0));
    for (i = 0; i < 32 * 32; i++) lit += pixels[i][0] != 0.0f || pixels[i][1] != 0.0f || pixels[i][2] != 0.0f;
    CHECK(lit == 0);
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
}

int main(int argc, char **argv) {
    bk_device *device = NULL;
    if (argc > 1) prefix = argv[1];
    CHECK(strcmp(bk_last_error(), "") == 0);
    devices();
    CHECK_OK(bk_device_create(NULL, &device));
    nulls(device);
    struct_sizes(device);
    descriptions(device);
    before_commit(device);
    skipped_triangles();
    files(device);
    layouts(device);
    bad_uvs(device);
    memory();
    bakes(device);
    no_lights(device);
    sky(device);
    bk_device_release(device);
    return check_report("bad_input");
}
