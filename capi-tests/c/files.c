/* Files: which of them a scene may name, limits, cancelling while they are read and written, and what is left of an
 * old file when a save fails or is killed. C99 and POSIX.
 *
 *     files [FOLDER/]  */
#if !defined(_POSIX_C_SOURCE)
#define _POSIX_C_SOURCE 200809L
#endif
#if !defined(_XOPEN_SOURCE)
#define _XOPEN_SOURCE 700
#endif
#include "check.h"
#include "limit_files.h"
#include <dirent.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static char folder[512];

static const char *at(const char *name) {
    static char paths[4][1024];
    static int next = 0;
    char *path = paths[next++ % 4];
    snprintf(path, sizeof paths[0], "%s%s", folder, name);
    return path;
}

static void write_text(const char *name, const char *text) {
    FILE *file = fopen(at(name), "wb");
    CHECK(file != NULL);
    if (file == NULL) return;
    fputs(text, file);
    fclose(file);
}

static long size_of(const char *name) {
    struct stat s;
    return stat(at(name), &s) == 0 ? (long)s.st_size : -1;
}

/* Whether a folder holds a file that a save has left beside another. */
static int has_part(const char *name) {
    DIR *d = opendir(at(name));
    struct dirent *entry;
    int found = 0;
    CHECK(d != NULL);
    while (d != NULL && (entry = readdir(d)) != NULL) found += strstr(entry->d_name, ".part") != NULL;
    if (d != NULL) closedir(d);
    return found;
}

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* ---- Which files a scene may name ---- */

static int warnings = 0;
static char last_warning[512];

static void on_log(void *user, uint32_t level, const char *message) {
    (void)user;
    if (level == BK_LOG_WARNING) {
        warnings++;
        snprintf(last_warning, sizeof last_warning, "%s", message);
    }
}

static bk_scene *new_scene(bk_device *device) {
    bk_scene *scene = NULL;
    CHECK_OK(bk_scene_create(device, &scene));
    return scene;
}

/* A triangle whose material has the image `image`. */
static void write_obj(const char *name, const char *library, const char *image) {
    char text[2048];
    snprintf(text, sizeof text, "newmtl m\nmap_Kd %s\n", image);
    write_text("scene/a.mtl", text);
    snprintf(text, sizeof text, "mtllib %s\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n", library);
    write_text(name, text);
}

/* A 2 x 2 PNG file, grey. */
static const unsigned char PNG[] = {
    0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a, 0x00, 0x00, 0x00, 0x0d, 0x49, 0x48, 0x44, 0x52, 0x00, 0x00, 0x00,
    0x02, 0x00, 0x00, 0x00, 0x02, 0x08, 0x00, 0x00, 0x00, 0x00, 0x57, 0xdd, 0x52, 0xf8, 0x00, 0x00, 0x00, 0x0e, 0x49,
    0x44, 0x41, 0x54, 0x78, 0x9c, 0x63, 0xe0, 0x12, 0x61, 0x90, 0xd3, 0x00, 0x00, 0x00, 0xec, 0x00, 0x65, 0xe0, 0xf8,
    0x5c, 0xd3, 0x00, 0x00, 0x00, 0x00, 0x49, 0x45, 0x4e, 0x44, 0xae, 0x42, 0x60, 0x82};

static void write_png(const char *name) {
    FILE *file = fopen(at(name), "wb");
    CHECK(file != NULL && fwrite(PNG, 1, sizeof PNG, file) == sizeof PNG);
    if (file != NULL) fclose(file);
}

/* Loads scene/a.obj and returns how many textures came with it; -1: it failed. */
static int textures(bk_device *device, const bk_load_params *params) {
    bk_load_info info;
    bk_scene *scene = new_scene(device);
    bk_result result;
    bk_load_info_init(&info);
    warnings = 0;
    last_warning[0] = 0;
    result = bk_scene_load_file(scene, at("scene/a.obj"), params, NULL, NULL, &info);
    bk_scene_release(scene);
    return result == BK_OK ? (int)info.textures : -1;
}

