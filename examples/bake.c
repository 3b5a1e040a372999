/* Bakes a scene file under a sun; writes its light map pages and the scene with them. */
#include <bakelite.h>
#include <stdio.h>

static int32_t progress(void *user, float fraction, const char *stage)
{
    (void)user;
    fprintf(stderr, "\r%3.0f %% %-10s", 100.0 * fraction, stage);
    return 1; /* 0 cancels */
}

int main(int argc, char **argv)
{
    bk_device *device = NULL;
    bk_scene *scene = NULL;
    bk_lightmap *map = NULL;
    bk_light_desc sun;
    bk_light_desc_init(&sun);
    sun.type = BK_LIGHT_DIRECTIONAL;
    sun.direction[0] = 0.3f, sun.direction[1] = -1.0f, sun.direction[2] = 0.2f;
    sun.color[0] = 20.0f, sun.color[1] = 18.0f, sun.color[2] = 15.0f; /* W/m2 */
    int failed = argc != 2 || bk_device_create(NULL, &device) || bk_scene_create(device, &scene) ||
        bk_scene_load_file(scene, argv[1], NULL, progress, NULL, NULL) || bk_scene_add_light(scene, &sun, NULL) ||
        bk_scene_commit(scene, progress, NULL) || bk_lightmap_create(scene, NULL, progress, NULL, &map) ||
        bk_bake(map, NULL, progress, NULL, NULL) || bk_lightmap_save(map, "baked-", BK_FILE_EXR, NULL, NULL) ||
        bk_lightmap_save(map, "baked-", BK_FILE_GLB, NULL, NULL);
    fprintf(stderr, "\n%s\n", argc != 2 ? "usage: bake SCENE" : failed ? bk_last_error() : "done");
    bk_lightmap_release(map);
    bk_scene_release(scene);
    bk_device_release(device);
    return failed;
}
