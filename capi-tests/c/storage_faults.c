/* What fails beneath a bake: disks that are full, files that change while they are mapped, processes that are killed,
 * memory that is taken away in the middle. Each ends with an error that says so, or with the process, and what was
 * finished is kept: the next call goes on and ends with the bits of an undisturbed bake. POSIX.
 *
 *     storage_faults FOLDER/
 *
 * Small disks are mounted in FOLDER where that is allowed (Linux, root), else files alone are limited. For what may end a
 * process it starts itself again:
 *     storage_faults FOLDER/ bake FAULT PLACE */
#ifdef __linux__
#define _GNU_SOURCE
#include <sys/mount.h>
#else
#define _XOPEN_SOURCE 700
#endif
#include "check.h"
#include "limit_files.h"
#include <dirent.h>
#include <fcntl.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define IO BK_ERROR_IO
#define NO_MEMORY BK_ERROR_OUT_OF_MEMORY
#define PAGE 128

static const char *program, *folder;

/* A path in the folder; one of four buffers. */
static const char *at(const char *name) {
    static char paths[4][1024];
    static int next;
    next = (next + 1) % 4;
    snprintf(paths[next], sizeof paths[next], "%s%s", folder, name);
    return paths[next];
}

/* Number of files in a folder, and of unfinished ones, whose names end with .part. */
static int files_in(const char *path, int *unfinished) {
    DIR *dir = opendir(path);
    struct dirent *entry;
    int count = 0;
    *unfinished = 0;
    while (dir && (entry = readdir(dir)) != NULL) {
        size_t length = strlen(entry->d_name);
        if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0) continue;
        count++;
        *unfinished += length > 5 && strcmp(entry->d_name + length - 5, ".part") == 0;
    }
    if (dir) closedir(dir);
    return count;
}

/* An empty folder. */
static void fresh(const char *path) {
    DIR *dir;
    struct dirent *entry;
    mkdir(path, 0755);
    dir = opendir(path);
    CHECK(dir != NULL);
    while (dir && (entry = readdir(dir)) != NULL) {
        char name[1400];
        snprintf(name, sizeof name, "%s/%s", path, entry->d_name);
        if (entry->d_name[0] != '.') remove(name);
    }
    if (dir) closedir(dir);
}

static long size_of(const char *path) {
    struct stat info;
    return stat(path, &info) == 0 ? (long)info.st_size : -1;
}

static unsigned char *read_all(const char *path, long *size) {
    FILE *file = fopen(path, "rb");
    unsigned char *bytes = NULL;
    *size = size_of(path);
    if (file && *size >= 0) {
        bytes = malloc((size_t)*size + 1);
        if (bytes && fread(bytes, 1, (size_t)*size, file) != (size_t)*size) *size = -2;
    }
    if (file) fclose(file);
    return bytes;
}

/* Writes to a file in place, and leaves its length. */
static void put(const char *path, const void *bytes, long size, long place) {
    int file = open(path, O_WRONLY);
    CHECK(file >= 0 && pwrite(file, bytes, (size_t)size, (off_t)place) == (ssize_t)size);
    if (file >= 0) close(file);
}

static void flip(const char *path, long place) {
    long size;
    unsigned char *bytes = read_all(path, &size);
    CHECK(bytes && place < size);
    if (bytes && place < size) {
        bytes[place] ^= 0x10;
        put(path, bytes + place, 1, place);
    }
    free(bytes);
}

static int same_files(const char *a, const char *b) {
    long n, m;
    unsigned char *x = read_all(a, &n), *y = read_all(b, &m);
    int same = x && y && n >= 0 && n == m && memcmp(x, y, (size_t)n) == 0;
    free(x);
    free(y);
    return same;
}

/* ---- Scenes and bakes ---- */

/* Memory that the device's callback grants. */
static int64_t held, most;

static int32_t memory(void *user, int64_t change) {
    int64_t now = __atomic_add_fetch(&held, change, __ATOMIC_SEQ_CST);
    (void)user;
    if (change > 0 && now > __atomic_load_n(&most, __ATOMIC_SEQ_CST)) {
        __atomic_sub_fetch(&held, change, __ATOMIC_SEQ_CST);
        return 0;
    }
    return 1;
}

