/* What a renderer needs to draw a scene that came from a file: geometry, materials, textures and lights, read back
 * and compared with the file; and the same for scenes made call by call, before and after the commit. */
#include "check.h"

#define ARGUMENT BK_ERROR_INVALID_ARGUMENT

static char path[1024];

static const char *in_folder(const char *folder, const char *name) {
    snprintf(path, sizeof path, "%s%s", folder, name);
    return path;
}

static void write_file(const char *name, const void *data, size_t bytes) {
    FILE *file = fopen(name, "wb");
    CHECK(file && fwrite(data, 1, bytes, file) == bytes && fclose(file) == 0);
}

static int equal(const float *a, const float *b, int count) {
    return memcmp(a, b, (size_t)count * sizeof(float)) == 0;
}

/* ---- A scene of a file ---- */

static const char OBJ[] =
    "mtllib getters.mtl\n"
    "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n"
    "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    "vn 0 0 1\n"
    "usemtl painted\nf 1/1/1 2/2/1 3/3/1\n"
    "usemtl lamp\nf 1/1/1 3/3/1 4/4/1\n";

static const char MTL[] =
    "newmtl painted\nKd 0.25 0.5 0.75\nmap_Kd getters.png\n"
    "newmtl lamp\nKd 0.125 0 0\nKe 3 2 1\n";

/* 2 x 2 texels of RGBA, as below. */
static const unsigned char PNG[] = {
    0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a, 0x00, 0x00, 0x00, 0x0d, 0x49, 0x48, 0x44, 0x52, 0x00, 0x00, 0x00, 0x02,
    0x00, 0x00, 0x00, 0x02, 0x08, 0x06, 0x00, 0x00, 0x00, 0x72, 0xb6, 0x0d, 0x24, 0x00, 0x00, 0x00, 0x17, 0x49, 0x44, 0x41,
    0x54, 0x78, 0xda, 0x63, 0xf8, 0xcf, 0xc0, 0xf0, 0x1f, 0x08, 0x1b, 0x18, 0x80, 0xb4, 0x03, 0x27, 0x07, 0x3b, 0x03, 0x00,
    0x37, 0x6b, 0x04, 0xd5, 0x69, 0xcc, 0x88, 0x1f, 0x00, 0x00, 0x00, 0x00, 0x49, 0x45, 0x4e, 0x44, 0xae, 0x42, 0x60, 0x82};
static const unsigned char FIRST_ROW[8] = {255, 0, 0, 255, 0, 255, 0, 128};
static const unsigned char SECOND_ROW[8] = {0, 0, 255, 64, 9, 8, 7, 0};

/* Wherever a file format puts v = 0, the rows are those of the image, one way or the other. */
static int is_the_image(const bk_texture_desc *t) {
    const unsigned char *rows = (const unsigned char *)t->data;
    int down = memcmp(rows, FIRST_ROW, 8) == 0 && memcmp(rows + 8, SECOND_ROW, 8) == 0;
    int up = memcmp(rows, SECOND_ROW, 8) == 0 && memcmp(rows + 8, FIRST_ROW, 8) == 0;
    return down || up;
}

static void check_file_values(const bk_scene *scene, const bk_load_info *info) {
    static const float painted[3] = {0.25f, 0.5f, 0.75f}, emission[3] = {3, 2, 1}, dark[3] = {0, 0, 0};
    bk_material_desc material, lamp;
    bk_texture_desc texture;
    int swapped;
    CHECK(bk_scene_material_count(scene) == info->materials && bk_scene_texture_count(scene) == 1);
    bk_material_desc_init(&material);
    bk_material_desc_init(&lamp);
    CHECK_OK(bk_scene_get_material(scene, info->first_material, &material));
    CHECK_OK(bk_scene_get_material(scene, info->first_material + 1, &lamp));
    swapped = lamp.albedo_texture != BK_NONE;
    if (swapped) {
        bk_material_desc other = material;
        material = lamp;
        lamp = other;
    }
    CHECK(material.albedo_texture == info->first_texture && equal(material.albedo, painted, 3));
    CHECK(equal(material.emission, dark, 3) && lamp.albedo_texture == BK_NONE && equal(lamp.emission, emission, 3));
    bk_texture_desc_init(&texture);
    CHECK_OK(bk_scene_get_texture(scene, info->first_texture, &texture));
    CHECK(texture.format == BK_TEXTURE_RGBA8_SRGB && texture.width == 2 && texture.height == 2);
    CHECK(texture.row_stride == 0 && is_the_image(&texture));
}