static void named_files(bk_device *device) {
    bk_load_params params;
    struct sockaddr_un address;
    int s = socket(AF_UNIX, SOCK_STREAM, 0);
    const char *refused[] = {"../out.png", "/dev/zero", "/dev/null", "fifo", "socket", "link", "..\\out.png", "below",
                             "file:///dev/zero", "http://x/y.png", "below/../../out.png", "dev/zero"};
    size_t i;
    char absolute[1024], image[1100];

    mkdir(at("scene"), 0755);
    mkdir(at("scene/below"), 0755);
    write_png("out.png");
    write_png("scene/in.png");
    write_png("scene/below/in.png");
    unlink(at("scene/fifo"));
    unlink(at("scene/socket"));
    unlink(at("scene/link"));
    unlink(at("scene/dev"));
    CHECK(mkfifo(at("scene/fifo"), 0600) == 0);
    CHECK(symlink("../out.png", at("scene/link")) == 0);
    CHECK(symlink("/dev", at("scene/dev")) == 0);
    memset(&address, 0, sizeof address);
    address.sun_family = AF_UNIX;
    if (strlen(at("scene/socket")) < sizeof address.sun_path) {
        strcpy(address.sun_path, at("scene/socket"));
        CHECK(bind(s, (struct sockaddr *)&address, sizeof address) == 0);
    }

    write_obj("scene/a.obj", "a.mtl", "in.png");
    CHECK(textures(device, NULL) == 1 && warnings == 0);
    write_obj("scene/a.obj", "a.mtl", "below/in.png");
    CHECK(textures(device, NULL) == 1 && warnings == 0);
    for (i = 0; i < sizeof refused / sizeof *refused; i++) {
        write_obj("scene/a.obj", "a.mtl", refused[i]);
        CHECK(textures(device, NULL) == 0 && warnings == 1);
        if (textures(device, NULL) != 0) fprintf(stderr, "   %s was opened\n", refused[i]);
    }
    CHECK(realpath(at("out.png"), absolute) != NULL);
    write_obj("scene/a.obj", "a.mtl", absolute);
    CHECK(textures(device, NULL) == 0 && strstr(last_warning, "is not below") != NULL);

    /* What the caller allows. Devices never. */
    bk_load_params_init(&params);
    params.base_folder = folder[0] ? folder : ".";
    write_obj("scene/a.obj", "a.mtl", "../out.png");
    CHECK(textures(device, &params) == 1);
    params.base_folder = NULL;
    params.flags = BK_LOAD_ANY_FOLDER;
    CHECK(textures(device, &params) == 1);
    snprintf(image, sizeof image, "%s", absolute);
    write_obj("scene/a.obj", "a.mtl", image);
    CHECK(textures(device, &params) == 1);
    for (i = 1; i < 5; i++) {
        write_obj("scene/a.obj", "a.mtl", refused[i]);
        CHECK(textures(device, &params) == 0 && warnings == 1);
    }
    /* Libraries too. */
    write_obj("scene/a.obj", "/dev/zero", "in.png");
    CHECK(textures(device, &params) == 0 && warnings >= 1);
    write_obj("scene/a.obj", "fifo", "in.png");
    CHECK(textures(device, &params) == 0 && warnings >= 1);

    /* A buffer that cannot be read is an error, and so is a scene that is a device or a folder. */
    {
        bk_scene *scene = new_scene(device);
        write_text("scene/a.gltf", "{\"asset\":{\"version\":\"2.0\"},\"buffers\":[{\"byteLength\":9,"
                                   "\"uri\":\"%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/dev/zero\"}]}");
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/a.gltf"), NULL, NULL, NULL, NULL), BK_ERROR_IO, "buffer 0");
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/a.gltf"), &params, NULL, NULL, NULL), BK_ERROR_IO, "buffer 0");
        unlink(at("scene/zero.ply"));
        CHECK(symlink("/dev/zero", at("scene/zero.ply")) == 0);
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/zero.ply"), NULL, NULL, NULL, NULL), BK_ERROR_IO, "device");
        unlink(at("scene/fifo.obj"));
        CHECK(mkfifo(at("scene/fifo.obj"), 0600) == 0);
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/fifo.obj"), NULL, NULL, NULL, NULL), BK_ERROR_IO, "FIFO");
        mkdir(at("scene/folder.glb"), 0755);
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/folder.glb"), NULL, NULL, NULL, NULL), BK_ERROR_IO, "folder");
        CHECK(bk_scene_mesh_count(scene) == 0);

        params.flags = 2;
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/a.obj"), &params, NULL, NULL, NULL),
                    BK_ERROR_INVALID_ARGUMENT, "flags is 0x2");
        params.flags = 0;
        params.base_folder = "no/such/folder";
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/a.obj"), &params, NULL, NULL, NULL),
                    BK_ERROR_INVALID_ARGUMENT, "base_folder");
        params.struct_size = 1;
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/a.obj"), &params, NULL, NULL, NULL),
                    BK_ERROR_INVALID_ARGUMENT, "bk_load_params.struct_size is 1");
        bk_scene_release(scene);
    }
    close(s);
}