static bk_device *device_with(const char *scratch) {
    bk_device *device = NULL;
    bk_device_desc desc;
    bk_device_desc_init(&desc);
    desc.num_threads = 2;
    desc.scratch_folder = scratch;
    desc.memory = memory;
    most = INT64_MAX;
    CHECK_OK(bk_device_create(&desc, &device));
    return device;
}

static bk_scene *committed(bk_device *device, const char *name) {
    bk_scene *scene = NULL;
    CHECK_OK(bk_scene_create(device, &scene));
    CHECK_OK(bk_scene_load_builtin(scene, name));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    return scene;
}

/* A mapped scene, whose rays wait at parts of the tree. */
static bk_scene *mapped(bk_device *device, const char *path) {
    bk_scene *scene = NULL;
    bk_open_params params;
    CHECK_OK(bk_scene_create(device, &scene));
    bk_open_params_init(&params);
    params.ray_queues = 1;
    CHECK_OK(bk_scene_open(scene, path, &params, NULL, NULL));
    return scene;
}

static bk_bake_params quick(const char *checkpoint) {
    bk_bake_params params;
    bk_bake_params_init(&params);
    params.photon_count = 5000;
    params.gather_rays = 16;
    params.direct_samples = 2;
    params.checkpoint = checkpoint;
    params.checkpoint_seconds = 0.0f;
    return params;
}

static int same_light(const bk_lightmap *a, const bk_lightmap *b) {
    size_t size = PAGE * PAGE * 3 * sizeof(float);
    float *x = malloc(size), *y = malloc(size);
    int same = 0;
    if (x && y) {
        CHECK_OK(bk_lightmap_read(a, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, x, 0));
        CHECK_OK(bk_lightmap_read(b, 0, BK_LAYER_COMBINED, BK_FORMAT_RGB32F, y, 0));
        same = memcmp(x, y, size) == 0;
    }
    free(x);
    free(y);
    return same;
}

/* ---- Full disks ---- */

/* Mounts a disk of so many bytes in the folder; whether that is allowed. */
static int mounted(const char *path, const char *bytes) {
#ifdef __linux__
    char size[64];
    snprintf(size, sizeof size, "size=%s", bytes);
    mkdir(path, 0755);
    return mount("tmpfs", path, "tmpfs", 0, size) == 0;
#else
    (void)path, (void)bytes;
    return 0;
#endif
}

static long used_on(const char *path) {
    struct statvfs disk;
    CHECK(statvfs(path, &disk) == 0);
    return (long)(disk.f_blocks - disk.f_bfree) * (long)disk.f_frsize;
}

static void resize_disk(const char *path, const char *bytes) {
#ifdef __linux__
    char size[64];
    snprintf(size, sizeof size, "size=%s", bytes);
    CHECK(mount("tmpfs", path, "tmpfs", MS_REMOUNT, size) == 0);
#else
    (void)path, (void)bytes;
#endif
}

/* Shrinks or grows the disk so that so many megabytes are free. */
static void leave_room(const char *path, long megabytes) {
    char bytes[64];
    snprintf(bytes, sizeof bytes, "%ldm", (used_on(path) >> 20) + megabytes);
    resize_disk(path, bytes);
}

static void unmounted(const char *path) {
#ifdef __linux__
    CHECK(umount(path) == 0);
#else
    (void)path;
#endif
}

