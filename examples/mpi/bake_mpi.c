/*
 * One bake on many machines: each rank traces a share of the photons, fills a share of the radiance map and bakes a part
 * of the texels; rank 0 brings the parts together.
 *
 *     mpicc -O2 bake_mpi.c -lbakelite -lm -o bake_mpi
 *     mpirun -n 4 --enable-recovery bake_mpi FOLDER SCENE [TEXELS_PER_UNIT [THREADS]]
 *
 * FOLDER is one that all ranks see; SCENE is a built-in scene or a file, which gets a sun. Rank 0 builds and unwraps the
 * scene, and writes scene and layout; the others map and load them (ranks of one machine share the memory of the scene).
 * Each rank writes its photons and its radiance to FOLDER/...bkshare, from where the others read them, and the light of its
 * texels to FOLDER/part-K-of-N.light. When all are there, rank 0 writes pages to FOLDER/page...exr, which have the bits of
 * a bake on one machine.
 *
 * Rank 0 prints how far all ranks are. A file FOLDER/cancel, made by anybody, cancels the bake within a second or so on all
 * ranks, which end with code 3 (mpirun with 0 where it lets ranks be lost).
 * What is in the folder is not computed again: started anew after an interruption, the bake goes on with what is missing.
 * A rank that is lost (its beat stands still for STALL seconds) is replaced by rank 0, if mpirun lets the others go on
 * (Open MPI: --enable-recovery). See docs/guide.md, "Results, shards and checkpoints".
 */
#include <bakelite.h>
#include <math.h>
#include <mpi.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* Seconds without a sign of life after which a rank counts as lost; the environment variable BAKE_MPI_STALL. */
static double stall = 30.0;

enum { BEAT, STATE, DONE, CELLS }; /* what rank 0 keeps of each rank; DONE is thousandths of the present call */
enum { WORKING, LAID_OUT, PHOTONS, RADIANCE, TEXELS, ENDED, ENDED_WITHOUT_SOME };

static MPI_Win board;
static int rank, size;
static int *is_lost; /* of each rank, as far as rank 0 knows */
static char cancel_name[4096];

static void tell(int cell, int value)
{
    MPI_Win_lock(MPI_LOCK_SHARED, 0, 0, board);
    MPI_Accumulate(&value, 1, MPI_INT, 0, CELLS * rank + cell, 1, MPI_INT, cell == BEAT ? MPI_SUM : MPI_REPLACE, board);
    MPI_Win_unlock(0, board);
}

static void read_cells(int other, int *cells)
{
    MPI_Win_lock(MPI_LOCK_SHARED, 0, 0, board);
    MPI_Get_accumulate(NULL, 0, MPI_INT, cells, CELLS, MPI_INT, 0, CELLS * other, CELLS, MPI_INT, MPI_NO_OP, board);
    MPI_Win_unlock(0, board);
}

static int is_cancelled(void)
{
    FILE *file = fopen(cancel_name, "rb");
    if (file) {
        fclose(file);
    }
    return file != NULL;
}

/* Prints how far the ranks are with a stage, every two seconds at most. */
static void print_progress(const char *name, int stage)
{
    static double last = -1e9;
    double now = MPI_Wtime(), done = 0.0;
    int other;
    if (rank != 0 || now - last < 2.0) {
        return;
    }
    last = now;
    for (other = 0; other < size; other++) {
        int cells[CELLS];
        read_cells(other, cells);
        done += cells[STATE] >= stage ? 1.0 : cells[STATE] == stage - 1 ? 1e-3 * cells[DONE] : 0.0;
    }
    printf("%s: %.0f %% of all ranks\n", name, 100.0 * done / size);
    fflush(stdout);
}

static int stage_now = LAID_OUT;

static const char *stage_name(int stage)
{
    return stage == PHOTONS ? "photons" : stage == RADIANCE ? "radiance map" : stage == TEXELS ? "texels" : "layout";
}

/* A sign of life and a look for a cancel, twice a second at most. Called by the thread that called the library. */
static int32_t progress(void *user, float fraction, const char *stage)
{
    static double last = -1e9;
    double now = MPI_Wtime();
    (void)user, (void)stage;
    if (now - last > 0.5) {
        last = now;
        tell(BEAT, 1);
        tell(DONE, (int)(1000.0f * fraction));
        print_progress(stage_name(stage_now), stage_now);
        return !is_cancelled();
    }
    return 1;
}

/* Ends all ranks. Files are replaced as a whole, so that what is in the folder is whole. */
static void end_cancelled(void)
{
    printf("rank %d: cancelled; what is in the folder is kept\n", rank);
    fflush(stdout);
    MPI_Abort(MPI_COMM_WORLD, 3);
}