static void limits(bk_device *device) {
    bk_load_params params;
    bk_scene *scene = new_scene(device);
    bk_load_params_init(&params);
    CHECK(params.max_texture_bytes == (uint64_t)2 << 30 && params.max_file_bytes == (uint64_t)16 << 30);
    write_obj("scene/a.obj", "a.mtl", "in.png");
    params.max_texture_bytes = 15;
    CHECK_ERROR(bk_scene_load_file(scene, at("scene/a.obj"), &params, NULL, NULL, NULL), BK_ERROR_OUT_OF_MEMORY,
                "max_texture_bytes");
    params.max_texture_bytes = 16;
    params.max_file_bytes = 100;
    CHECK_ERROR(bk_scene_load_file(scene, at("scene/a.obj"), &params, NULL, NULL, NULL), BK_ERROR_OUT_OF_MEMORY,
                "max_file_bytes");
    CHECK(bk_scene_mesh_count(scene) == 0);
    params.max_file_bytes = 1000;
    CHECK_OK(bk_scene_load_file(scene, at("scene/a.obj"), &params, NULL, NULL, NULL));
    bk_scene_release(scene);
}

/* ---- Progress, cancelling, memory ---- */

typedef struct {
    int calls;
    int cancel_at;
    double cancelled;
    float fraction;
    int fell;
    bk_scene *scene;
} Progress;

static int32_t on_progress(void *user, float fraction, const char *stage) {
    Progress *p = user;
    (void)stage;
    p->fell += fraction < p->fraction;
    p->fraction = fraction;
    if (p->scene != NULL) {
        CHECK_ERROR(bk_scene_load_file(p->scene, at("scene/a.obj"), NULL, NULL, NULL, NULL), BK_ERROR_INVALID_STATE,
                    "callback");
    }
    if (++p->calls != p->cancel_at) return 1;
    p->cancelled = now();
    return 0;
}

/* 12 MB of vertices and faces. */
static void write_large_obj(const char *name) {
    FILE *file = fopen(at(name), "wb");
    int i;
    CHECK(file != NULL);
    if (file == NULL) return;
    for (i = 0; i < 200000; i++) fprintf(file, "v %d.5 %d.25 0\nvn 0 0 1\nvt 0.%d 0.5\n", i, i % 7, i);
    for (i = 0; i + 2 < 200000; i++) {
        fprintf(file, "f %d/%d/%d %d/%d/%d %d/%d/%d\n", i + 1, i + 1, i + 1, i + 2, i + 2, i + 2, i + 3, i + 3, i + 3);
    }
    fclose(file);
}