static void scratch_files_on_a_full_disk(void) {
    bk_device *device = device_with(at("scratch")), *plain = device_with(NULL);
    bk_scene *scene = NULL, *same = committed(plain, "hall:100000");
    bk_lightmap *lightmap = NULL, *expected = NULL;
    bk_lightmap_desc desc;
    bk_bake_params params = quick(NULL);
    int unfinished;
    /* Meshes and trees lie in them, too. What cannot be loaded or committed stays as it is. */
    CHECK_OK(bk_scene_create(device, &scene));
    CHECK_ERROR(bk_scene_load_builtin(scene, "hall:100000"), IO, "scratch file");
    mkdir(at("scratch"), 0755);
    limit_files(1 << 20);
    CHECK_ERROR(bk_scene_load_builtin(scene, "hall:100000"), IO, "scratch file");
    limit_files(RLIM_INFINITY);
    CHECK_OK(bk_scene_load_builtin(scene, "hall:100000"));
    limit_files(1 << 20);
    CHECK_ERROR(bk_scene_commit(scene, NULL, NULL), IO, "scratch file");
    limit_files(RLIM_INFINITY);
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    bk_lightmap_desc_init(&desc);
    desc.page_size = PAGE;
    desc.texels_per_unit = 0.5f;
    if (mounted(at("disk"), "30m")) {
        bk_device *small = device_with(at("disk"));
        bk_scene *hall = NULL;
        CHECK_OK(bk_scene_create(small, &hall));
        /* There is room for some of what they need, at most. */
        CHECK_ERROR(bk_scene_load_builtin(hall, "hall:1000000"), IO, "scratch file");
        CHECK(files_in(at("disk"), &unfinished) == 0);
        resize_disk(at("disk"), "250m");
        CHECK_OK(bk_scene_load_builtin(hall, "hall:1000000"));
        leave_room(at("disk"), 80);
        CHECK_ERROR(bk_scene_commit(hall, NULL, NULL), IO, "scratch file");
        resize_disk(at("disk"), "250m");
        CHECK_OK(bk_scene_commit(hall, NULL, NULL));
        /* Room that the commit needed is free again. */
        leave_room(at("disk"), 20);
        CHECK_ERROR(bk_lightmap_create(hall, &desc, NULL, NULL, &lightmap), IO, "scratch file");
        CHECK(lightmap == NULL && files_in(at("disk"), &unfinished) == 0);
        resize_disk(at("disk"), "750m");
        CHECK_OK(bk_lightmap_create(hall, &desc, NULL, NULL, &lightmap));
        bk_lightmap_release(lightmap);
        bk_scene_release(hall);
        bk_device_release(small);
        unmounted(at("disk"));
    } else {
        puts("no small disk could be mounted: scratch files that fill it later are left out");
    }
    /* What failed can be done again. */
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    CHECK_OK(bk_lightmap_create(same, &desc, NULL, NULL, &expected));
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    CHECK_OK(bk_bake(expected, &params, NULL, NULL, NULL));
    CHECK(same_light(lightmap, expected));
    CHECK(files_in(at("scratch"), &unfinished) == 0);
    bk_lightmap_release(lightmap);
    bk_lightmap_release(expected);
    bk_scene_release(scene);
    bk_scene_release(same);
    bk_device_release(device);
    bk_device_release(plain);
}

static void scene_files_and_shares_on_a_full_disk(void) {
    bk_device *device = device_with(NULL);
    bk_scene *scene = committed(device, "cornell"), *other = committed(device, "hall:20000");
    bk_lightmap *lightmap = small_lightmap(scene, PAGE);
    bk_bake_params params = quick(NULL);
    char prefix[1024];
    uint32_t stage;
    long size, whole;
    int k, unfinished;
    unsigned char *old;
    fresh(at("full"));
    CHECK_OK(bk_scene_save(other, at("full/whole.bkscene"), NULL, NULL));
    whole = size_of(at("full/whole.bkscene"));
    remove(at("full/whole.bkscene"));
    CHECK_OK(bk_scene_save(scene, at("full/room.bkscene"), NULL, NULL));
    old = read_all(at("full/room.bkscene"), &size);
    for (k = 0; k < 8; k++) {
        long now;
        unsigned char *there;
        limit_files((rlim_t)(whole * k / 8 + (k == 7 ? whole / 8 - 1 : 0)));
        CHECK_ERROR(bk_scene_save(other, at("full/room.bkscene"), NULL, NULL), IO, "room.bkscene");
        limit_files(RLIM_INFINITY);
        there = read_all(at("full/room.bkscene"), &now);
        CHECK(old && there && now == size && memcmp(old, there, (size_t)size) == 0);
        free(there);
        CHECK(files_in(at("full"), &unfinished) == 1 && unfinished == 0);
    }
    free(old);
    remove(at("full/room.bkscene"));

    snprintf(prefix, sizeof prefix, "%s", at("full/share-"));
    params.shares = prefix;
    params.share_count = 1;
    for (stage = BK_SHARE_PHOTONS; stage <= BK_SHARE_RADIANCE; stage++) {
        for (k = 0; k < 4; k++) {
            limit_files((rlim_t)(2000 * k));
            CHECK_ERROR(bk_bake_share(lightmap, &params, stage, 0, NULL, NULL, NULL), IO, "share-");
            limit_files(RLIM_INFINITY);
            CHECK(files_in(at("full"), &unfinished) == (int)stage);
        }
        CHECK_OK(bk_bake_share(lightmap, &params, stage, 0, NULL, NULL, NULL));
    }
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
    bk_scene_release(other);
    bk_device_release(device);
}