static void a_file(bk_device *device, const char *folder) {
    bk_scene *scene = NULL;
    bk_load_info info;
    uint32_t m, lamps = 0, painted = 0;
    write_file(in_folder(folder, "getters.mtl"), MTL, sizeof MTL - 1);
    write_file(in_folder(folder, "getters.png"), PNG, sizeof PNG);
    write_file(in_folder(folder, "getters.obj"), OBJ, sizeof OBJ - 1);
    CHECK_OK(bk_scene_create(device, &scene));
    bk_load_info_init(&info);
    CHECK_OK(bk_scene_load_file(scene, path, NULL, NULL, NULL, &info));
    CHECK(info.triangles == 2 && info.textures == 1);
    check_file_values(scene, &info);
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    check_file_values(scene, &info);
    /* Every corner of every triangle is as the file has it. */
    for (m = 0; m < bk_scene_mesh_count(scene); m++) {
        bk_mesh_view view;
        size_t t, c;
        bk_mesh_view_init(&view);
        CHECK_OK(bk_scene_get_mesh(scene, m, &view));
        CHECK(view.normals && view.uvs && !view.lightmap_uvs && !view.lightmap_page);
        CHECK((view.material == BK_NONE) == (view.triangle_materials != NULL));
        for (t = 0; t < view.triangle_count; t++) {
            bk_material_desc material;
            uint32_t id = view.triangle_materials ? view.triangle_materials[t] : view.material;
            bk_material_desc_init(&material);
            CHECK_OK(bk_scene_get_material(scene, id, &material));
            *(material.emission[0] > 0 ? &lamps : &painted) += 1;
            for (c = 0; c < 3; c++) {
                size_t v = view.indices[3 * t + c];
                CHECK(view.normals[3 * v] == 0 && view.normals[3 * v + 1] == 0 && view.normals[3 * v + 2] == 1);
                CHECK(view.positions[3 * v] == 2 * view.uvs[2 * v]);
            }
        }
    }
    CHECK(lamps == 1 && painted == 1);
    bk_scene_release(scene);
}

/* ---- A scene of calls ---- */

static const float POSITIONS[4][3] = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};
static const float NORMALS[4][3] = {{0, 0, 1}, {0, 0, 1}, {0, 0, 1}, {0, 0, 1}};
static const float UVS[4][2] = {{0, 0}, {3, 0}, {3, 3}, {0, 3}};
static const float LIGHTMAP_UVS[4][2] = {{0.25f, 0.25f}, {0.5f, 0.25f}, {0.5f, 0.5f}, {0.25f, 0.5f}};
static const uint32_t INDICES[2][3] = {{0, 1, 2}, {0, 2, 3}};
static const uint32_t PAGES[2] = {1, 0};
static const uint32_t MATERIALS[2] = {1, 0};
static const float SKY[2][3] = {{1, 2, 3}, {0, 0.5f, 0}};

static bk_light_desc light_of_type(uint32_t type) {
    bk_light_desc light;
    bk_light_desc_init(&light);
    light.type = type;
    light.color[1] = (float)type;
    if (type != BK_LIGHT_DIRECTIONAL && type != BK_LIGHT_SKY) light.position[2] = 3;
    if (type == BK_LIGHT_SPOT || type == BK_LIGHT_DIRECTIONAL) light.direction[2] = -1;
    if (type == BK_LIGHT_SPOT) light.cone_inner = 0.25f, light.cone_outer = 0.5f;
    if (type == BK_LIGHT_DIRECTIONAL) light.angular_radius = 0.125f;
    if (type == BK_LIGHT_RECT) light.edge_u[0] = 1, light.edge_v[1] = 2;
    if (type == BK_LIGHT_SKY) light.environment = 0, light.up[1] = 0, light.up[2] = 1, light.rotation = 0.5f;
    return light;
}

/* Fields that the type does not use are at their defaults: the structures are equal as a whole. */
static void check_lights(const bk_scene *scene) {
    uint32_t type;
    CHECK(bk_scene_light_count(scene) == 5);
    for (type = BK_LIGHT_POINT; type <= BK_LIGHT_SKY; type++) {
        bk_light_desc given = light_of_type(type), got;
        memset(&got, 0xab, sizeof got);
        bk_light_desc_init(&got);
        CHECK_OK(bk_scene_get_light(scene, type - 1, &got));
        CHECK(memcmp(&given, &got, sizeof got) == 0);
    }
}

static void check_environment(const bk_scene *scene) {
    bk_texture_desc sky;
    CHECK(bk_scene_environment_count(scene) == 1 && bk_scene_texture_count(scene) == 0);
    bk_texture_desc_init(&sky);
    CHECK_OK(bk_scene_get_environment(scene, 0, &sky));
    CHECK(sky.format == BK_TEXTURE_RGB32F && sky.width == 1 && sky.height == 2);
    CHECK(equal((const float *)sky.data, SKY[0], 6));
}