static int64_t held = 0, most = 0, limit = INT64_MAX;

static int32_t on_memory(void *user, int64_t bytes) {
    (void)user;
    if (bytes > 0 && held + bytes > limit) return 0;
    held += bytes;
    if (held > most) most = held;
    return 1;
}

static void progress_and_memory(void) {
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_scene *scene;
    Progress p;
    int k;

    bk_device_desc_init(&desc);
    desc.memory = on_memory;
    desc.num_threads = 1;
    CHECK_OK(bk_device_create(&desc, &device));
    write_large_obj("scene/large.obj");
    scene = new_scene(device);

    memset(&p, 0, sizeof p);
    p.scene = scene;
    CHECK_OK(bk_scene_load_file(scene, at("scene/large.obj"), NULL, on_progress, &p, NULL));
    CHECK(p.calls >= 2 && p.fell == 0 && p.fraction == 1.0f);
    CHECK(bk_scene_mesh_count(scene) == 1);
    /* Positions, normals and coordinates alone are 6 MB, in the file's arrays and in the mesh's. */
    CHECK(most > 10 << 20);

    for (k = 1; k <= 2; k++) {
        memset(&p, 0, sizeof p);
        p.cancel_at = k;
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/large.obj"), NULL, on_progress, &p, NULL), BK_ERROR_CANCELLED,
                    "cancelled");
        printf("cancelled at report %d: returned after %.1f ms\n", k, 1e3 * (now() - p.cancelled));
        CHECK(bk_scene_mesh_count(scene) == 1);
    }
    /* Every refusal is an error and loses nothing. */
    for (limit = held + (1 << 20); limit < most; limit += 3 << 20) {
        CHECK_ERROR(bk_scene_load_file(scene, at("scene/large.obj"), NULL, NULL, NULL, NULL), BK_ERROR_OUT_OF_MEMORY,
                    "refused");
        CHECK(bk_scene_mesh_count(scene) == 1);
    }
    limit = INT64_MAX;
    bk_scene_release(scene);
    bk_device_release(device);
    CHECK(held == 0);
}

/* ---- Saving ---- */

/* A baked floor under a sun of this irradiance, with pages of 64 texels. */
static bk_lightmap *baked(bk_device *device, float sun) {
    static const float positions[] = {0, 0, 0, 4, 0, 0, 4, 0, -4, 0, 0, -4};
    static const float uvs[] = {0, 0, 1, 0, 1, 1, 0, 1};
    static const uint32_t indices[] = {0, 1, 2, 0, 2, 3};
    static const unsigned char texels[] = {255, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 255, 255, 255, 255, 255};
    bk_scene *scene = new_scene(device);
    bk_texture_desc texture;
    bk_material_desc material;
    bk_mesh_desc mesh;
    bk_light_desc light;
    bk_lightmap *lightmap;
    bk_texture_desc_init(&texture);
    texture.width = texture.height = 2;
    texture.data = texels;
    bk_material_desc_init(&material);
    CHECK_OK(bk_scene_add_texture(scene, &texture, &material.albedo_texture));
    CHECK_OK(bk_scene_add_material(scene, &material, NULL));
    bk_mesh_desc_init(&mesh);
    mesh.positions = positions;
    mesh.vertex_count = 4;
    mesh.indices = indices;
    mesh.triangle_count = 2;
    mesh.uvs = uvs;
    CHECK_OK(bk_scene_add_mesh(scene, &mesh, NULL));
    bk_light_desc_init(&light);
    light.type = BK_LIGHT_DIRECTIONAL;
    light.direction[1] = -1;
    light.color[0] = light.color[1] = light.color[2] = sun;
    CHECK_OK(bk_scene_add_light(scene, &light, NULL));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    lightmap = small_lightmap(scene, 64);
    CHECK_OK(bk_bake(lightmap, NULL, NULL, NULL, NULL));
    bk_scene_release(scene);
    return lightmap;
}