static void pages_on_a_full_disk(void) {
    bk_device *device = device_with(NULL);
    bk_scene *scene = committed(device, "cornell");
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;
    bk_lightmap_info info;
    bk_bake_params params = quick(NULL);
    static const char *layers[] = {"combined", "indirect", "direct", "radiance"};
    uint32_t page, layer;
    int unfinished, before, all;
    bk_lightmap_desc_init(&desc);
    desc.page_size = 64;
    desc.texels_per_unit = 64.0f;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    bk_lightmap_info_init(&info);
    CHECK_OK(bk_lightmap_get_info(lightmap, &info));
    CHECK(info.page_count >= 4);
    params.gather_rays = 4;
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    fresh(at("pages"));
    CHECK_OK(bk_lightmap_save(lightmap, at("pages/"), BK_FILE_EXR, NULL, NULL));
    all = files_in(at("pages"), &unfinished);
    if (mounted(at("disk"), "100k")) {
        CHECK_ERROR(bk_lightmap_save(lightmap, at("disk/"), BK_FILE_EXR, NULL, NULL), IO, "disk/page");
        before = files_in(at("disk"), &unfinished);
        CHECK(before > 0 && before < all && unfinished == 0);
        resize_disk(at("disk"), "100m");
        for (page = 0; page < info.page_count; page++) {
            for (layer = 0; layer < 4; layer++) {
                char name[2][64];
                snprintf(name[0], sizeof name[0], "pages/page%u-%s.exr", page, layers[layer]);
                snprintf(name[1], sizeof name[1], "disk/page%u-%s.exr", page, layers[layer]);
                /* What is there is whole. */
                if (size_of(at(name[1])) >= 0) {
                    before--;
                    CHECK(same_files(at(name[0]), at(name[1])));
                }
            }
        }
        CHECK(before == 0);
        CHECK_OK(bk_lightmap_save(lightmap, at("disk/"), BK_FILE_EXR, NULL, NULL));
        CHECK(files_in(at("disk"), &unfinished) == all);
        unmounted(at("disk"));
    } else {
        puts("no small disk could be mounted: pages that fill it are left out");
    }
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
    bk_device_release(device);
}

/* ---- Mapped files that change ---- */

static void a_mapped_file_that_changes_is_noticed(void) {
    bk_device *device = device_with(NULL);
    bk_scene *scene = committed(device, "cornell"), *opened, *again = NULL;
    bk_lightmap *lightmap, *expected = small_lightmap(scene, PAGE);
    bk_photon_map *photons = NULL;
    bk_bake_params params = quick(NULL);
    char prefix[1024], name[1024];
    long size, saved;
    unsigned char *bytes;
    snprintf(name, sizeof name, "%s", at("room.bkscene"));
    snprintf(prefix, sizeof prefix, "%s", at("changed-"));
    CHECK_OK(bk_scene_save(scene, name, NULL, NULL));
    CHECK_OK(bk_bake(expected, &params, NULL, NULL, NULL));
    bytes = read_all(name, &size);
    opened = mapped(device, name);
    lightmap = small_lightmap(opened, PAGE);
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    CHECK_OK(bk_scene_save(opened, at("copy.bkscene"), NULL, NULL));
    saved = size_of(at("copy.bkscene"));
    /* Each call looks first, and reads nothing of it. */
    flip(name, size - 20);
    params.seed = 5;
    CHECK_ERROR(bk_bake(lightmap, &params, NULL, NULL, NULL), IO, "was changed");
    CHECK(same_light(lightmap, expected));
    params.shares = prefix;
    params.share_count = 1;
    CHECK_ERROR(bk_bake_share(lightmap, &params, BK_SHARE_PHOTONS, 0, NULL, NULL, NULL), IO, "was changed");
    CHECK_ERROR(bk_photon_map_create(opened, NULL, NULL, NULL, &photons), IO, "was changed");
    CHECK_ERROR(bk_scene_save(opened, at("copy.bkscene"), NULL, NULL), IO, "was changed");
    CHECK(size_of(at("copy.bkscene")) == saved);
    /* As it is, it is refused; as it was, it serves. */
    CHECK_OK(bk_scene_create(device, &again));
    CHECK_ERROR(bk_scene_open(again, name, NULL, NULL, NULL), IO, "damaged");
    put(name, bytes, size, 0);
    CHECK_OK(bk_scene_open(again, name, NULL, NULL, NULL));
    free(bytes);
    bk_lightmap_release(lightmap);
    lightmap = small_lightmap(again, PAGE);
    params = quick(NULL);
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    CHECK(same_light(lightmap, expected));
    bk_lightmap_release(lightmap);
    bk_lightmap_release(expected);
    bk_scene_release(opened);
    bk_scene_release(again);
    bk_scene_release(scene);
    bk_device_release(device);
}

