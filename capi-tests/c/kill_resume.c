/* A bake with a checkpoint is killed at random moments and goes on: it must end with the bits of a bake without a
 * break. POSIX.
 *
 *     kill_resume FOLDER/ [ROUNDS [SEED]]
 *
 * Each round begins a bake anew, kills it one to three times and lets it end. 100 rounds take about five minutes. Also,
 * the checkpoint of a bake that may write little (as on a full disk) must be of use to the next one.
 *
 * The process that kills never calls the library; it starts itself again to bake:
 *     kill_resume bake CHECKPOINT RESULT SECONDS LIMIT */
#define _XOPEN_SOURCE 700
#include "check.h"
#include <signal.h>
#include <stdlib.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static const char *program;

static void log_message(void *user, uint32_t level, const char *message) {
    (void)user;
    (void)level;
    fprintf(stderr, "[log] %s\n", message);
}

/* ---- The process that bakes ---- */

static int bake(const char *checkpoint, const char *result, double seconds, long limit) {
    bk_device *device = NULL;
    bk_scene *scene = NULL;
    bk_lightmap *lightmap = NULL;
    bk_device_desc device_desc;
    bk_lightmap_desc desc;
    bk_bake_params params;

    bk_device_desc_init(&device_desc);
    device_desc.num_threads = 2;
    device_desc.log = limit > 0 ? log_message : NULL;
    CHECK_OK(bk_device_create(&device_desc, &device));
    CHECK_OK(bk_scene_create(device, &scene));
    CHECK_OK(bk_scene_load_builtin(scene, "cornell"));
    CHECK_OK(bk_scene_commit(scene, NULL, NULL));
    bk_lightmap_desc_init(&desc);
    desc.page_size = 256;
    desc.texels_per_unit = 50.0f;
    desc.gather_divisor = 2;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    bk_bake_params_init(&params);
    params.photon_count = 10000;
    params.direct_samples = 4;
    params.checkpoint = checkpoint;
    params.checkpoint_seconds = (float)seconds;
    if (limit > 0) {
        /* Every write beyond it fails. */
        struct rlimit files;
        files.rlim_cur = files.rlim_max = (rlim_t)limit;
        signal(SIGXFSZ, SIG_IGN);
        CHECK(setrlimit(RLIMIT_FSIZE, &files) == 0);
    }
    CHECK_OK(bk_bake(lightmap, &params, NULL, NULL, NULL));
    if (limit == 0) CHECK_OK(bk_lightmap_save_result(lightmap, result, NULL, NULL));
    bk_lightmap_release(lightmap);
    bk_scene_release(scene);
    bk_device_release(device);
    return checks_failed == 0 ? 0 : 1;
}

/* ---- The process that kills ---- */

static uint64_t state = 1;

static double random_unit(void) {
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return (double)(state >> 11) / 9007199254740992.0;
}

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static pid_t start(const char *checkpoint, const char *result, double seconds, long limit) {
    char interval[32], most[32];
    pid_t child;
    snprintf(interval, sizeof interval, "%.3f", seconds);
    snprintf(most, sizeof most, "%ld", limit);
    child = fork();
    if (child == 0) {
        execl(program, program, "bake", checkpoint, result, interval, most, (char *)NULL);
        _exit(127);
    }
    return child;
}

/* Waits for the end; whether it was a success. */
static int ended(pid_t child) {
    int status = 1;
    return child > 0 && waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == 0;
}

/* Kills it after a while; whether that was before its end. */
static int killed(pid_t child, double seconds) {
    struct timespec t;
    int status = 0;
    t.tv_sec = (time_t)seconds;
    t.tv_nsec = (long)((seconds - (double)t.tv_sec) * 1e9);
    nanosleep(&t, NULL);
    kill(child, SIGKILL);
    return waitpid(child, &status, 0) == child && WIFSIGNALED(status);
}

static long size_of_file(const char *path) {
    struct stat info;
    return stat(path, &info) == 0 ? (long)info.st_size : -1;
}

static int same_files(const char *a, const char *b) {
    FILE *x = fopen(a, "rb"), *y = fopen(b, "rb");
    int p = 0, q = 0;
    while (x && y && p == q && p != EOF) {
        p = getc(x);
        q = getc(y);
    }
    if (x) fclose(x);
    if (y) fclose(y);
    return x && y && p == q;
}

int main(int argc, char **argv) {
    char whole[1024], result[1024], checkpoint[1024];
    int rounds = argc > 2 ? atoi(argv[2]) : 4, round, kills = 0, resumed = 0, with_work = 0;
    double seconds;
    long limit;

    program = argv[0];
    if (argc == 6 && strcmp(argv[1], "bake") == 0) {
        return bake(argv[2], argv[3], atof(argv[4]), atol(argv[5]));
    }
    if (argc < 2 || rounds < 1) return 2;
    if (argc > 3) state = (uint64_t)atol(argv[3]) * 2 + 1;
    snprintf(whole, sizeof whole, "%swhole.result", argv[1]);
    snprintf(result, sizeof result, "%sresumed.result", argv[1]);
    snprintf(checkpoint, sizeof checkpoint, "%scheckpoint", argv[1]);

    remove(checkpoint);
    seconds = now();
    CHECK(ended(start(checkpoint, whole, 10.0, 0)));
    seconds = now() - seconds;
    limit = size_of_file(checkpoint) / 2;
    CHECK(limit > 10000);

    for (round = 0; round < rounds; round++) {
        double interval = round % 3 == 2 ? 0.02 * seconds : 0.0;
        int kill_count = 1 + (int)(3.0 * random_unit()), i;
        remove(checkpoint);
        remove(result);
        for (i = 0; i < kill_count; i++) {
            /* Up to a little more than the bake takes: none of its moments is spared. */
            kills += killed(start(checkpoint, result, interval, 0), 1.1 * seconds * random_unit());
        }
        with_work += size_of_file(checkpoint) > 1000;
        remove(result);
        if (ended(start(checkpoint, result, interval, 0)) && same_files(whole, result)) resumed++;
    }
    printf("%d kills in %d rounds, %d with work in the checkpoint; %d ended with the bits of one bake\n", kills, rounds,
           with_work, resumed);
    CHECK(resumed == rounds);
    CHECK(rounds < 4 || (kills > 0 && with_work > 0));

    /* The disk is full when half is written: the bake ends well, and what is there is of use. */
    remove(checkpoint);
    remove(result);
    CHECK(ended(start(checkpoint, result, 0.0, limit)));
    CHECK(size_of_file(checkpoint) > limit / 2 && size_of_file(checkpoint) <= limit);
    CHECK(ended(start(checkpoint, result, 0.0, 0)) && same_files(whole, result));
    return check_report("kill_resume");
}