static void check(bk_result result, const char *what)
{
    if (result == BK_ERROR_CANCELLED) {
        end_cancelled();
    } else if (result != BK_OK) {
        fprintf(stderr, "rank %d: %s: %s\n", rank, what, bk_last_error());
        MPI_Abort(MPI_COMM_WORLD, 1);
    }
}

static void part_name(char *out, size_t capacity, const char *folder, int part)
{
    snprintf(out, capacity, "%s/part-%d-of-%d.light", folder, part, size);
}

/* The parameters of all shares and parts of the bake. One rank alone needs no shares. */
static void set_params(bk_bake_params *params, char *shares, size_t capacity, const char *folder)
{
    bk_bake_params_init(params);
    snprintf(shares, capacity, "%s/", folder);
    params->shares = size > 1 ? shares : NULL;
    params->share_count = (uint32_t)size;
}

/* Bakes a part and writes it, or loads it if the folder has it. */
static void bake_part(bk_lightmap *map, const char *folder, int part)
{
    char name[4096], shares[4096];
    bk_bake_params params;
    bk_lightmap_info info;
    bk_lightmap_info_init(&info);
    check(bk_lightmap_get_info(map, &info), "light map");
    set_params(&params, shares, sizeof shares, folder);
    params.texel_begin = info.texels * (uint64_t)part / (uint64_t)size;
    params.texel_end = info.texels * (uint64_t)(part + 1) / (uint64_t)size;
    part_name(name, sizeof name, folder, part);
    if (params.texel_begin == params.texel_end) {
        return; /* There are fewer texels than ranks. */
    }
    if (bk_lightmap_load_result(map, name, progress, NULL) == BK_OK) {
        return;
    }
    check(bk_bake(map, &params, progress, NULL, NULL), "bake");
    check(bk_lightmap_save_result(map, name, progress, NULL), "part");
}

/* Does a part of a stage. */
static void do_part(int stage, bk_lightmap *map, const char *folder, int part)
{
    char shares[4096];
    bk_bake_params params;
    if (stage == TEXELS) {
        bake_part(map, folder, part);
    } else if (size > 1) {
        uint32_t what = stage == PHOTONS ? BK_SHARE_PHOTONS : BK_SHARE_RADIANCE;
        set_params(&params, shares, sizeof shares, folder);
        check(bk_bake_share(map, &params, what, (uint32_t)part, progress, NULL, NULL), "share");
    }
}

/* Waits until a rank's state is at least this; returns it, or WORKING if the rank is lost (never of rank 0). */
static int wait_for(int other, int state)
{
    static const struct timespec pause = {0, 50000000};
    int cells[CELLS], beat = -1;
    double since = MPI_Wtime();
    for (;;) {
        read_cells(other, cells);
        if (cells[STATE] >= state) {
            return cells[STATE];
        }
        if (other == 0 || cells[BEAT] != beat) {
            beat = cells[BEAT];
            since = MPI_Wtime();
        } else if (MPI_Wtime() - since > stall) {
            return WORKING;
        }
        print_progress(stage_name(state), state);
        if (is_cancelled()) {
            end_cancelled();
        }
        nanosleep(&pause, NULL);
    }
}

/* Does this rank's part of a stage, and returns when those of all ranks are done (of texels, rank 0 alone waits). Rank 0
   also does the parts of lost ranks, and gathers all texels. */
static void do_stage(int stage, bk_lightmap *map, const char *folder)
{
    double begin = MPI_Wtime(), own;
    clock_t processor = clock();
    int part;
    stage_now = stage;
    tell(DONE, 0);
    do_part(stage, map, folder, rank);
    own = MPI_Wtime() - begin;
    processor = clock() - processor;
    if (rank != 0) {
        tell(STATE, stage);
    }
    for (part = 1; rank == 0 && part < size; part++) {
        if (!is_lost[part] && wait_for(part, stage) == WORKING) {
            fprintf(stderr, "rank %d is lost; rank 0 does its part\n", part);
            is_lost[part] = 1;
        }
        if (is_lost[part] || stage == TEXELS) {
            do_part(stage, map, folder, part);
        }
    }
    if (rank == 0 && stage != TEXELS) {
        tell(STATE, stage);
    } else if (rank != 0 && stage != TEXELS) {
        wait_for(0, stage);
    }
    printf("rank %d: %s %.2f s (%.2f s of processors), then waited or helped %.2f s\n", rank,
           stage_name(stage), own, (double)processor / CLOCKS_PER_SEC, MPI_Wtime() - begin - own);
}