/* What happens to the file of the scene in the middle of a bake of the process that is started. */
enum { NOTHING, FLIP, CUT };

static struct {
    int fault;
    long place;
    float when;
} fault;

static int32_t strike(void *user, float fraction, const char *stage) {
    (void)user, (void)stage;
    if (fault.fault != NOTHING && fraction >= fault.when) {
        if (fault.fault == FLIP) flip(at("hall.bkscene"), fault.place);
        if (fault.fault == CUT) CHECK(truncate(at("hall.bkscene"), (off_t)fault.place) == 0);
        fault.fault = NOTHING;
    }
    return 1;
}

/* Ends with 0 after a bake, 3 if a changed file was noticed, 1 after any other error. */
static int bake(int what, long place) {
    bk_device *device = device_with(at("scratch"));
    bk_scene *scene = mapped(device, at("hall.bkscene"));
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;
    bk_bake_params params = quick(at("checkpoint"));
    bk_result result;
    /* Wrong trees may have loops. */
    alarm(60);
    bk_lightmap_desc_init(&desc);
    desc.page_size = 256;
    desc.texels_per_unit = 2.0f;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    fault.fault = what;
    fault.place = place;
    fault.when = 0.35f + 0.1f * (float)(place % 5);
    result = bk_bake(lightmap, &params, strike, NULL, NULL);
    if (result == IO && strstr(bk_last_error(), "was changed")) return 3;
    CHECK_OK(result);
    if (result == BK_OK) CHECK_OK(bk_lightmap_save_result(lightmap, at("light"), NULL, NULL));
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
    bk_device_release(device);
    return checks_failed == 0 ? 0 : 1;
}

static pid_t start(int what, long place) {
    char text[2][32];
    pid_t child;
    snprintf(text[0], sizeof text[0], "%d", what);
    snprintf(text[1], sizeof text[1], "%ld", place);
    child = fork();
    if (child == 0) {
        execl(program, program, folder, "bake", text[0], text[1], (char *)NULL);
        _exit(127);
    }
    return child;
}

static int status_of(pid_t child) {
    int status = -1;
    CHECK(child > 0 && waitpid(child, &status, 0) == child);
    return status;
}

/* The process that damages its own scene in the middle of a bake ends with an error, or by a signal; the checkpoint is of
   use when the file is as it was. */