static char *read_all(const char *name, long *size) {
    FILE *file = fopen(at(name), "rb");
    char *bytes = NULL;
    *size = size_of(name);
    if (file != NULL && *size >= 0) {
        bytes = malloc((size_t)*size + 1);
        if (bytes != NULL && fread(bytes, 1, (size_t)*size, file) != (size_t)*size) *size = -2;
    }
    if (file != NULL) fclose(file);
    return bytes;
}

static int same_bytes(const char *name, const char *bytes, long size) {
    long found;
    char *now_there = read_all(name, &found);
    int same = now_there != NULL && found == size && memcmp(now_there, bytes, (size_t)size) == 0;
    free(now_there);
    return same;
}

static void full_disks(bk_lightmap *lightmap, bk_lightmap *other) {
    static const char *names[] = {"save/page0-combined.exr", "save/page0-combined.png", "save/scene.glb"};
    uint32_t format;
    signal(SIGXFSZ, SIG_IGN);
    mkdir(at("save"), 0755);
    for (format = BK_FILE_EXR; format <= BK_FILE_GLB; format++) {
        const char *name = names[format - 1];
        long size, room[3];
        int k;
        char *old;
        CHECK_OK(bk_lightmap_save(lightmap, at("save/"), format, NULL, NULL));
        old = read_all(name, &size);
        CHECK(old != NULL && size > 20);
        room[0] = 0, room[1] = 10, room[2] = size / 2;
        for (k = 0; old != NULL && k < 3; k++) {
            limit_files((rlim_t)room[k]);
            CHECK_ERROR(bk_lightmap_save(other, at("save/"), format, NULL, NULL), BK_ERROR_IO, "save/");
            limit_files(RLIM_INFINITY);
            CHECK(same_bytes(name, old, size));
            CHECK(!has_part("save"));
        }
        free(old);
    }
    CHECK_ERROR(bk_lightmap_save(lightmap, at("nowhere/"), BK_FILE_GLB, NULL, NULL), BK_ERROR_IO, "nowhere/scene.glb");
}

static void cancelled_saves(bk_lightmap *lightmap, bk_lightmap *other) {
    static const char *names[] = {"page0-combined.exr", "page0-combined.png", "scene.glb"};
    uint32_t format;
    mkdir(at("save/other"), 0755);
    for (format = BK_FILE_EXR; format <= BK_FILE_GLB; format++) {
        char name[64], other_name[64];
        long size, other_size;
        char *old, *new;
        int tries, cancelled = 0;
        Progress p;
        snprintf(name, sizeof name, "save/%s", names[format - 1]);
        snprintf(other_name, sizeof other_name, "save/other/%s", names[format - 1]);
        memset(&p, 0, sizeof p);
        CHECK_OK(bk_lightmap_save(lightmap, at("save/"), format, on_progress, &p));
        CHECK(p.calls >= 1 && p.fell == 0 && p.fraction == 1.0f);
        CHECK_OK(bk_lightmap_save(other, at("save/other/"), format, NULL, NULL));
        old = read_all(name, &size);
        new = read_all(other_name, &other_size);
        /* A save may be done before its first report is made. Whether or not, the file is whole. */
        for (tries = 0; tries < 100 && !cancelled; tries++) {
            bk_result result;
            memset(&p, 0, sizeof p);
            p.cancel_at = 1;
            result = bk_lightmap_save(other, at("save/"), format, on_progress, &p);
            CHECK(result == BK_OK || result == BK_ERROR_CANCELLED);
            cancelled = result == BK_ERROR_CANCELLED;
            CHECK(same_bytes(name, old, size) || same_bytes(name, new, other_size));
            CHECK(!has_part("save"));
        }
        CHECK(cancelled);
        free(old);
        free(new);
    }
}

/* A process that saves again and again is killed at odd moments: the file is one of the two that it writes. (No other
 * thread runs when it forks, and it makes its own device.) */
