/*
 * Moved vertices: what follows a refit, who does not, and what is refused.
 *
 *     refit
 */
#include "check.h"

#include <math.h>

#define ARGUMENT BK_ERROR_INVALID_ARGUMENT
#define STATE BK_ERROR_INVALID_STATE

/* Mesh 0 is a floor at z = 0, mesh 1 a glowing ceiling at z = 1. */
static const float SQUARE[4][3] = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};
static const uint32_t UP[2][3] = {{0, 1, 2}, {0, 2, 3}}, DOWN[2][3] = {{0, 2, 1}, {0, 3, 2}};

static void square_at(float z, float out[4][3]) {
    int i;
    memcpy(out, SQUARE, sizeof SQUARE);
    for (i = 0; i < 4; i++) {
        out[i][2] = z;
    }
}

static bk_scene *described_scene(bk_device *device, uint32_t ceiling_flags) {
    bk_scene *scene = NULL;
    bk_material_desc material;
    bk_mesh_desc mesh;
    float ceiling[4][3];
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    material.emission[0] = material.emission[1] = material.emission[2] = 1.0f;
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = SQUARE[0];
    mesh.vertex_count = 4;
    mesh.indices = UP[0];
    mesh.triangle_count = 2;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    square_at(1.0f, ceiling);
    mesh.positions = ceiling[0];
    mesh.indices = DOWN[0];
    mesh.material = 1;
    mesh.flags = ceiling_flags;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    return scene;
}

static bk_scene *committed_scene(bk_device *device, uint32_t ceiling_flags) {
    bk_scene *scene = described_scene(device, ceiling_flags);
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

/* How far it is up to the ceiling from z = 0.1, by all queries alike. */
static float height(const bk_scene *scene) {
    bk_ray ray = {{0.3f, 0.4f, 0.125f}, 0.0f, {0, 0, 1}, INFINITY};
    bk_hit hit, many, gathered;
    uint8_t occluded = 2;
    bk_intersect(scene, &ray, &hit);
    CHECK(bk_occluded(scene, &ray) == (hit.triangle != BK_NONE));
    CHECK_OK(bk_intersect_many(scene, &ray, 1, BK_RAYS_PARALLEL, &many));
    CHECK_OK(bk_occluded_many(scene, &ray, 1, 0, &occluded));
    CHECK_OK(bk_gather(scene, ray.origin, ray.direction, 1, INFINITY, 0, &gathered));
    CHECK(many.t == hit.t && gathered.t == hit.t && occluded == (hit.triangle != BK_NONE));
    return hit.t;
}

static bk_scene_stats stats_of(const bk_scene *scene) {
    bk_scene_stats stats;
    bk_scene_stats_init(&stats);
    CHECK_OK(bk_scene_get_stats(scene, &stats));
    return stats;
}

/* A scene that is not committed, of a number of meshes that are each a floor. */
static bk_scene *floors(bk_device *device, int count) {
    bk_scene *scene = NULL;
    bk_material_desc material;
    bk_mesh_desc floor;
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&floor);
    floor.positions = SQUARE[0];
    floor.vertex_count = 4;
    floor.indices = UP[0];
    floor.triangle_count = 2;
    while (count-- > 0) {
        CHECK_OK(bk_scene_add_mesh(scene, &floor, NULL));
    }
    return scene;
}

