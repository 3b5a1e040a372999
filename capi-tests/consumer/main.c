/* The least that bakes: a built-in scene, default settings, PNG files in the current folder. */
#include <bakelite.h>
#include <stdio.h>
#include <stdlib.h>

static void check(bk_result result) {
    if (result != BK_OK) {
        fprintf(stderr, "%s: %s\n", bk_result_string(result), bk_last_error());
        exit(EXIT_FAILURE);
    }
}

int main(void) {
    bk_device *device = NULL;
    bk_scene *scene = NULL;
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;

    check(bk_device_create(NULL, &device));
    check(bk_scene_create(device, &scene));
    check(bk_scene_load_builtin(scene, "cornell"));
    check(bk_scene_commit(scene, NULL, NULL));

    bk_lightmap_desc_init(&desc);
    desc.page_size = 128;
    check(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    check(bk_bake(lightmap, NULL, NULL, NULL, NULL));
    check(bk_lightmap_save(lightmap, "cornell-", BK_FILE_PNG, NULL, NULL));

    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
    bk_device_release(device);
    return EXIT_SUCCESS;
}