static void killed_saves(void) {
    char *contents[2] = {NULL, NULL};
    long sizes[2] = {0, 0};
    int k, kills = 20, left = 0;
    mkdir(at("kill"), 0755);
    for (k = 0; k < kills; k++) {
        int ready[2], status;
        char byte;
        pid_t child;
        CHECK(pipe(ready) == 0);
        fflush(stdout);
        child = fork();
        CHECK(child >= 0);
        if (child == 0) {
            bk_device *device = NULL;
            bk_lightmap *two[2];
            int i;
            bk_device_create(NULL, &device);
            two[0] = baked(device, 1.0f);
            two[1] = baked(device, 3.0f);
            if (k == 0) {
                bk_lightmap_save(two[1], at("kill/b-"), BK_FILE_GLB, NULL, NULL);
                bk_lightmap_save(two[0], at("kill/a-"), BK_FILE_GLB, NULL, NULL);
            }
            bk_lightmap_save(two[0], at("kill/"), BK_FILE_GLB, NULL, NULL);
            if (write(ready[1], "x", 1) != 1) _exit(1);
            for (i = 1;; i++) bk_lightmap_save(two[i % 2], at("kill/"), BK_FILE_GLB, NULL, NULL);
        }
        CHECK(read(ready[0], &byte, 1) == 1);
        {
            struct timespec pause;
            pause.tv_sec = 0;
            pause.tv_nsec = 1000000L * (1 + k * 7 % 23);
            nanosleep(&pause, NULL);
        }
        kill(child, SIGKILL);
        CHECK(waitpid(child, &status, 0) == child && WIFSIGNALED(status));
        close(ready[0]);
        close(ready[1]);
        if (k == 0) {
            contents[0] = read_all("kill/a-scene.glb", &sizes[0]);
            contents[1] = read_all("kill/b-scene.glb", &sizes[1]);
            CHECK(contents[0] != NULL && contents[1] != NULL);
        }
        CHECK(same_bytes("kill/scene.glb", contents[0], sizes[0]) || same_bytes("kill/scene.glb", contents[1], sizes[1]));
        left += has_part("kill");
    }
    printf("%d kills: the old or the new file each time; %d left a file beside\n", kills, left);
    free(contents[0]);
    free(contents[1]);
}

/* What a kill left beside is written over by the next save and gone. */
static void clean_up(bk_lightmap *lightmap) {
    write_text("kill/scene.glb.part", "left by a kill");
    CHECK_OK(bk_lightmap_save(lightmap, at("kill/"), BK_FILE_GLB, NULL, NULL));
    CHECK(!has_part("kill"));
}

/* The scene with its light map keeps the texture of its material. */
static void saved_scene(bk_device *device) {
    bk_scene *scene = new_scene(device);
    bk_load_info info;
    bk_load_info_init(&info);
    CHECK_OK(bk_scene_load_file(scene, at("kill/scene.glb"), NULL, NULL, NULL, &info));
    CHECK(info.textures == 1 && info.triangles == 2);
    bk_scene_release(scene);
}

int main(int argc, char **argv) {
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_lightmap *lightmap, *other;
    snprintf(folder, sizeof folder, "%s", argc > 1 ? argv[1] : "");
    /* A FIFO that is waited for or a device that is read to its end would take for ever. */
    alarm(600);
    /* First, while this process has one thread. */
    killed_saves();

    bk_device_desc_init(&desc);
    desc.log = on_log;
    CHECK_OK(bk_device_create(&desc, &device));
    named_files(device);
    limits(device);
    progress_and_memory();
    lightmap = baked(device, 1.0f);
    other = baked(device, 3.0f);
    full_disks(lightmap, other);
    cancelled_saves(lightmap, other);
    clean_up(lightmap);
    saved_scene(device);
    bk_lightmap_release(lightmap);
    bk_lightmap_release(other);
    bk_device_release(device);
    return check_report("files");
}