/* The floor as two instances, one of them turned upside down at z = 1, which then moves. */
static void test_instances(bk_device *device) {
    static const float AT_0[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0};
    static const float AT_1[12] = {1, 0, 0, 0, -1, 0, 0, 0, -1, 0, 1, 1};
    static const float MIRROR[12] = {1, 0, 0, 0, 1, 0, 0, 0, -1, 0, 0, 0};
    float at[12], back[12], uvs[2][12], none[12];
    uint32_t id = 7, mesh = 7, pages[2][2];
    uint8_t separate[2];
    bk_scene *scene;
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;
    bk_ray ray = {{0.3f, 0.4f, 0.125f}, 0.0f, {0, 0, 1}, INFINITY};
    bk_hit hit;
    scene = floors(device, 1);
    CHECK_ERROR(bk_scene_add_instance(scene, 1, AT_0, &id), ARGUMENT, "mesh 1");
    CHECK_ERROR(bk_scene_add_instance(scene, 0, MIRROR, &id), ARGUMENT, "mirrors");
    CHECK_ERROR(bk_scene_add_instance(scene, 0, NULL, &id), ARGUMENT, "transform");
    CHECK(bk_scene_instance_count(scene) == 0);
    CHECK_OK(bk_scene_add_instance(scene, 0, AT_0, NULL));
    CHECK_OK(bk_scene_add_instance(scene, 0, AT_1, &id));
    CHECK(id == 1 && bk_scene_instance_count(scene) == 2);
    CHECK_ERROR(bk_instance_set_transform(scene, 0, AT_0), STATE, "not committed");
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    CHECK_ERROR(bk_scene_add_instance(scene, 0, AT_0, NULL), STATE, "instances can be added no more");
    CHECK_OK(bk_scene_get_instance(scene, 1, &mesh, back));
    CHECK(mesh == 0 && memcmp(back, AT_1, sizeof back) == 0);
    CHECK_ERROR(bk_scene_get_instance(scene, 2, &mesh, back), ARGUMENT, "instance 2");

    bk_intersect(scene, &ray, &hit);
    CHECK(hit.t == 0.875f && hit.mesh == 0 && hit.instance == 1 && height(scene) == hit.t);
    ray.direction[2] = -1;
    bk_intersect(scene, &ray, &hit);
    CHECK(hit.t == 0.125f && hit.mesh == 0 && hit.instance == 0);

    bk_lightmap_desc_init(&desc);
    desc.texels_per_unit = 8;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    CHECK_ERROR(bk_lightmap_mesh_uvs(lightmap, 0, none, NULL), ARGUMENT, "instances");
    CHECK_ERROR(bk_lightmap_instance_uvs(lightmap, 2, none, NULL), ARGUMENT, "instance 2");
    CHECK_OK(bk_lightmap_instance_uvs(lightmap, 0, uvs[0], pages[0]));
    CHECK_OK(bk_lightmap_instance_back_uvs(lightmap, 1, uvs[1], pages[1], separate));
    CHECK(pages[0][0] == 0 && pages[1][1] == 0 && separate[0] == 0);
    CHECK(memcmp(uvs[0], uvs[1], sizeof uvs[0]) != 0);
    bk_lightmap_release(lightmap);

    memcpy(at, AT_1, sizeof at);
    at[11] = 2;
    CHECK_ERROR(bk_instance_set_transform(scene, 2, at), ARGUMENT, "instance 2");
    CHECK_ERROR(bk_instance_set_transform(scene, 1, MIRROR), ARGUMENT, "mirrors");
    CHECK_OK(bk_instance_set_transform(scene, 1, at));
    CHECK(height(scene) == 0.875f);
    CHECK_OK(bk_scene_refit(scene));
    CHECK(height(scene) == 1.875f && stats_of(scene).triangles == 4);
    bk_scene_release(scene);
}