static void bakes_go_on_when_the_file_is_restored(void) {
    bk_device *device = device_with(NULL);
    bk_scene *scene = committed(device, "hall:30000");
    long size;
    unsigned char *bytes;
    int i, noticed = 0, signals = 0, with_work = 0, unfinished;
    const int flips = 9, cuts = 3;
    mkdir(at("scratch"), 0755);
    CHECK_OK(bk_scene_save(scene, at("hall.bkscene"), NULL, NULL));
    bk_scene_release(scene);
    bk_device_release(device);
    bytes = read_all(at("hall.bkscene"), &size);
    remove(at("checkpoint"));
    CHECK(status_of(start(NOTHING, 0)) == 0);
    CHECK(rename(at("light"), at("whole")) == 0);
    for (i = 0; i < flips + cuts; i++) {
        int status;
        long place = (long)((double)size * (i % flips + 0.5) / flips);
        remove(at("checkpoint"));
        remove(at("light"));
        status = status_of(start(i < flips ? FLIP : CUT, i < flips ? place : (i - flips) * size / cuts));
        CHECK(!(WIFSIGNALED(status) && WTERMSIG(status) == SIGALRM));
        CHECK(WIFSIGNALED(status) || WEXITSTATUS(status) == 3);
        noticed += WIFEXITED(status);
        signals += WIFSIGNALED(status);
        with_work += size_of(at("checkpoint")) > 1000;
        /* With the file as it is nothing begins. */
        CHECK(size_of(at("light")) == -1);
        CHECK(truncate(at("hall.bkscene"), (off_t)size) == 0);
        put(at("hall.bkscene"), bytes, size, 0);
        CHECK(status_of(start(NOTHING, 0)) == 0);
        CHECK(same_files(at("light"), at("whole")));
    }
    printf("%d flips and %d cuts of a mapped file: %d errors, %d signals, %d with work in the checkpoint\n", flips, cuts,
           noticed, signals, with_work);
    CHECK(with_work > 0);

    /* Killed, it leaves no scratch file, and the next one goes on. */
    for (i = 0; i < 4; i++) {
        struct timespec t = {0, 150000000};
        pid_t child;
        remove(at("checkpoint"));
        remove(at("light"));
        child = start(NOTHING, 0);
        t.tv_nsec += 200000000 * i;
        nanosleep(&t, NULL);
        kill(child, SIGKILL);
        status_of(child);
        CHECK(files_in(at("scratch"), &unfinished) == 0);
        CHECK(status_of(start(NOTHING, 0)) == 0);
        CHECK(same_files(at("light"), at("whole")));
    }
    free(bytes);
}

/* ---- Memory that is taken away ---- */

static float taken_at;

static int32_t take_memory(void *user, float fraction, const char *stage) {
    (void)user, (void)stage;
    if (fraction >= taken_at) {
        __atomic_store_n(&most, 0, __ATOMIC_SEQ_CST);
    }
    return 1;
}

static void memory_that_is_taken_away_in_the_middle(void) {
    bk_device *device = device_with(at("scratch"));
    bk_scene *scene = mapped(device, at("hall.bkscene"));
    bk_lightmap *lightmap = NULL, *expected = NULL;
    bk_lightmap_desc desc;
    bk_bake_params params = quick(NULL);
    int i, failures = 0, with_work = 0;
    bk_lightmap_desc_init(&desc);
    desc.page_size = PAGE;
    desc.texels_per_unit = 1.0f;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &expected));
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    CHECK_OK(bk_bake(expected, &params, NULL, NULL, NULL));
    for (i = 0; i < 20; i++) {
        bk_result result;
        params = quick(at("small-checkpoint"));
        remove(params.checkpoint);
        taken_at = 0.05f * (float)i;
        result = bk_bake(lightmap, &params, take_memory, NULL, NULL);
        most = INT64_MAX;
        CHECK(result == BK_OK || result == NO_MEMORY);
        failures += result == NO_MEMORY;
        with_work += result == NO_MEMORY && size_of(params.checkpoint) > 1000;
        /* Nor does a smaller budget do, which says what is needed. */
        params.memory_budget = 1000;
        CHECK_ERROR(bk_bake(lightmap, &params, NULL, NULL, NULL), NO_MEMORY, "memory_budget");
        params.memory_budget = 0;
        CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
        CHECK(same_light(lightmap, expected));
    }
    printf("memory taken away at 20 places: %d errors, %d with work in the checkpoint\n", failures, with_work);
    CHECK(failures > 0);
    bk_lightmap_release(lightmap);
    bk_lightmap_release(expected);
    bk_scene_release(scene);
    bk_device_release(device);
    CHECK(held == 0);
}

int main(int argc, char **argv) {
    program = argv[0];
    folder = argc > 1 ? argv[1] : "";
    signal(SIGXFSZ, SIG_IGN);
    if (argc == 5 && strcmp(argv[2], "bake") == 0) {
        return bake(atoi(argv[3]), atol(argv[4]));
    }
    scratch_files_on_a_full_disk();
    scene_files_and_shares_on_a_full_disk();
    pages_on_a_full_disk();
    a_mapped_file_that_changes_is_noticed();
    bakes_go_on_when_the_file_is_restored();
    memory_that_is_taken_away_in_the_middle();
    return check_report("storage_faults");
}