static bk_scene *load(bk_device *device, const char *name)
{
    bk_scene *scene = NULL;
    check(bk_scene_create(device, &scene), "scene");
    if (bk_scene_load_builtin(scene, name) != BK_OK) {
        bk_light_desc sun;
        check(bk_scene_load_file(scene, name, NULL, progress, NULL, NULL), "scene");
        bk_light_desc_init(&sun);
        sun.type = BK_LIGHT_DIRECTIONAL;
        sun.direction[0] = 0.3f, sun.direction[1] = -1.0f, sun.direction[2] = 0.2f;
        sun.color[0] = 20.0f, sun.color[1] = 18.0f, sun.color[2] = 15.0f; /* W/m2 */
        check(bk_scene_add_light(scene, &sun, NULL), "sun");
    }
    check(bk_scene_commit(scene, progress, NULL), "commit");
    return scene;
}

/* The scene that rank 0 has written. */
static bk_scene *open_scene(bk_device *device, const char *name)
{
    bk_scene *scene = NULL;
    check(bk_scene_create(device, &scene), "scene");
    check(bk_scene_open(scene, name, NULL, progress, NULL), "scene");
    return scene;
}

int main(int argc, char **argv)
{
    bk_device_desc desc;
    bk_lightmap_desc layout;
    bk_device *device = NULL;
    bk_scene *scene = NULL;
    bk_lightmap *map = NULL;
    char name[4096], scene_name[4096];
    int *cells = NULL, lost = 0, part, provided;
    MPI_Init_thread(&argc, &argv, MPI_THREAD_FUNNELED, &provided);
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    MPI_Comm_size(MPI_COMM_WORLD, &size);
    if (argc < 3) {
        fprintf(stderr, "usage: mpirun -n RANKS bake_mpi FOLDER SCENE [TEXELS_PER_UNIT [THREADS]]\n");
        MPI_Abort(MPI_COMM_WORLD, 2);
    }
    if (getenv("BAKE_MPI_STALL")) {
        stall = atof(getenv("BAKE_MPI_STALL"));
    }
    snprintf(cancel_name, sizeof cancel_name, "%s/cancel", argv[1]);
    is_lost = calloc((size_t)size, sizeof *is_lost);
    if (!is_lost) {
        MPI_Abort(MPI_COMM_WORLD, 1);
    }
    MPI_Win_allocate(rank == 0 ? (MPI_Aint)(CELLS * size * (int)sizeof(int)) : 0, sizeof(int), MPI_INFO_NULL,
                     MPI_COMM_WORLD, &cells, &board);
    if (rank == 0) {
        MPI_Win_lock(MPI_LOCK_EXCLUSIVE, 0, 0, board);
        memset(cells, 0, CELLS * (size_t)size * sizeof(int));
        MPI_Win_unlock(0, board);
    }
    MPI_Barrier(MPI_COMM_WORLD);

    bk_device_desc_init(&desc);
    desc.num_threads = argc > 4 ? (uint32_t)atoi(argv[4]) : 0;
    check(bk_device_create(&desc, &device), "device");
    bk_lightmap_desc_init(&layout);
    layout.texels_per_unit = argc > 3 ? (float)atof(argv[3]) : 0.0f;
    snprintf(name, sizeof name, "%s/layout.bklay", argv[1]);
    snprintf(scene_name, sizeof scene_name, "%s/scene.bkscene", argv[1]);
    if (rank == 0) {
        scene = load(device, argv[2]);
        if (size > 1) {
            check(bk_scene_save(scene, scene_name, progress, NULL), "scene file");
        }
        if (bk_lightmap_load_layout(scene, &layout, name, progress, NULL, &map) != BK_OK) {
            check(bk_lightmap_create(scene, &layout, progress, NULL, &map), "light map");
            check(bk_lightmap_save_layout(map, name, progress, NULL), "layout");
        }
        tell(STATE, LAID_OUT);
    } else {
        wait_for(0, LAID_OUT);
        scene = open_scene(device, scene_name);
        check(bk_lightmap_load_layout(scene, &layout, name, progress, NULL, &map), "layout");
        tell(STATE, LAID_OUT);
    }

    do_stage(PHOTONS, map, argv[1]);
    do_stage(RADIANCE, map, argv[1]);
    do_stage(TEXELS, map, argv[1]);
    for (part = 1; rank == 0 && part < size; part++) {
        lost |= is_lost[part];
    }
    if (rank == 0) {
        snprintf(name, sizeof name, "%s/", argv[1]);
        check(bk_lightmap_save(map, name, BK_FILE_EXR, progress, NULL), "pages");
        printf("baked by %d ranks\n", size);
        tell(STATE, lost ? ENDED_WITHOUT_SOME : ENDED);
    } else {
        lost = wait_for(0, ENDED) == ENDED_WITHOUT_SOME;
    }
    bk_lightmap_release(map);
    bk_scene_release(scene);
    bk_device_release(device);
    free(is_lost);
    if (lost) {
        fflush(stdout);
        _Exit(0); /* MPI_Finalize would wait for the lost rank. */
    }
    MPI_Win_free(&board);
    MPI_Finalize();
    return 0;
}