static void check_refusals(const bk_scene *scene) {
    bk_material_desc material;
    bk_light_desc light;
    bk_texture_desc image;
    bk_material_desc_init(&material);
    bk_light_desc_init(&light);
    bk_texture_desc_init(&image);
    CHECK_ERROR(bk_scene_get_material(scene, 2, &material), ARGUMENT, "material 2 does not exist, the scene has 2");
    CHECK_ERROR(bk_scene_get_light(scene, 5, &light), ARGUMENT, "light 5 does not exist, the scene has 5");
    CHECK_ERROR(bk_scene_get_texture(scene, 0, &image), ARGUMENT, "texture 0 does not exist, the scene has 0");
    CHECK_ERROR(bk_scene_get_environment(scene, 1, &image), ARGUMENT, "environment 1 does not exist");
    CHECK_ERROR(bk_scene_get_material(NULL, 0, &material), ARGUMENT, "scene is NULL");
    CHECK_ERROR(bk_scene_get_light(scene, 0, NULL), ARGUMENT, "out is NULL");
    image.struct_size = 4;
    CHECK_ERROR(bk_scene_get_environment(scene, 0, &image), ARGUMENT, "bk_texture_desc.struct_size is 4");
    light.struct_size = 0;
    CHECK_ERROR(bk_scene_get_light(scene, 0, &light), ARGUMENT, "bk_light_desc.struct_size is 0");
    CHECK(bk_scene_material_count(NULL) == 0 && bk_scene_texture_count(NULL) == 0 &&
          bk_scene_environment_count(NULL) == 0);
}

static void calls(bk_device *device) {
    bk_scene *scene = NULL;
    bk_material_desc given, got;
    bk_mesh_desc mesh;
    bk_mesh_view view;
    bk_texture_desc sky;
    const void *texels;
    uint32_t type;
    CHECK_OK(bk_scene_create(device, &scene));
    bk_material_desc_init(&given);
    CHECK_OK(bk_scene_add_material(scene, &given, NULL));
    given.flags = BK_MATERIAL_TWO_SIDED;
    given.albedo[0] = 0.75f;
    given.transmission[2] = 0.25f;
    CHECK_OK(bk_scene_add_material(scene, &given, NULL));
    bk_texture_desc_init(&sky);
    sky.format = BK_TEXTURE_RGB32F;
    sky.width = 1;
    sky.height = 2;
    sky.data = SKY;
    CHECK_OK(bk_scene_add_environment(scene, &sky, NULL));
    for (type = BK_LIGHT_POINT; type <= BK_LIGHT_SKY; type++) {
        bk_light_desc light = light_of_type(type);
        CHECK_OK(bk_scene_add_light(scene, &light, NULL));
    }
    bk_mesh_desc_init(&mesh);
    mesh.positions = POSITIONS[0];
    mesh.vertex_count = 4;
    mesh.indices = INDICES[0];
    mesh.triangle_count = 2;
    mesh.material = 1;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    mesh.normals = NORMALS[0];
    mesh.uvs = UVS[0];
    mesh.lightmap_uvs = LIGHTMAP_UVS[0];
    mesh.lightmap_page = PAGES;
    mesh.triangle_materials = MATERIALS;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));

    bk_material_desc_init(&got);
    CHECK_OK(bk_scene_get_material(scene, 1, &got));
    CHECK(memcmp(&given, &got, sizeof got) == 0);
    check_lights(scene);
    check_environment(scene);
    check_refusals(scene);
    CHECK_OK(bk_scene_get_environment(scene, 0, &sky));
    texels = sky.data;
    bk_mesh_view_init(&view);
    CHECK_ERROR(bk_scene_get_mesh(scene, 0, &view), BK_ERROR_INVALID_STATE, "not committed");
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    CHECK_OK(bk_scene_get_material(scene, 1, &got));
    CHECK(memcmp(&given, &got, sizeof got) == 0);
    check_lights(scene);
    check_environment(scene);
    check_refusals(scene);

    /* Pointers to texels outlive commit and refit. */
    CHECK_OK(bk_scene_get_mesh(scene, 0, &view));
    CHECK(view.material == 1 && !view.triangle_materials && !view.normals && !view.uvs && !view.lightmap_uvs);
    CHECK_OK(bk_mesh_set_positions(scene, 0, POSITIONS[0], 4, 0));
    CHECK_OK(bk_scene_refit(scene));
    CHECK_OK(bk_scene_get_environment(scene, 0, &sky));
    CHECK(sky.data == texels && equal((const float *)texels, SKY[0], 6));

    CHECK_OK(bk_scene_get_mesh(scene, 1, &view));
    CHECK(view.material == BK_NONE && view.vertex_count == 4 && view.triangle_count == 2);
    CHECK(equal(view.positions, POSITIONS[0], 12) && equal(view.normals, NORMALS[0], 12) && equal(view.uvs, UVS[0], 8));
    CHECK(equal(view.lightmap_uvs, LIGHTMAP_UVS[0], 8) && memcmp(view.lightmap_page, PAGES, sizeof PAGES) == 0);
    CHECK(memcmp(view.indices, INDICES, sizeof INDICES) == 0);
    CHECK(memcmp(view.triangle_materials, MATERIALS, sizeof MATERIALS) == 0);
    bk_scene_release(scene);
}

int main(int argc, char **argv) {
    bk_device *device = NULL;
    CHECK_OK(bk_device_create(NULL, &device));
    a_file(device, argc > 1 ? argv[1] : "");
    calls(device);
    bk_device_release(device);
    return check_report("getters");
}