/* Two floors one above the other, of which the second shows the light of the first. */
static void test_shared_light(bk_device *device) {
    static const float AT[3][12] = {
        {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0}, {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1}, {1, 0, 0, 0, 1, 0, 0, 0, 1, 5, 0, 0}};
    static const float UP_THERE[3] = {0.5f, 0.5f, 3.0f}, WHITE[3] = {1, 1, 1};
    float uvs[3][12];
    uint32_t i, pages[3][2], of = 7;
    bk_scene *scene;
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;
    bk_lightmap_info alone, shared;
    bk_light_desc lamp;
    bk_bake_params params;
    scene = floors(device, 2);
    for (i = 0; i < 3; i++) {
        CHECK_OK(bk_scene_add_instance(scene, i / 2, AT[i], NULL));
    }
    CHECK_ERROR(bk_instance_share_light(scene, 3, 0), ARGUMENT, "instance 3");
    CHECK_ERROR(bk_instance_share_light(scene, 1, 1), ARGUMENT, "before it");
    CHECK_ERROR(bk_instance_share_light(scene, 0, 1), ARGUMENT, "before it");
    CHECK_ERROR(bk_instance_share_light(scene, 2, 0), ARGUMENT, "mesh 0");
    CHECK_OK(bk_instance_light_of(scene, 1, &of));
    CHECK(of == 1);
    CHECK_OK(bk_instance_share_light(scene, 1, 0));
    CHECK_OK(bk_instance_light_of(scene, 1, &of));
    CHECK(of == 0);
    CHECK_ERROR(bk_instance_light_of(scene, 3, &of), ARGUMENT, "instance 3");
    CHECK_ERROR(bk_instance_light_of(scene, 0, NULL), ARGUMENT, "out_instance");
    bk_light_desc_init(&lamp);
    lamp.type = BK_LIGHT_POINT;
    memcpy(lamp.position, UP_THERE, sizeof lamp.position);
    memcpy(lamp.color, WHITE, sizeof lamp.color);
    CHECK_OK(bk_scene_add_light(scene, &lamp, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    CHECK_ERROR(bk_instance_share_light(scene, 1, 0), STATE, "share light no more");
    CHECK_OK(bk_instance_light_of(scene, 1, &of));
    CHECK(of == 0);

    bk_lightmap_desc_init(&desc);
    desc.texels_per_unit = 8;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    for (i = 0; i < 3; i++) {
        CHECK_OK(bk_lightmap_instance_uvs(lightmap, i, uvs[i], pages[i]));
    }
    CHECK(memcmp(uvs[0], uvs[1], sizeof uvs[0]) == 0 && memcmp(uvs[0], uvs[2], sizeof uvs[0]) != 0);
    bk_lightmap_info_init(&shared);
    CHECK_OK(bk_lightmap_get_info(lightmap, &shared));
    bk_bake_params_init(&params);
    params.photon_count = 1000;
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);

    /* As many texels as two floors have. */
    scene = floors(device, 1);
    for (i = 0; i < 2; i++) {
        CHECK_OK(bk_scene_add_instance(scene, 0, AT[i], NULL));
    }
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    bk_lightmap_info_init(&alone);
    CHECK_OK(bk_lightmap_get_info(lightmap, &alone));
    CHECK(shared.texels == alone.texels && shared.charts == alone.charts);
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
}

static void test_use(bk_device *device) {
    bk_scene *scene = committed_scene(device, 0);
    bk_scene_stats before = stats_of(scene), after;
    struct { float position[3], other[2]; } vertices[4];
    float ceiling[4][3], lower[3], upper[3];
    bk_mesh_view view;
    int i;

    /* Nothing to do is fine. */
    CHECK_OK(bk_scene_refit(scene));
    CHECK(stats_of(scene).refits == 0 && stats_of(scene).refit_seconds == 0.0);

    /* Positions are staged, the last ones hold. */
    square_at(7.0f, ceiling);
    CHECK_OK(bk_mesh_set_positions(scene, 1, ceiling[0], 4, 0));
    square_at(3.125f, ceiling);
    for (i = 0; i < 4; i++) {
        memcpy(vertices[i].position, ceiling[i], sizeof ceiling[i]);
    }
    CHECK_OK(bk_mesh_set_positions(scene, 1, vertices[0].position, 4, sizeof vertices[0]));
    memset(vertices, 0xff, sizeof vertices);
    CHECK(height(scene) == 0.875f);
    CHECK_OK(bk_scene_refit(scene));
    CHECK(height(scene) == 3.0f);
    CHECK_OK(bk_scene_bounds(scene, lower, upper));
    CHECK(lower[2] == 0.0f && upper[2] == 3.125f);
    bk_mesh_view_init(&view);
    CHECK_OK(bk_scene_get_mesh(scene, 1, &view));
    CHECK(view.vertex_count == 4 && view.positions[2] == 3.125f);
    after = stats_of(scene);
    CHECK(after.refits == 1 && after.sah_cost == before.sah_cost && after.refit_seconds > 0.0);
    CHECK(before.wide_sah_cost > 0.0f && after.wide_sah_cost > 0.0f);

    /* What becomes no triangle is not hit, and comes back. */
    ceiling[0][1] = NAN;
    CHECK_OK(bk_mesh_set_positions(scene, 1, ceiling[0], 4, 0));
    CHECK_OK(bk_scene_refit(scene));
    CHECK(height(scene) == INFINITY && stats_of(scene).skipped_degenerate == 2);
    square_at(2.125f, ceiling);
    CHECK_OK(bk_mesh_set_positions(scene, 1, ceiling[0], 4, 0));
    CHECK_OK(bk_scene_refit(scene));
    CHECK(height(scene) == 2.0f && stats_of(scene).skipped_degenerate == 0);
    bk_scene_release(scene);
}

/* The mean brightness of the light map's first page. */
static double brightness(bk_lightmap *lightmap) {
    static float pixels[64 * 64 * 3];
    bk_bake_params params;
    double sum = 0.0;
    int i;
    bk_bake_params_init(&params);
    params.photon_count = 20000;
    params.gather_rays = 16;
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    CHECK_OK(bk_lightmap_read(lightmap, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, pixels, 0));
    for (i = 0; i < 64 * 64 * 3; i++) {
        sum += pixels[i];
    }
    return sum / (64 * 64 * 3);
}

static void test_old_lightmaps(bk_device *device) {
    bk_scene *scene = committed_scene(device, 0);
    bk_lightmap *old = small_lightmap(scene, 64), *moved;
    double first = brightness(old);
    float ceiling[4][3];
    square_at(4.0f, ceiling);
    CHECK_OK(bk_mesh_set_positions(scene, 1, ceiling[0], 4, 0));
    CHECK_OK(bk_scene_refit(scene));
    moved = small_lightmap(scene, 64);
    CHECK(brightness(old) == first);
    CHECK(brightness(moved) < 0.8 * first);
    bk_lightmap_release(moved);
    bk_scene_release(scene);
    CHECK(brightness(old) == first);
    bk_lightmap_release(old);
}

static int32_t refit_in_callback(void *user, float fraction, const char *stage) {
    (void)fraction;
    (void)stage;
    CHECK_ERROR(bk_scene_refit((bk_scene *)user), STATE, "callback");
    return 1;
}

static void test_bad_input(bk_device *device) {
    bk_scene *scene = described_scene(device, BK_MESH_STRICT);
    bk_photon_map *map = NULL;
    bk_photon_params photons;
    float p[4][3];
    square_at(2.125f, p);
    CHECK_ERROR(bk_mesh_set_positions(NULL, 1, p[0], 4, 0), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_refit(NULL), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_mesh_set_positions(scene, 1, p[0], 4, 0), STATE, "not committed");
    CHECK_ERROR(bk_scene_refit(scene), STATE, "not committed");
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));

    /* A refused call loses nothing of what an earlier one set. */
    CHECK_OK(bk_mesh_set_positions(scene, 1, p[0], 4, 0));
    CHECK_ERROR(bk_mesh_set_positions(scene, 2, p[0], 4, 0), ARGUMENT, "mesh 2 does not exist");
    CHECK_ERROR(bk_mesh_set_positions(scene, BK_NONE, p[0], 4, 0), ARGUMENT, "does not exist");
    CHECK_ERROR(bk_mesh_set_positions(scene, 1, p[0], 3, 0), ARGUMENT, "vertex_count is 3");
    CHECK_ERROR(bk_mesh_set_positions(scene, 1, p[0], SIZE_MAX, 0), ARGUMENT, "vertex_count is");
    CHECK_ERROR(bk_mesh_set_positions(scene, 1, NULL, 4, 0), ARGUMENT, "positions is NULL");
    CHECK_ERROR(bk_mesh_set_positions(scene, 1, p[0], 4, 8), ARGUMENT, "stride of positions is 8");
    CHECK_ERROR(bk_mesh_set_positions(scene, 1, p[0], 4, SIZE_MAX / 2), ARGUMENT, "larger than memory");
    p[2][0] = NAN;
    CHECK_ERROR(bk_mesh_set_positions(scene, 1, p[0], 4, 0), ARGUMENT, "triangle 0");
    CHECK_OK(bk_mesh_set_positions(scene, 0, p[0], 4, 0));
    bk_photon_params_init(&photons);
    photons.photon_count = 1000;
    CHECK_OK(bk_photon_map_create(scene, &photons, refit_in_callback, scene, &map));
    bk_photon_map_release(map);
    CHECK(height(scene) == 0.875f);
    CHECK_OK(bk_scene_refit(scene));
    CHECK(height(scene) == 2.0f);
    bk_scene_release(scene);

    /* A refit that leaves nothing is refused, and what was set waits for more. */
    scene = committed_scene(device, 0);
    memset(p, 0, sizeof p);
    CHECK_OK(bk_mesh_set_positions(scene, 0, p[0], 4, 0));
    CHECK_OK(bk_mesh_set_positions(scene, 1, p[0], 4, 0));
    CHECK_ERROR(bk_scene_refit(scene), STATE, "all triangles");
    CHECK(height(scene) == 0.875f);
    square_at(5.125f, p);
    CHECK_OK(bk_mesh_set_positions(scene, 1, p[0], 4, 0));
    CHECK_OK(bk_scene_refit(scene));
    CHECK(height(scene) == 5.0f && stats_of(scene).skipped_degenerate == 2);
    bk_scene_release(scene);
}

int main(void) {
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.num_threads = 2;
    CHECK_OK(bk_device_create(&desc, &device));
    test_instances(device);
    test_shared_light(device);
    test_use(device);
    test_old_lightmaps(device);
    test_bad_input(device);
    bk_device_release(device);
    return check_report("refit");
}
