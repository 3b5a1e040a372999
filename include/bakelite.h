/**
 * @file bakelite.h
 * Bakelite: SIMD light-baking kernels.
 *
 * A bake takes these calls, each of which is described below:
 *
 *     bk_device_create      threads and instruction set
 *     bk_scene_create       then bk_scene_load_file, or bk_scene_add_material, bk_scene_add_mesh
 *     bk_scene_add_light    lights that are not in the file
 *     bk_scene_commit       builds the acceleration structure; from here on bk_intersect works
 *     bk_lightmap_create    unwraps and lays out pages of texels
 *     bk_bake               computes the light
 *     bk_lightmap_read      texels, with bk_lightmap_mesh_uvs; or files: bk_lightmap_save
 *
 * bk_live_create refines the light of a scene while it is shown, instead of a bake.
 *
 * Generated from src/capi by cbindgen; do not edit. To update it:
 *     BAKELITE_UPDATE_HEADER=1 cargo test -p bakelite-header
 */
#ifndef BAKELITE_H
#define BAKELITE_H

#include <stddef.h>
#include <stdint.h>

/* Programs that link the static library on Windows define BK_STATIC. */
#ifndef BK_API
#if defined(_WIN32) && !defined(BK_STATIC)
#define BK_API __declspec(dllimport)
#else
#define BK_API
#endif
#endif

/* Declares functions that may still change: see the first section. */
#ifndef BK_EXPERIMENTAL
#define BK_EXPERIMENTAL BK_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* ============================================================================================== */
/**
 * @defgroup error Results and version
 *
 * Functions that can fail return a `bk_result`: BK_OK, or a negative code. `bk_last_error()` then
 * returns a sentence that names the argument and the value at fault. A call that fails changes
 * nothing unless its description says otherwise, and every object can still be used.
 *
 * These rules hold for all functions; descriptions state exceptions only:
 *
 * - Pointers must not be NULL unless the description of the parameter allows it. NULL elsewhere, a
 *   value or flag that is not listed, and a wrong `struct_size` give BK_ERROR_INVALID_ARGUMENT.
 * - Pointers to input are read during the call only; the library copies all that it needs later.
 * - Pointers to output must be valid for the whole call. Output is written on success only, except
 *   that a create function sets its `out` to NULL on failure.
 * - Any function with a `bk_result` can return BK_ERROR_INTERNAL, and is listed with the other
 *   codes it can return.
 *
 * Enums and flags are passed as uint32_t constants. Numbers of meshes, materials, lights and
 * images count from 0 in the order of addition. Strings are UTF-8 and end with a NUL.
 *
 * Every structure whose name ends in _desc, _params, _info, _stats or _view, and bk_camera and
 * bk_budget, start with `uint32_t struct_size`. The function `bk_..._init` sets that size and the
 * default of every other field. Later versions of the library add fields at the end only and
 * accept the size of an older version: missing fields of an input have their defaults, and an
 * output is written up to the size.
 *
 * Functions that are declared with BK_EXPERIMENTAL, and fields whose description begins with
 * "Experimental:", may change or disappear in any release, without the care that the rest gets.
 * Define BK_EXPERIMENTAL before including this header, for example as a deprecation attribute, to
 * find their uses.
 *
 * Versions: until 1.0, a new minor version may change or remove functions and fields, so that
 * programs must be recompiled; a new patch version corrects behaviour or adds functions and fields,
 * and runs programs compiled with earlier ones. From 1.0 on the major version takes the part of
 * the minor one, and the minor version grows when functions or fields are added. The name of the
 * shared library (libbakelite.so.0.1), the CMake package and the Rust crate follow this rule.
 *
 * Thread safety: any thread; bk_last_error is per thread.
 *
 * Cost: none of these functions allocates or waits.
 *
 * @{
 */
/* ============================================================================================== */

/// Major version; see "Versions" above.
#define BK_VERSION_MAJOR 0

/// Minor version. Programs must be recompiled when it changes and the major version is 0.
#define BK_VERSION_MINOR 1

/// Patch version. Programs run with a later one without being recompiled.
#define BK_VERSION_PATCH 0

/// Version of this header: major << 16 | minor << 8 | patch.
#define BK_VERSION (((BK_VERSION_MAJOR << 16) | (BK_VERSION_MINOR << 8)) | BK_VERSION_PATCH)

/// "None" where an index is expected or reported.
#define BK_NONE 0xffffffffu

/// Result code of a function: BK_OK, or one of the negative BK_ERROR codes.
typedef int32_t bk_result;

/// The call succeeded.
#define BK_OK 0

/// An argument is NULL or out of its documented range.
#define BK_ERROR_INVALID_ARGUMENT (-1)

/// The object does not allow the call in its present state, or another thread is changing it.
#define BK_ERROR_INVALID_STATE (-2)

/// Memory ran out, a memory budget is too small, or the memory callback refused.
#define BK_ERROR_OUT_OF_MEMORY (-3)

/// The progress callback returned 0.
#define BK_ERROR_CANCELLED (-4)

/// This build of the library or this machine does not support the request.
#define BK_ERROR_UNSUPPORTED (-5)

/// A file could not be read or written, or its content is malformed.
#define BK_ERROR_IO (-6)

/// A bug in the library, caught before it reached the caller.
#define BK_ERROR_INTERNAL (-7)

/// Returns the version of the library in use, to compare with BK_VERSION.
///
/// @return  major << 16 | minor << 8 | patch
BK_API uint32_t bk_version(void);

/// Returns the name of a result code, for example "BK_OK".
///
/// @param result  any value
/// @return  a constant string that is never NULL; "unknown bk_result" for a value that is no code
BK_API const char *bk_result_string(bk_result result);

/// Returns a sentence about the last call of the calling thread that failed.
///
/// The sentence names the argument and the value at fault. Functions without a `bk_result`, for
/// example bk_intersect, report their failures here too; a call that succeeds leaves the text as it
/// is.
///
/// @return  a string that is never NULL, owned by the library and valid until the thread's next
///   call into it; empty if no call has failed yet
BK_API const char *bk_last_error(void);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup device Devices and callbacks
 *
 * A device owns worker threads, the choice of instruction set, the log and the memory accounts.
 *
 * Ownership: handles (bk_device, bk_scene, bk_photon_map, bk_lightmap, bk_live) are opaque and
 * reference-counted. A create function hands out one reference, which the caller releases with
 * bk_..._release; bk_..._retain adds one. An object keeps its parents alive, so they may be
 * released first.
 *
 * Callbacks may run on any thread and must not throw exceptions or jump out. Inside a callback,
 * functions that work on a device's threads (commit, refit, create, bake, load, save, live
 * updates, BK_RAYS_PARALLEL) and changes to the object whose call is running fail with
 * BK_ERROR_INVALID_STATE; all others are allowed, releases among them. Strings passed to callbacks
 * are valid during the callback only.
 *
 * Floating-point state: all functions compute with rounding to nearest, with denormals and with
 * all exceptions masked, whatever the calling thread has set (in MXCSR on x86-64, in FPCR on
 * AArch64; on other architectures nothing is set), and restore the caller's state before they
 * return. Callbacks see the caller's state on the caller's thread and the default state on others;
 * their changes to it last until they return. Saving and restoring costs about 6 ns per call where
 * the caller's state is the default and 10 ns where it is not, once for all rays of
 * bk_intersect_many, bk_occluded_many and bk_gather.
 *
 * Stacks: the calling thread needs 64 KB of stack for queries (bk_intersect, bk_occluded,
 * bk_intersect_many, bk_occluded_many, bk_gather, bk_photon_map_estimate) and 256 KB for all other
 * functions. Each thread of the library reserves 4 MB of address space for its stack; only used
 * pages take memory.
 *
 * fork: a device's threads do not exist in the child process. There, calls that need them fail
 * with BK_ERROR_INVALID_STATE; queries without BK_RAYS_PARALLEL, releases, and devices created in
 * the child work. An object that another thread was changing during the fork stays locked in the
 * child: calls with it fail with BK_ERROR_INVALID_STATE.
 *
 * Thread safety: any thread, all functions at the same time.
 *
 * Cost: bk_device_create starts threads, in about 0.1 ms each, and the last release joins them;
 * the other functions take nanoseconds.
 *
 * @{
 */
/* ============================================================================================== */

/// Instruction set: the best that the machine has.
#define BK_ISA_AUTO 0

/// Instruction set: the baseline of the target (SSE2 on x86-64, NEON on AArch64).
#define BK_ISA_PORTABLE 1

/// Instruction set: AVX2 with FMA.
#define BK_ISA_AVX2 2

/// Instruction set: AVX-512 F, VL, DQ and BW.
#define BK_ISA_AVX512 3

/// Log level: a failure that no result code reports.
#define BK_LOG_ERROR 0

/// Log level: something about the input or the run that deserves attention, for example skipped
/// triangles.
#define BK_LOG_WARNING 1

/// Log level: progress of the work. One message each for a device, a commit, a light map and a bake,
/// with sizes, times and the text of bk_plan_describe.
#define BK_LOG_INFO 2

/// Handle of a device.
typedef struct bk_device bk_device;

/// Receives log messages, from any thread and several at a time.
///
/// @param user  bk_device_desc.user
/// @param level  one of the BK_LOG values
/// @param message  UTF-8, valid during the call only
typedef void (*bk_log_fn)(void *user, uint32_t level, const char *message);

/// Allows or refuses a large allocation, and is notified when it is freed.
///
/// Runs on any thread, several calls at a time; for the last time when the last object of the
/// device is released. After a refusal the call that needed the memory ends with
/// BK_ERROR_OUT_OF_MEMORY.
///
/// @param user  bk_device_desc.user
/// @param bytes  size of the allocation in bytes; negative after a free
/// @return  0 to refuse the allocation, any other value to allow it; ignored after a free
typedef int32_t (*bk_memory_fn)(void *user, int64_t bytes);

/// Parameters of bk_device_create.
typedef struct bk_device_desc {
  /// Size of this structure in bytes, set by bk_device_desc_init.
  uint32_t struct_size;
  /// Number of worker threads, at most 1024; 0: one per logical core, at most 1024. Results do
  /// not depend on it. Default: 0.
  uint32_t num_threads;
  /// One of the BK_ISA values; BK_ISA_AUTO is the best that the machine has. The environment
  /// variable BAKELITE_ISA ("portable", "avx2" or "avx512") forbids better ones than it names.
  /// Default: BK_ISA_AUTO.
  uint32_t isa;
  /// Log callback, or NULL: messages then go to standard error if the environment variable
  /// BAKELITE_LOG is set to "error", "warning" or "info", the least important level to write, and
  /// else nowhere. Default: NULL.
  bk_log_fn log;
  /// Memory callback, or NULL. Default: NULL.
  bk_memory_fn memory;
  /// Pointer passed to `log` and `memory`; must stay valid until the device and all that was made
  /// from it are gone. Default: NULL.
  void *user;
  /// Folder in which the unwraps of light maps are kept by their content, for the next light map
  /// and the next run of the program: parts of meshes that are as they were are not unwrapped
  /// again. It is made if needed; files in it may be deleted at any time. It should be writable for
  /// this user only: files are checked, but charts that somebody else put there would be used.
  /// UTF-8; NULL: none are kept. Default: NULL.
  const char *cache_folder;
  /// Folder for files that take the place of memory, where scenes are larger than it (see
  /// bk_open_params.ray_queues): for copies of meshes, the acceleration structure (up to 250 bytes
  /// per triangle while a scene is committed, up to 110 after it) and the charts of light maps
  /// (some 50 bytes per triangle, three times that while a light map is created). The folder must
  /// exist; the files have no names in it, and their room is free again when scene and light map
  /// are gone (64 MB of it: when the device is), however the process ends. The library never
  /// writes more to them than there is room on the disk. Arrays of less than 4 KB, textures and
  /// texels are in memory as ever, and scenes from bk_scene_open in their file. UTF-8; NULL: all is in memory. Default: NULL.
  const char *scratch_folder;
} bk_device_desc;

/// Reports the progress of a call, and can cancel it.
///
/// Runs on the thread that made the call, and only until that call returns: when a stage starts and
/// about every 15 ms, at most 100 times in any second. (A stage that starts when 20 others have
/// just started is reported with the next call.) The library's own threads go on working meanwhile.
/// NULL is allowed wherever a function takes a progress callback.
///
/// @param user  pointer that was passed beside the callback
/// @param fraction  part of the work that is done, in [0, 1], never falling
/// @param stage  name of the stage, for example "gather"
/// @return  0 to cancel: the call then ends with BK_ERROR_CANCELLED, as a rule within 50 ms; any
///   other value to go on
typedef int32_t (*bk_progress_fn)(void *user, float fraction, const char *stage);

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
BK_API void bk_device_desc_init(bk_device_desc *desc);

/// Creates a device and starts its threads.
///
/// @param desc  parameters; NULL for the defaults
/// @param out  receives the device, which the caller releases with bk_device_release; NULL on
///   failure
/// @retval BK_ERROR_UNSUPPORTED  the machine lacks the requested instruction set, or BAKELITE_ISA
///   forbids it (a word that names none forbids all)
/// @retval BK_ERROR_OUT_OF_MEMORY  the threads cannot be started
BK_API bk_result bk_device_create(const bk_device_desc *desc, bk_device **out);

/// Adds one reference.
///
/// @param device  NULL is ignored
BK_API void bk_device_retain(bk_device *device);

/// Releases one reference. The last release of the device and of all that was made from it joins
/// the threads; no callback comes afterwards.
///
/// @param device  NULL is ignored
BK_API void bk_device_release(bk_device *device);

/// Returns the instruction set in use.
///
/// BK_ISA_AVX2 and BK_ISA_AVX512 give the same bits of hits and light. BK_ISA_PORTABLE rounds
/// products and sums separately where the others fuse them, so its bits differ: results and
/// checkpoints of bakes cannot be exchanged between it and the others.
///
/// @param device  NULL gives BK_ISA_AUTO
/// @return  a BK_ISA value other than BK_ISA_AUTO
BK_API uint32_t bk_device_isa(const bk_device *device);

/// Returns the number of worker threads.
///
/// @param device  NULL gives 0
/// @return  number of threads, 1 to 1024
BK_API uint32_t bk_device_num_threads(const bk_device *device);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup scene Scenes
 *
 * A scene is first described (materials, meshes, lights, files) and then committed: the commit
 * builds the acceleration structure. A committed scene can be queried and baked. Only its lights
 * (bk_scene_set_light) and the positions of its vertices (bk_mesh_set_positions, bk_scene_refit)
 * can change.
 *
 * Units: coordinates are right-handed with any up axis, in any unit of length ("scene units"; W/m2
 * then means watts per square scene unit), valid up to a magnitude of 1e12. Front faces are
 * counter-clockwise. Colours are linear RGB. All surfaces are diffuse.
 *
 * Thread safety: one thread at a time may describe, commit, move or refit a scene; a second one
 * fails with BK_ERROR_INVALID_STATE. Queries of a committed scene are safe from any thread, at any
 * time except during bk_scene_refit: then the later call fails with BK_ERROR_INVALID_STATE.
 *
 * Cost: functions that are not described otherwise take less than a microsecond beside copying
 * their input.
 *
 * @{
 */
/* ============================================================================================== */

/// Build quality: binned surface area heuristic.
#define BK_BUILD_QUALITY_DEFAULT 0

/// Build quality: binned surface area heuristic with spatial splits, which may cut triangles. The
/// build takes several times as long and the tree up to a sixth more memory. Closest hits take 10
/// to 20 % less work where large or slanted triangles overlap others, as in most buildings;
/// occlusion rays may take 10 % more, since they reach large triangles later.
#define BK_BUILD_QUALITY_HIGH 1

/// Handle of a scene, described or committed.
typedef struct bk_scene bk_scene;

/// Parameters of the acceleration structure.
typedef struct bk_build_params {
  /// Size of this structure in bytes, set by bk_build_params_init.
  uint32_t struct_size;
  /// Number of bins per axis of the surface area heuristic, 2 to 256. Default: 64.
  uint32_t bins;
  /// Maximum number of triangles per leaf, 1 to 8. Default: 4, the number that is tested at a
  /// time.
  uint32_t max_leaf;
  /// One of the BK_BUILD_QUALITY values. Default: BK_BUILD_QUALITY_DEFAULT.
  uint32_t quality;
  /// With BK_BUILD_QUALITY_HIGH: maximum number of references that spatial splits may add, as a
  /// fraction of the number of triangles, 0 to 4. Leaves grow by at most as much. Default: 0.25.
  float split_budget;
  /// Experimental: 1 builds compact trees, which take a fifth of the memory and make rays slower;
  /// 0 builds full ones. The hits are the same, except for rays that graze an edge within
  /// rounding after BK_BUILD_QUALITY_HIGH. Default: 0.
  uint32_t compact;
} bk_build_params;

/// Numbers about a committed scene.
typedef struct bk_scene_stats {
  /// Size of this structure in bytes, set by bk_scene_stats_init.
  uint32_t struct_size;
  /// Surface area heuristic cost of the binary tree of the meshes without instances after the
  /// commit, a relative number: 1 per traversal step and per intersection.
  float sah_cost;
  /// Number of triangles, those of every instance counted.
  uint64_t triangles;
  /// Number of triangles that are degenerate or not finite, at the commit or since
  /// bk_scene_refit, and are not hit; those of a mesh with instances count once.
  uint64_t skipped_degenerate;
  /// Number of 8-wide nodes of the acceleration structure.
  uint64_t nodes;
  /// Size of the acceleration structure in bytes.
  uint64_t bvh_bytes;
  /// Size of the whole committed scene in bytes.
  uint64_t bytes;
  /// Duration of the build, or of opening the file, in seconds.
  double build_seconds;
  /// Surface area heuristic cost of the 8-wide tree of the same meshes in its present shape, a
  /// relative number: 1 for each node and each triangle that a random ray is expected to visit.
  /// Compare it with its value after the commit.
  float wide_sah_cost;
  /// Number of calls of bk_scene_refit that moved something.
  uint32_t refits;
  /// Duration of the last of these calls in seconds; 0 if there was none.
  double refit_seconds;
  /// Number of `bytes` that are in a mapped scene file (bk_scene_open), or in files of
  /// bk_device_desc.scratch_folder, instead of in memory, as far as the system does not keep them
  /// there because it has room.
  uint64_t mapped_bytes;
  /// Number of triangles, those of a mesh with instances counted once, whose trees
  /// bk_scene_commit_from took over.
  uint64_t kept_triangles;
} bk_scene_stats;

/// Creates an empty scene.
///
/// @param device  kept alive by the scene
/// @param out  receives the scene, which the caller releases with bk_scene_release; NULL on failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a pointer is NULL
BK_API bk_result bk_scene_create(bk_device *device, bk_scene **out);

/// Adds one reference.
///
/// @param scene  NULL is ignored
BK_API void bk_scene_retain(bk_scene *scene);

/// Releases one reference.
///
/// @param scene  NULL is ignored
BK_API void bk_scene_release(bk_scene *scene);

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
BK_API void bk_build_params_init(bk_build_params *params);

/// Sets the parameters with which bk_scene_commit builds the acceleration structure.
///
/// @param scene  scene that is not committed
/// @param params  copied
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
BK_API bk_result bk_scene_set_build(bk_scene *scene, const bk_build_params *params);

/// Commits a scene: ends its description and builds the acceleration structure on the device's
/// threads.
///
/// Logs a warning if triangles are skipped, or if the scene lies so far from the origin that its
/// f32 coordinates have too few digits for its size: rays start 32 rounding steps above surfaces,
/// which spoils light from a distance of about a thousand times the scene's size on. A commit that
/// fails or is cancelled leaves the description as it was.
///
/// Where the device has a scratch_folder, the copies of meshes, the acceleration structure and, but
/// for BK_BUILD_QUALITY_HIGH, the working memory of the build lie in files there; rays hit the
/// same, bit for bit.
///
/// Cost: about 0.7 s per million triangles on one thread, 1.5 to 4 times that with
/// BK_BUILD_QUALITY_HIGH; nearly half on two threads.
///
/// @param scene  scene that is not committed
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_STATE  the scene is committed already, has no usable triangle or too many
///   (bk_mesh_desc.triangle_count), or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the acceleration structure does not fit or the memory callback
///   refuses
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API bk_result bk_scene_commit(bk_scene *scene, bk_progress_fn progress, void *user);

/// Commits a scene as bk_scene_commit does, and takes over parts of the acceleration structure of
/// an earlier scene, for massive scenes that are described anew after little has changed.
///
/// Each mesh with instances that is as it was, by its positions and indices, and had instances,
/// keeps its tree, and so do all meshes without instances together, if they are the same in the
/// same order. Where instances are, materials, lights and all else may have changed. Trees in which
/// bk_scene_refit has moved a mesh are built anew, and all are if only one of the scenes has
/// bk_build_params.compact. Other build parameters are those of the earlier trees. Rays hit the same
/// as without, but for spatial splits in compact trees (see bk_build_params.compact).
/// bk_scene_stats.kept_triangles says how much was taken over.
///
/// Cost: that of bk_scene_commit for meshes that have changed, a copy of the trees of the others.
///
/// @param scene  scene that is not committed
/// @param earlier  committed scene, or one from a scene file, of any device; may be released after
///   the call
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_STATE  the scene is committed already, `earlier` is not, the scene has no
///   usable triangle or too many, or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the acceleration structure does not fit or the memory callback
///   refuses
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder, or the mapped file of
///   `earlier` was changed
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_scene_commit_from(bk_scene *scene,
                               const bk_scene *earlier,
                               bk_progress_fn progress,
                               void *user);

/// Applies the positions that bk_mesh_set_positions and the transforms that
/// bk_instance_set_transform has set since the last refit; does nothing if there are none.
///
/// Queries then hit the moved triangles; geometric normals, light of emissive triangles, bounds and
/// statistics follow. The acceleration structure keeps its shape and gets new boxes. It serves well
/// while neighbours stay neighbours; where bk_scene_stats.wide_sah_cost has grown much since the
/// commit, rays are slower and a new scene is better. After BK_BUILD_QUALITY_HIGH the first refit
/// loses more than the cuts had gained, however little moved: use BK_BUILD_QUALITY_DEFAULT for
/// scenes that are refitted.
///
/// Triangles that become degenerate or not finite are not hit while they are; those that were so at
/// the commit are never hit. Light maps, photon maps and live objects that were made before keep
/// the old geometry (the scene is copied if there are any, else changed in place) and still follow
/// the scene's lights; bk_lightmap_follow updates a light map. Pointers from bk_scene_get_mesh become invalid.
///
/// Cost: a tenth to a fifth of the time of a commit, on the device's threads; if there is a copy,
/// more.
///
/// @param scene  committed scene
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed, no triangle would be left that can
///   be hit, or another thread queries or changes the scene; the positions wait for the next refit
/// @retval BK_ERROR_OUT_OF_MEMORY  the memory callback refuses the copy; the positions wait for the
///   next refit
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder for the copy; the positions
///   wait for the next refit
BK_API
bk_result bk_scene_refit(bk_scene *scene);

/// Sets `struct_size` and clears the other fields.
///
/// @param stats  structure to fill in; NULL is ignored
BK_API void bk_scene_stats_init(bk_scene_stats *stats);

/// Gets numbers about a committed scene.
///
/// @param scene  committed scene
/// @param out  receives the numbers
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
BK_API bk_result bk_scene_get_stats(const bk_scene *scene, bk_scene_stats *out);

/// Gets the bounding box of all valid triangles of a committed scene.
///
/// @param scene  committed scene
/// @param lower  receives the smallest x, y and z, in scene units
/// @param upper  receives the largest x, y and z, in scene units
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
BK_API bk_result bk_scene_bounds(const bk_scene *scene, float lower[3], float upper[3]);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup files Scene files
 *
 * Scenes come from files of other programs (OBJ, PLY, glTF), which are added to a description, and
 * from files that bk_scene_save has written: those hold a committed scene with its acceleration
 * structure, and are opened instead of described and committed.
 *
 * Thread safety: as for scenes.
 *
 * Cost: functions that are not described otherwise take less than a microsecond.
 *
 * @{
 */
/* ============================================================================================== */

/// Flag of bk_load_params: files that the scene file names may lie in any folder. Use it for scenes
/// of trusted authors only: such a scene can find out which files exist, and can show their texels
/// in its light.
#define BK_LOAD_ANY_FOLDER 1

/// Numbers about a file that was loaded.
typedef struct bk_load_info {
  /// Size of this structure in bytes, set by bk_load_info_init.
  uint32_t struct_size;
  /// Number of meshes added.
  uint32_t meshes;
  /// Number of the first mesh added; the others follow it.
  uint32_t first_mesh;
  /// Number of materials added.
  uint32_t materials;
  /// Number of the first material added; the others follow it.
  uint32_t first_material;
  /// Number of lights added, emissive materials not counted.
  uint32_t lights;
  /// Number of the first light added; the others follow it.
  uint32_t first_light;
  /// Number of materials with a reflectance outside [0, 0.98], which was clamped to that range.
  uint32_t clamped_albedos;
  /// Number of triangles added, those of every instance counted and degenerate ones included.
  uint64_t triangles;
  /// Duration of the call in seconds.
  double seconds;
  /// Number of textures added. An image that cannot be read is left out, with a warning in the
  /// log.
  uint32_t textures;
  /// Number of the first texture added; the others follow it.
  uint32_t first_texture;
  /// Number of instances added, of meshes of at least 1,000 triangles that stand in several
  /// places.
  uint32_t instances;
  /// Number of the first instance added; the others follow it.
  uint32_t first_instance;
} bk_load_info;

/// Limits of bk_scene_load_file: which files it may read, and how much of them.
typedef struct bk_load_params {
  /// Size of this structure in bytes, set by bk_load_params_init.
  uint32_t struct_size;
  /// BK_LOAD_ANY_FOLDER or 0. Default: 0.
  uint32_t flags;
  /// Folder in or below which all files must lie that the scene file names (material libraries,
  /// images, buffers), symbolic links resolved. UTF-8; NULL: the folder of the scene file.
  /// Default: NULL.
  const char *base_folder;
  /// Limit in bytes for all decoded images together, 4 per texel, checked before an image is
  /// decoded. (Decoding takes up to 8 more bytes per texel of the image.) Default: 2 GiB.
  uint64_t max_texture_bytes;
  /// Limit in bytes for all files together, the scene file included. Default: 16 GiB.
  uint64_t max_file_bytes;
} bk_load_params;

/// How bk_scene_open opens a file.
typedef struct bk_open_params {
  /// Size of this structure in bytes, set by bk_open_params_init.
  uint32_t struct_size;
  /// 1: the file is mapped and takes the place of memory. Parts are read when they are needed, and
  /// the system drops them when it needs the memory, so that a scene may be larger than it. Pages
  /// that a refit changes stay in memory. While the scene lives, the file must not be changed in
  /// place or cut short: that would be as if somebody wrote to the process's memory. (bk_scene_save
  /// under its name is fine: it makes a new file.) Bakes, light maps, photon maps, saves and refits
  /// notice it and fail with BK_ERROR_IO, and checkpoints hold nothing that was computed since; but
  /// reading a part that was cut off ends the process (SIGBUS). 0: the file is read to memory; rays are
  /// somewhat faster, because memory can have large pages. Default: 1.
  uint32_t map;
  /// 1: rays wait at parts of the tree until enough of them do, for scenes that are larger than
  /// memory: a part is then read for many rays at once. The scene has threads of its own for that,
  /// 128 per thread of the device but no more than 512 that bring rays, and no more than 64 that
  /// trace them. Hits and light stay the same, bit for bit. Scenes that fit into memory take longer
  /// so, and a cancel is noticed when the rays that wait have been traced. A refit brings all of the
  /// scene to memory, and ends it. Default: 0.
  uint32_t ray_queues;
} bk_open_params;

/// Sets `struct_size` and clears the other fields.
///
/// @param info  structure to fill in; NULL is ignored
BK_API void bk_load_info_init(bk_load_info *info);

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
BK_API void bk_load_params_init(bk_load_params *params);

/// Loads a scene file and adds its meshes, materials with their textures (PNG and JPEG), and
/// lights.
///
/// Only regular files are read, never devices, FIFOs or sockets. A material library or an image
/// that cannot be read, or that lies where `params` allows none, is left out with a warning in the
/// log; a buffer of a glTF file that cannot be read is an error. bk_scene_get_mesh,
/// bk_scene_get_material, bk_scene_get_texture and bk_scene_get_light read the loaded objects back.
///
/// Files from untrusted sources are safe to load, within the limits of `params`: malformed content
/// gives an error, or is left out with a warning.
///
/// Cost: 0.2 (PLY) to 2 s (OBJ) per million triangles, on one thread, and the decoding of images.
///
/// @param scene  scene that is not committed
/// @param path  name of a file that ends in .obj (with its .mtl), .ply, .gltf or .glb; UTF-8
/// @param params  limits; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the numbers of the objects added; may be NULL
/// @retval BK_ERROR_IO  a file cannot be read or is malformed, and bk_last_error names it; or there
///   is no room in bk_device_desc.scratch_folder
/// @retval BK_ERROR_UNSUPPORTED  the kind of file is unknown, the file requires an extension of
///   glTF that is not supported, or the library was built without files
/// @retval BK_ERROR_OUT_OF_MEMORY  a limit of `params` is exceeded, the memory callback refuses, or
///   memory runs out
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
BK_API
bk_result bk_scene_load_file(bk_scene *scene,
                             const char *path,
                             const bk_load_params *params,
                             bk_progress_fn progress,
                             void *user,
                             bk_load_info *out);

/// Adds a built-in scene with its lights.
///
/// Cost: less than 0.1 s.
///
/// @param scene  scene that is not committed
/// @param name  "cornell" (the Cornell box), "furnace" (a closed, glowing cube) or "atrium" (a
///   two-floor court in the sun)
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such scene
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the memory callback refuses
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder
BK_API bk_result bk_scene_load_builtin(bk_scene *scene, const char *name);

/// Writes a committed scene to a file, which is replaced as a whole, for bk_scene_open: meshes,
/// instances, materials, textures, environments, lights as they are now, and the acceleration
/// structure with the refits that were made. If the call fails, the old file is as it was.
///
/// The format is described in the manual (docs/scene_file.md). Files are for machines of the same
/// order of bytes, and for this version of the format.
///
/// Cost: 60 to 110 bytes per triangle to write, half of that for a compact structure, with textures.
///
/// @param scene  committed scene
/// @param path  name of the file; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_IO  the file cannot be written
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API bk_result bk_scene_save(bk_scene *scene, const char *path, bk_progress_fn progress, void *user);

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
BK_API void bk_open_params_init(bk_open_params *params);

/// Loads a scene that bk_scene_save has written. It is committed then, with the hits and the light,
/// bit for bit, of the scene that was saved; numbers of meshes, materials and so on are the same.
/// Nothing is built.
///
/// Files from untrusted sources are safe to open as long as nobody changes them meanwhile: a file
/// that is damaged, or of another version, gives an error.
///
/// Cost: all of the file is read once, to check it: some 0.03 s per million triangles if the
/// system has it in its cache, and 0.2 s to read it to memory. A mapped scene takes no memory but for textures, skies, emissive triangles
/// and instances.
///
/// @param scene  scene to which nothing has been added
/// @param path  name of the file; UTF-8
/// @param params  NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_IO  the file cannot be read, is damaged, or is no scene file of this version
/// @retval BK_ERROR_INVALID_STATE  the scene is committed, something has been added to it, or
///   another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the memory callback refuses, or memory runs out
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_scene_open(bk_scene *scene,
                        const char *path,
                        const bk_open_params *params,
                        bk_progress_fn progress,
                        void *user);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup textures Textures
 *
 * Textures colour surfaces and cut parts of them out by alpha. Meshes place them by
 * bk_mesh_desc.uvs; they repeat beyond [0, 1] and are interpolated between the centres of texels.
 *
 * Environments are images of the sky: all directions by longitude and latitude. Row 0 is at the
 * zenith, the last row at the nadir; the middle of a row is the sky's front, and texels follow one
 * another to the right as seen from inside. Each texel is an area of uniform radiance, without
 * interpolation.
 *
 * Textures and environments are added to a scene before its commit, and before the materials and
 * lights that name them. A scene without images spends neither memory nor time on them.
 *
 * Thread safety: as for scenes; the functions that read are safe from any thread, but before the
 * commit fail with BK_ERROR_INVALID_STATE while another thread is changing the scene.
 *
 * Cost: adding copies the texels; reading copies nothing and takes less than a microsecond.
 *
 * @{
 */
/* ============================================================================================== */

/// Format of textures: four bytes per texel, sRGB red, green and blue and linear alpha (255:
/// opaque).
#define BK_TEXTURE_RGBA8_SRGB 0

/// Format of environments: three floats per texel, linear red, green and blue, finite and >= 0.
#define BK_TEXTURE_RGB32F 1

/// An image.
typedef struct bk_texture_desc {
  /// Size of this structure in bytes, set by bk_texture_desc_init.
  uint32_t struct_size;
  /// One of the BK_TEXTURE values. Default: BK_TEXTURE_RGBA8_SRGB.
  uint32_t format;
  /// Number of texels along u, 1 to 16384. Default: 0, to be set.
  uint32_t width;
  /// Number of texels along v, 1 to 16384. Default: 0, to be set.
  uint32_t height;
  /// `height` rows of `width` texels, without alignment. Row 0 lies at v = 0 and the first texel
  /// of a row at u = 0, as in glTF. Default: NULL, to be set.
  const void *data;
  /// Distance between rows in bytes, at least the bytes of a row; 0: packed. Default: 0.
  size_t row_stride;
} bk_texture_desc;

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
BK_API void bk_texture_desc_init(bk_texture_desc *desc);

/// Adds a texture.
///
/// @param scene  scene that is not committed
/// @param desc  image of format BK_TEXTURE_RGBA8_SRGB; the texels are copied
/// @param out_id  receives the number of the texture, for materials; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a size or the stride is out of range, the format is another,
///   or `data` is NULL
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the copy does not fit or the memory callback refuses
BK_API bk_result bk_scene_add_texture(bk_scene *scene, const bk_texture_desc *desc, uint32_t *out_id);

/// Adds an environment, for lights of type BK_LIGHT_SKY.
///
/// Cost: 16 bytes of memory per texel, and time in proportion.
///
/// @param scene  scene that is not committed
/// @param desc  image of format BK_TEXTURE_RGB32F; the texels are copied
/// @param out_id  receives the number of the environment, for lights; may be NULL. Environments are
///   numbered apart from textures
/// @retval BK_ERROR_INVALID_ARGUMENT  a size or the stride is out of range, the format is another,
///   `data` is NULL, or a texel is not finite or negative
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the copy does not fit or the memory callback refuses
BK_API
bk_result bk_scene_add_environment(bk_scene *scene,
                                   const bk_texture_desc *desc,
                                   uint32_t *out_id);

/// Returns the number of textures of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of textures; 0 on failure
BK_API uint32_t bk_scene_texture_count(const bk_scene *scene);

/// Gets a texture of a scene, committed or not, without a copy.
///
/// @param scene  any scene
/// @param id  number of the texture
/// @param out  receives size, format and a pointer to packed texels, which stays valid while the
///   scene lives
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such texture
/// @retval BK_ERROR_INVALID_STATE  another thread is changing the scene
BK_API bk_result bk_scene_get_texture(const bk_scene *scene, uint32_t id, bk_texture_desc *out);

/// Returns the number of environments of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of environments; 0 on failure
BK_API uint32_t bk_scene_environment_count(const bk_scene *scene);

/// Gets an environment of a scene, committed or not, without a copy.
///
/// @param scene  any scene
/// @param id  number of the environment
/// @param out  receives size, format and a pointer to packed texels, which stays valid while the
///   scene lives
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such environment
/// @retval BK_ERROR_INVALID_STATE  another thread is changing the scene
BK_API bk_result bk_scene_get_environment(const bk_scene *scene, uint32_t id, bk_texture_desc *out);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup meshes Materials and meshes
 *
 * Materials and meshes are added to a scene before its commit; vertices can move after it.
 *
 * Input arrays need neither alignment nor bytes behind the last element. Strides are in bytes; 0
 * means packed.
 *
 * Thread safety: as for scenes; the functions that read are safe from any thread, but before the
 * commit fail with BK_ERROR_INVALID_STATE while another thread is changing the scene.
 *
 * Cost: adding and moving copy the arrays; reading copies nothing but the structure and takes less
 * than a microsecond.
 *
 * @{
 */
/* ============================================================================================== */

/// Flag of bk_material_desc: the back reflects and emits like the front. The back of a one-sided
/// material absorbs light and transmits none.
#define BK_MATERIAL_TWO_SIDED 1

/// Flag of bk_mesh_desc: degenerate triangles and vertices that are not finite are errors, instead
/// of being skipped and counted.
#define BK_MESH_STRICT 1

/// A diffuse material.
typedef struct bk_material_desc {
  /// Size of this structure in bytes, set by bk_material_desc_init.
  uint32_t struct_size;
  /// BK_MATERIAL flags. Default: 0.
  uint32_t flags;
  /// Diffuse reflectance per channel, a fraction in [0, 1); with `albedo_texture` a factor in [0,
  /// 1]. Default: 0.5.
  float albedo[3];
  /// Emitted radiance per channel in W/(m2 sr), >= 0. Default: 0.
  float emission[3];
  /// Number of the texture that is multiplied with `albedo`, or BK_NONE; the product is clamped
  /// to 0.98. Meshes without `uvs` use `albedo` alone. Default: BK_NONE.
  uint32_t albedo_texture;
  /// Threshold of alpha tests, a fraction in [0, 1]: points where the interpolated alpha of the
  /// texture is smaller are cut out, and rays and photons pass them from either side. Must be 0
  /// for materials that emit. Rays that hit a cut-out are traced a second time. Default: 0,
  /// nothing is cut out.
  float alpha_cutoff;
  /// Fraction of light per channel that passes straight through, from either side, as through
  /// stained glass; its sum with `albedo` is at most 1. It is not textured. Transmitted light of
  /// lights counts as direct light. bk_intersect, bk_occluded and the other ray queries hit the
  /// surface nevertheless. Default: 0.
  float transmission[3];
} bk_material_desc;

/// An indexed triangle mesh.
typedef struct bk_mesh_desc {
  /// Size of this structure in bytes, set by bk_mesh_desc_init.
  uint32_t struct_size;
  /// BK_MESH flags. Default: 0.
  uint32_t flags;
  /// Material number of all triangles if `triangle_materials` is NULL. Default: 0.
  uint32_t material;
  /// `vertex_count` positions of three floats, in scene units. Default: NULL.
  const float *positions;
  /// Distance between positions in bytes, at least 12; 0: packed. Default: 0.
  size_t position_stride;
  /// Number of vertices. Default: 0.
  size_t vertex_count;
  /// Three vertex numbers per triangle, packed, each less than `vertex_count`. Default: NULL.
  const uint32_t *indices;
  /// Number of triangles; at most 2^28. All meshes without instances together have at most as many
  /// when the scene is committed; those of all instances are at most 2^32 - 2. Default: 0.
  size_t triangle_count;
  /// `vertex_count` shading normals of three floats, unit vectors; may be NULL. Default: NULL,
  /// geometric normals.
  const float *normals;
  /// Distance between normals in bytes, at least 12; 0: packed. Default: 0.
  size_t normal_stride;
  /// `vertex_count` texture coordinates of two floats, 1 per width or height of an image; may be
  /// NULL. Default: NULL.
  const float *uvs;
  /// Distance between texture coordinates in bytes, at least 8; 0: packed. Default: 0.
  size_t uv_stride;
  /// `vertex_count` light map coordinates of two floats in [0, 1], 1 per width or height of a
  /// page; triangles of a page must not overlap. May be NULL: the mesh is unwrapped. Default:
  /// NULL.
  const float *lightmap_uvs;
  /// Distance between light map coordinates in bytes, at least 8; 0: packed. Default: 0.
  size_t lightmap_uv_stride;
  /// Light map page of each triangle, packed; needs `lightmap_uvs`. May be NULL: all on page 0.
  /// Default: NULL.
  const uint32_t *lightmap_page;
  /// Material number of each triangle, packed. May be NULL: all have `material`. Default: NULL.
  const uint32_t *triangle_materials;
} bk_mesh_desc;

/// Pointers to the data of a mesh.
typedef struct bk_mesh_view {
  /// Size of this structure in bytes, set by bk_mesh_view_init.
  uint32_t struct_size;
  /// Material number of all triangles if `triangle_materials` is NULL, else BK_NONE.
  uint32_t material;
  /// `vertex_count` positions of three floats, packed, in scene units.
  const float *positions;
  /// Number of vertices.
  size_t vertex_count;
  /// Three vertex numbers per triangle, packed.
  const uint32_t *indices;
  /// Number of triangles, degenerate ones included.
  size_t triangle_count;
  /// `vertex_count` shading normals of three floats, packed, unit vectors as they were given;
  /// NULL if the mesh has none.
  const float *normals;
  /// `vertex_count` texture coordinates of two floats, packed, 1 per width or height of an image;
  /// NULL if the mesh has none.
  const float *uvs;
  /// `vertex_count` light map coordinates of two floats in [0, 1], packed, as they were given;
  /// NULL if the mesh has none.
  const float *lightmap_uvs;
  /// Light map page of each triangle, packed, as it was given; NULL if all are on page 0.
  const uint32_t *lightmap_page;
  /// Material number of each triangle, packed; NULL if all have `material`.
  const uint32_t *triangle_materials;
} bk_mesh_view;

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
BK_API void bk_material_desc_init(bk_material_desc *desc);

/// Adds a material. The texture that it names must have been added before.
///
/// @param scene  scene that is not committed
/// @param desc  copied
/// @param out_id  receives the number of the material, for meshes; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `desc` is out of its range or names no texture
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
BK_API
bk_result bk_scene_add_material(bk_scene *scene,
                                const bk_material_desc *desc,
                                uint32_t *out_id);

/// Returns the number of materials of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of materials; 0 on failure
BK_API uint32_t bk_scene_material_count(const bk_scene *scene);

/// Gets a material of a scene, committed or not.
///
/// @param scene  any scene
/// @param id  number of the material
/// @param out  receives a copy of the material
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such material
/// @retval BK_ERROR_INVALID_STATE  another thread is changing the scene
BK_API bk_result bk_scene_get_material(const bk_scene *scene, uint32_t id, bk_material_desc *out);

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
BK_API void bk_mesh_desc_init(bk_mesh_desc *desc);

/// Adds a mesh. The materials that it names must have been added before.
///
/// @param scene  scene that is not committed
/// @param desc  the arrays are copied
/// @param out_id  receives the number of the mesh, as hits report it; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  an index or a material is out of range, or the mesh violates
///   BK_MESH_STRICT; bk_last_error names triangle and vertex
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the copy does not fit or the memory callback refuses
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder
BK_API bk_result bk_scene_add_mesh(bk_scene *scene, const bk_mesh_desc *desc, uint32_t *out_id);

/// Sets new positions for all vertices of a mesh of a committed scene. Nothing changes before
/// bk_scene_refit, which applies the last positions that were set for each mesh.
///
/// Shading normals, texture coordinates and light map coordinates stay as they are. Positions that
/// are not finite are accepted, and their triangles are not hit after the refit, unless the mesh
/// has BK_MESH_STRICT.
///
/// @param scene  committed scene
/// @param mesh  number of the mesh
/// @param positions  `vertex_count` positions of three floats in scene units; copied
/// @param vertex_count  number of vertices, as when the mesh was added
/// @param stride  distance between positions in bytes, at least 12; 0: packed
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such mesh, `vertex_count` or `stride` is wrong,
///   or the new positions violate BK_MESH_STRICT
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the copy does not fit
BK_API
bk_result bk_mesh_set_positions(bk_scene *scene,
                                uint32_t mesh,
                                const float *positions,
                                size_t vertex_count,
                                size_t stride);

/// Returns the number of meshes of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of meshes; 0 on failure
BK_API uint32_t bk_scene_mesh_count(const bk_scene *scene);

/// Sets `struct_size` and clears the other fields.
///
/// @param view  structure to fill in; NULL is ignored
BK_API void bk_mesh_view_init(bk_mesh_view *view);

/// Gets pointers to triangles and vertices of a mesh of a committed scene, without a copy.
///
/// @param scene  committed scene
/// @param mesh  number of the mesh
/// @param out  receives pointers that are valid while the scene lives, until the next
///   bk_scene_refit
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such mesh
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
BK_API bk_result bk_scene_get_mesh(const bk_scene *scene, uint32_t mesh, bk_mesh_view *out);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup instances Instances
 *
 * A mesh that stands in the scene many times is added once, with an instance for each place. It then stands where its
 * instances say, and nowhere else. Vertices and acceleration structure exist once; each instance has light of its
 * own, at coordinates of its own in the light map, unless it is to [share](bk_instance_share_light) that of another.
 *
 * A transform is 12 floats: the images of the x, y and z axis, then the translation (a 3 by 4 matrix by columns; the
 * rows of a row-major 4 by 3 matrix that row vectors are multiplied with). It must not mirror: add a mirrored mesh
 * instead.
 *
 * Thread safety: as for meshes.
 *
 * Cost: an instance takes about 200 bytes. Rays through instances of large meshes take between a
 * third of the time through copies and twice as long, through meshes of some 1,000 triangles up to
 * four times as long: see the manual, docs/performance.md.
 *
 * @{
 */
/* ============================================================================================== */

/// Adds an instance of a mesh, which from now on stands in the scene through its instances alone.
///
/// @param scene  scene that is not committed
/// @param mesh  number of the mesh, which must have been added before
/// @param transform  12 floats: where the mesh's axes and origin lie in the scene, in scene units
/// @param out_id  receives the number of the instance, as hits report it: the first is 0; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such mesh; the transform is not finite, mirrors or
///   cannot be inverted; or there would be more than 4,294,967,294 triangles or 268,435,454
///   instances
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the list of instances does not fit (the commit announces it)
BK_API
bk_result bk_scene_add_instance(bk_scene *scene,
                                uint32_t mesh,
                                const float *transform,
                                uint32_t *out_id);

/// Sets an instance to show the light of another instance of the same mesh: it gets no texels of its
/// own in light maps, and has the light map coordinates and the radiance of the other one. For meshes
/// that stand in places of much the same light so often that texels for each would be too many. The
/// light turns with the instance: a side that the sun shines on where the other one stands is bright
/// wherever it faces here, and shadows of others fall as they do there. Rays hit it where it stands,
/// and it casts shadows there. A triangle that vanishes by rounding where the other one stands has no light.
///
/// @param scene  scene that is not committed
/// @param instance  number of the instance
/// @param of  number of an instance of the same mesh, less than `instance`. If it shows the light of
///   a third one itself, both do.
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance, or `of` is not less than it or of
///   another mesh
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
BK_API bk_result bk_instance_share_light(bk_scene *scene, uint32_t instance, uint32_t of);

/// Gets the instance whose texels and light an instance shows, of a scene that is committed or not:
/// itself, unless bk_instance_share_light or a scene file said otherwise.
///
/// @param scene  any scene
/// @param instance  number of the instance
/// @param out_instance  receives the number
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance, or out_instance is NULL
/// @retval BK_ERROR_INVALID_STATE  the scene is being refitted, or another thread is changing it
BK_API bk_result bk_instance_light_of(const bk_scene *scene, uint32_t instance, uint32_t *out_instance);

/// Sets a new transform for an instance of a committed scene. Nothing changes before bk_scene_refit,
/// which applies the last transform that was set for each instance.
///
/// @param scene  committed scene
/// @param instance  number of the instance
/// @param transform  12 floats: where the mesh's axes and origin lie in the scene, in scene units
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance; or the transform is not finite,
///   mirrors or cannot be inverted
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or another thread is changing it
BK_API bk_result bk_instance_set_transform(bk_scene *scene, uint32_t instance, const float *transform);

/// Returns the number of instances of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of instances; 0 on failure
BK_API uint32_t bk_scene_instance_count(const bk_scene *scene);

/// Gets the mesh and the transform of an instance, of a scene that is committed or not.
///
/// @param scene  any scene
/// @param instance  number of the instance
/// @param out_mesh  receives the number of its mesh; may be NULL
/// @param out_transform  receives its 12 floats, in scene units; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance
/// @retval BK_ERROR_INVALID_STATE  the scene is being refitted, or another thread is changing it
BK_API
bk_result bk_scene_get_instance(const bk_scene *scene,
                                uint32_t instance,
                                uint32_t *out_mesh,
                                float *out_transform);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup lights Lights
 *
 * Lights are added to a scene before its commit and can change at any time. Emissive materials are
 * lights too, without a number.
 *
 * Thread safety: as for scenes; bk_scene_set_light on a committed scene and the functions that
 * read are safe from any thread, but before the commit fail with BK_ERROR_INVALID_STATE while
 * another thread is changing the scene.
 *
 * Cost: less than a microsecond each; bk_scene_set_light copies all lights while a bake is using
 * them.
 *
 * @{
 */
/* ============================================================================================== */

/// Point light: radiates from `position` equally in all directions. `color` is radiant intensity in
/// W/sr.
#define BK_LIGHT_POINT 1

/// Spot light: radiates from `position` in a cone around `direction`, fully up to `cone_inner` from
/// the axis, not at all beyond `cone_outer`, smoothly in between. `color` is radiant intensity on
/// the axis in W/sr.
#define BK_LIGHT_SPOT 2

/// Directional light: travels along `direction` from infinitely far away, parallel or, with an
/// `angular_radius`, from a disc of uniform radiance (the sun). `color` is irradiance in W/m2 on a
/// plane that faces the middle of the disc, with the whole disc above its horizon. A disc takes
/// bk_bake_params.direct_samples shadow rays per point.
#define BK_LIGHT_DIRECTIONAL 3

/// Rect light: a parallelogram with a corner at `position` and the edges `edge_u` and `edge_v`,
/// which radiates from the side that `edge_u` x `edge_v` points to. `color` is radiance in W/(m2
/// sr). Rays do not hit it.
#define BK_LIGHT_RECT 4

/// Sky: radiates from all directions, from infinitely far away. `color` is radiance in W/(m2 sr)
/// or, with an `environment`, the factor of the image. It takes 4 times
/// bk_bake_params.direct_samples shadow rays per point. The sky counts as direct light, as all
/// lights do; gather rays that leave the scene contribute nothing.
#define BK_LIGHT_SKY 5

/// A light. Fields that its type does not use are ignored.
typedef struct bk_light_desc {
  /// Size of this structure in bytes, set by bk_light_desc_init.
  uint32_t struct_size;
  /// One of the BK_LIGHT values. Default: BK_LIGHT_POINT.
  uint32_t type;
  /// Point, spot, rect: position, or a corner of the rect, in scene units. Default: 0.
  float position[3];
  /// Spot, directional: direction in which the light travels, a vector of any length but 0.
  /// Default: 0, to be set.
  float direction[3];
  /// Rect: an edge, in scene units. Default: 0, to be set.
  float edge_u[3];
  /// Rect: the other edge, in scene units, not parallel to `edge_u`. Default: 0, to be set.
  float edge_v[3];
  /// Linear RGB, finite and >= 0: W/sr, W/m2 or W/(m2 sr), as the BK_LIGHT values say. Default:
  /// 1.
  float color[3];
  /// Spot: half angle of the cone of full intensity, in radians, in [0, `cone_outer`]. Default:
  /// 0.
  float cone_inner;
  /// Spot: half angle of the whole cone, in radians, in (0, pi]. Default: pi/4.
  float cone_outer;
  /// Directional: radius of the disc in radians, in [0, pi/2]; less than 1e-5 counts as 0, a
  /// parallel light. The sun's is 0.00465. Default: 0.
  float angular_radius;
  /// Sky: number of the environment, or BK_NONE for the same radiance from all directions.
  /// Default: BK_NONE.
  uint32_t environment;
  /// Sky: direction of the environment's zenith, a vector of any length but 0. The front of the
  /// image looks along -z, or along +y if `up` is less than 45 degrees from the z axis, made
  /// perpendicular to `up`. Default: (0, 1, 0).
  float up[3];
  /// Sky: angle in radians by which the environment is turned about `up`, counter-clockwise as
  /// seen from its tip. Default: 0.
  float rotation;
} bk_light_desc;

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
BK_API void bk_light_desc_init(bk_light_desc *desc);

/// Adds a light.
///
/// @param scene  scene that is not committed
/// @param desc  copied
/// @param out_id  receives the number of the light; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `desc` is out of its range or names no environment
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
BK_API bk_result bk_scene_add_light(bk_scene *scene, const bk_light_desc *desc, uint32_t *out_id);

/// Replaces a light, before or after the commit; its type may change.
///
/// To remove a light, set its `color` to 0. A running bake keeps the lights with which it started;
/// call bk_live_light_changed for live objects.
///
/// @param scene  any scene
/// @param id  number of the light
/// @param desc  copied
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such light, or a field of `desc` is out of its
///   range or names no environment
/// @retval BK_ERROR_INVALID_STATE  the scene is being refitted, or is not committed and another
///   thread is changing it
BK_API bk_result bk_scene_set_light(bk_scene *scene, uint32_t id, const bk_light_desc *desc);

/// Gets a light of a scene, committed or not.
///
/// @param scene  any scene
/// @param id  number of the light
/// @param out  receives a copy of the light: its directions have length 1, fields that its type
///   does not use their defaults
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such light
/// @retval BK_ERROR_INVALID_STATE  the scene is being refitted, or is not committed and another
///   thread is changing it
BK_API bk_result bk_scene_get_light(const bk_scene *scene, uint32_t id, bk_light_desc *out);

/// Returns the number of lights of a scene, committed or not; emissive materials are not counted.
///
/// @param scene  any scene
/// @return  number of lights; 0 on failure
BK_API uint32_t bk_scene_light_count(const bk_scene *scene);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup rays Rays
 *
 * All functions take a committed scene. A closest hit is the one with the least t in tmin < t <=
 * tmax; among hits of equal t the triangle that was added first, whichever function is called.
 * Both sides of a triangle are hit. A ray with a NaN, an origin beyond a magnitude of 1e18 or a
 * zero direction hits nothing.
 *
 * Units: origins are in scene units. Directions need not have length 1; t, tmin and tmax are in
 * multiples of the direction's length.
 *
 * Thread safety: any thread, all functions at the same time; during bk_scene_refit they fail with
 * BK_ERROR_INVALID_STATE.
 *
 * Cost: grows with the logarithm of the number of triangles; the calling thread does the work
 * unless BK_RAYS_PARALLEL is set. Nothing is allocated.
 *
 * @{
 */
/* ============================================================================================== */

/// Flag: spread the rays over the device's threads. Without it the calling thread does the work.
#define BK_RAYS_PARALLEL 1

/// A ray: the points origin + t direction with tmin < t <= tmax.
typedef struct bk_ray {
  /// Origin, in scene units.
  float origin[3];
  /// Lower limit of t, exclusive, in multiples of the direction's length.
  float tmin;
  /// Direction, a vector of any length but 0, in scene units.
  float direction[3];
  /// Upper limit of t, inclusive, in multiples of the direction's length; may be infinite.
  float tmax;
} bk_ray;

/// A hit. A miss has t = +infinity, u = v = 0, and BK_NONE in the other fields.
typedef struct bk_hit {
  /// Distance in multiples of the direction's length.
  float t;
  /// Barycentric weight of the triangle's vertex 1, a fraction in [0, 1].
  float u;
  /// Barycentric weight of the triangle's vertex 2, a fraction in [0, 1].
  float v;
  /// Number of the triangle in its mesh.
  uint32_t triangle;
  /// Number of the mesh.
  uint32_t mesh;
  /// Number of the instance; BK_NONE if the mesh has none.
  uint32_t instance;
} bk_hit;

/// Finds the closest hit of one ray.
///
/// @param scene  committed scene
/// @param ray  the ray
/// @param out  receives the hit; on failure (a scene that is not committed, a NULL pointer) a miss,
///   and bk_last_error has the reason
BK_API void bk_intersect(const bk_scene *scene, const bk_ray *ray, bk_hit *out);

/// Returns whether anything lies on a ray.
///
/// @param scene  committed scene
/// @param ray  the ray
/// @return  1 or 0; 0 on failure, and bk_last_error has the reason
BK_API int32_t bk_occluded(const bk_scene *scene, const bk_ray *ray);

/// Finds the closest hits of many rays.
///
/// The call is fastest where consecutive rays share `origin`, `tmin` and `tmax` and have nearly the
/// same direction, like those of a pinhole camera in small square tiles of pixels; and where some
/// hundreds or thousands of consecutive rays start near one another, in any directions, like those of
/// neighbouring texels, which are traced together as a stream. The hits are the same, bit for bit, in
/// any order of rays.
///
/// @param scene  committed scene
/// @param rays  `count` rays, aligned to 4 bytes; may be NULL if `count` is 0
/// @param count  number of rays
/// @param flags  0 or BK_RAYS_PARALLEL
/// @param out  receives `count` hits in the order of the rays; must not overlap `rays`
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
BK_API
bk_result bk_intersect_many(const bk_scene *scene,
                            const bk_ray *rays,
                            size_t count,
                            uint32_t flags,
                            bk_hit *out);

/// Finds out for many rays whether anything lies on them.
///
/// The call is fastest where some hundreds or thousands of consecutive rays start near one another.
///
/// @param scene  committed scene
/// @param rays  `count` rays, aligned to 4 bytes; may be NULL if `count` is 0
/// @param count  number of rays
/// @param flags  0 or BK_RAYS_PARALLEL
/// @param out  receives `count` bytes, 1 or 0, in the order of the rays; must not overlap `rays`
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
BK_API
bk_result bk_occluded_many(const bk_scene *scene,
                           const bk_ray *rays,
                           size_t count,
                           uint32_t flags,
                           uint8_t *out);

/// Finds the closest hits, with 0 < t <= tmax, of rays that share an origin.
///
/// The hits are those of bk_intersect_many. The call is faster than as many single rays from 32
/// directions on, and the faster the more there are.
///
/// @param scene  committed scene
/// @param origin  origin of all rays, in scene units
/// @param directions  `count` vectors of any length, of three floats, packed, aligned to 4 bytes;
///   may be NULL if `count` is 0
/// @param count  number of directions
/// @param tmax  upper limit of t, inclusive, in multiples of a direction's length
/// @param flags  0 or BK_RAYS_PARALLEL
/// @param out  receives `count` hits in the order of the directions; must not overlap `directions`
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
BK_API
bk_result bk_gather(const bk_scene *scene,
                    const float origin[3],
                    const float *directions,
                    size_t count,
                    float tmax,
                    uint32_t flags,
                    bk_hit *out);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup photons Photon maps
 *
 * A photon map stores light on surfaces: photons are emitted by the lights in proportion to their
 * power, traced with Russian roulette, and stored where they hit diffuse surfaces. The irradiance
 * at any point is estimated from them. A photon map is complete when it has been created, and
 * never changes.
 *
 * Thread safety: any thread, all functions at the same time.
 *
 * Cost: see bk_photon_map_create and bk_photon_map_estimate; the other functions take nanoseconds.
 *
 * @{
 */
/* ============================================================================================== */

/// Flag of bk_photon_params: do not store photons that come straight from a light, so that the map
/// holds indirect light only.
#define BK_PHOTONS_INDIRECT_ONLY 1

/// Handle of a photon map.
typedef struct bk_photon_map bk_photon_map;

/// Parameters of bk_photon_map_create.
typedef struct bk_photon_params {
  /// Size of this structure in bytes, set by bk_photon_params_init.
  uint32_t struct_size;
  /// BK_PHOTONS flags. Default: 0.
  uint32_t flags;
  /// Number of photons to emit, 1 to 2^32. Each is stored on 1 / (1 - albedo) surfaces on
  /// average; a stored photon takes 96 bytes while the map is made and 48 later. Default:
  /// 1,000,000.
  uint64_t photon_count;
  /// Maximum number of surfaces that a photon hits; 0: Russian roulette alone ends its path. A
  /// path ends after 10,000 surfaces in any case. Default: 0.
  uint32_t max_bounces;
  /// Search radius of the estimate in scene units, finite and at least 1.2e-38; 0: from the
  /// density of photons. Default: 0.
  float radius;
  /// Half the height of the search cylinder, as a fraction of the radius, finite and > 0.
  /// Default: 0.25.
  float half_height;
  /// Constant of Jensen's cone filter, a ratio >= 1; +infinity: no filter. Default: 1.1.
  float cone_k;
  /// Seed of all random numbers. The same seed gives the same bits on any number of threads.
  /// Default: 0.
  uint64_t seed;
  /// Limit in bytes of the memory that the map takes while it is made; 0: no limit. Default: 0.
  uint64_t memory_budget;
} bk_photon_params;

/// Pointers to the stored photons, array by array.
typedef struct bk_photon_view {
  /// Size of this structure in bytes, set by bk_photon_view_init.
  uint32_t struct_size;
  /// Search radius in use, in scene units.
  float radius;
  /// Number of stored photons.
  size_t count;
  /// `count` positions of three floats, packed, in scene units.
  const float *position;
  /// `count` directions of travel of three floats, packed, unit vectors.
  const float *direction;
  /// `count` powers of three floats (RGB), packed, in W.
  const float *power;
} bk_photon_view;

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
BK_API void bk_photon_params_init(bk_photon_params *params);

/// Creates a photon map: traces photons through a committed scene, on the device's threads.
///
/// The map keeps the parts of the scene alive that it needs. Lights without power make an empty
/// map.
///
/// Cost: 3 to 7 million rays per second on two threads; a photon takes 1 / (1 - albedo) rays on
/// average.
///
/// @param scene  committed scene
/// @param params  parameters; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the photon map, which the caller releases with bk_photon_map_release; NULL
///   on failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed, is being refitted, or has no lights
/// @retval BK_ERROR_OUT_OF_MEMORY  the map does not fit into `memory_budget` or the memory callback
///   refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_photon_map_create(const bk_scene *scene,
                               const bk_photon_params *params,
                               bk_progress_fn progress,
                               void *user,
                               bk_photon_map **out);

/// Adds one reference.
///
/// @param map  NULL is ignored
BK_API void bk_photon_map_retain(bk_photon_map *map);

/// Releases one reference.
///
/// @param map  NULL is ignored
BK_API void bk_photon_map_release(bk_photon_map *map);

/// Estimates the irradiance at points of surfaces, on the side that the normal points to.
///
/// The estimate assumes that the search disc lies wholly on the surface: nearer than a radius to an
/// edge it falls, to half at the edge, and photons behind a wall that crosses the disc count.
/// Positions and normals that are not finite give 0.
///
/// Cost: in proportion to the number of photons within the search radius, on the calling thread.
///
/// @param map  photon map
/// @param positions  `count` positions of three floats in scene units, packed, aligned to 4 bytes
/// @param normals  `count` unit vectors of three floats, packed, aligned to 4 bytes
/// @param count  number of points; if 0, the arrays may be NULL
/// @param out_irradiance_rgb  receives `count` times three floats in W/m2, packed, finite, 0 to
///   1e30; must not overlap the inputs
/// @retval BK_ERROR_INVALID_ARGUMENT  an array is NULL, not aligned, or overlaps the output
BK_API
bk_result bk_photon_map_estimate(const bk_photon_map *map,
                                 const float *positions,
                                 const float *normals,
                                 size_t count,
                                 float *out_irradiance_rgb);

/// Sets `struct_size` and clears the other fields.
///
/// @param view  structure to fill in; NULL is ignored
BK_API void bk_photon_view_init(bk_photon_view *view);

/// Gets pointers to the stored photons.
///
/// Cost: the first call packs them into 36 bytes of memory each, which stay while the map lives.
///
/// @param map  photon map
/// @param out  receives pointers that are valid while the map lives; if `count` is 0, they must not
///   be read
/// @retval BK_ERROR_OUT_OF_MEMORY  the memory callback refuses the packed copy
BK_API bk_result bk_photon_map_get_photons(const bk_photon_map *map, bk_photon_view *out);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup lightmap Light maps
 *
 * A light map lays the surfaces of a committed scene out on square pages and, once baked, holds
 * irradiance E (W/m2) per texel: a shader shows albedo / pi * E. Texel (0, 0) is at uv (0, 0);
 * rows follow v. Indirect light is computed in two coarser maps with the same charts: the radiance
 * map, which gather rays look up, and the gather map.
 *
 * Thread safety: one thread at a time may bake a light map; reads are safe from any thread. A read
 * during a bake, and a second bake, fail with BK_ERROR_INVALID_STATE.
 *
 * Cost: see bk_lightmap_create; the other functions copy their results.
 *
 * @{
 */
/* ============================================================================================== */

/// Handle of a light map: a layout and, once baked, light.
typedef struct bk_lightmap bk_lightmap;

/// Parameters of bk_lightmap_create.
///
/// Measured curves of these fields: docs/accuracy.md, "Which knobs have a curve".
typedef struct bk_lightmap_desc {
  /// Size of this structure in bytes, set by bk_lightmap_desc_init.
  uint32_t struct_size;
  /// Density of unwrapped charts in texels per scene unit, finite and >= 0; 0: chosen so that the
  /// scene fills about one page. All pages of a map together hold at most 2^29 texels. Raise it
  /// for sharper shadows and narrow gaps: memory and most of the time grow with its square, and
  /// in the Cornell box the error fell to a quarter when it was doubled from 8 to 16 and to 43 %
  /// from 16 to 32. Default: 0.
  float texels_per_unit;
  /// Width and height of a page in texels, 16 to 16384. Raise it to the largest page that the
  /// graphics card takes well, if charts are reduced (bk_lightmap_info.reduced_charts) or pages
  /// are many; the error does not depend on it while no charts are reduced. Default: 1024.
  uint32_t page_size;
  /// Distance around each chart that filtering may read, in texels, 1 to 64 and at most a quarter
  /// of `page_size`. Raise it to 2^n for n mip levels, or to the block of a texture compression;
  /// it costs texels between charts. Default: 2.
  uint32_t padding;
  /// Number of light map texels per texel of the gather map, along each axis, 1 to 64. Lower it
  /// to 2 or 1 for contact shadows and narrow places, the first field to change; the time of the
  /// gather map grows with the inverse square. 8 has 7 times the error of 4 in the Cornell box.
  /// Default: 4.
  uint32_t gather_divisor;
  /// Number of light map texels per texel of the radiance map, along each axis, 1 to 64. Lower it
  /// to 2 or 1 near lamps and where the sun comes through small openings; the time of the
  /// radiance map grows with the inverse square. Default: 4.
  uint32_t radiance_divisor;
  /// 1: two-sided charts that can be seen from open places on both sides get separate texels for
  /// their backs, see bk_lightmap_mesh_back_uvs. Open places are points with free space around
  /// them; those outside of buildings count if a directional light or a sky shines when the light
  /// map is created. 0: no separate texels; each two-sided chart shows the side that can be seen,
  /// or the one that the bake chooses (bk_bake_stats.back_charts). Set it to 0 where nobody sees
  /// both sides of a sheet: backs took 6 % of the texels in a living room and 23 % in Sponza.
  /// Default: 1.
  uint32_t both_sides;
  /// Number of boxes in `seen_from`, at most 4096. Default: 0.
  uint32_t seen_from_count;
  /// From where the scene is looked at: boxes of six floats each, the least and the greatest
  /// coordinates, the same for a point; copied by the call. Charts that cannot be seen from there
  /// have a single texel each, and their light costs next to nothing. They still reflect light.
  /// Charts with light map coordinates of the caller keep their texels. Set it where the camera
  /// stays in some rooms or on paths: in closed rooms half of the texels and more are never seen.
  /// bk_lightmap_info.unseen_charts and spared_texels count them. NULL: from anywhere. Default:
  /// NULL.
  const float *seen_from;
} bk_lightmap_desc;

/// Numbers about the layout of a light map.
typedef struct bk_lightmap_info {
  /// Size of this structure in bytes, set by bk_lightmap_info_init.
  uint32_t struct_size;
  /// Number of pages.
  uint32_t page_count;
  /// Width of each page in texels.
  uint32_t width;
  /// Height of each page in texels.
  uint32_t height;
  /// Number of charts: pieces of surface with continuous light map coordinates.
  uint32_t charts;
  /// Number of charts that have the caller's coordinates.
  uint32_t given_charts;
  /// Number of charts that were made by unwrapping.
  uint32_t unwrapped_charts;
  /// Number of charts whose density was reduced so that they fit a page.
  uint32_t reduced_charts;
  /// Number of charts with separate texels for their backs, see bk_lightmap_desc.both_sides.
  uint32_t both_sided_charts;
  /// Density in use, in texels per scene unit.
  float texels_per_unit;
  /// Number of texels that a triangle covers: the range of texel_begin and texel_end of
  /// bk_bake_params.
  uint64_t texels;
  /// Number of texels of the gather map.
  uint64_t gather_texels;
  /// Number of texels of the radiance map.
  uint64_t radiance_texels;
  /// Size of the light map in bytes.
  uint64_t bytes;
  /// Number of triangles that were unwrapped because their given coordinates lie outside [0, 1].
  uint64_t uv_out_of_range;
  /// Number of triangles that were unwrapped because they have an area in space and none in their
  /// given coordinates.
  uint64_t uv_degenerate;
  /// Number of texels whose centre is covered by several triangles of given coordinates.
  uint64_t uv_overlapping_texels;
  /// Duration of unwrapping in seconds.
  double unwrap_seconds;
  /// Number of texels that belong to backs: the last ones of `texels`.
  uint64_t back_texels;
  /// Number of charts that cannot be seen from bk_lightmap_desc.seen_from.
  uint64_t unseen_charts;
  /// Number of texels that they would have had, roughly.
  uint64_t spared_texels;
  /// Number of charts whose texels bk_lightmap_create_from took over, all or some.
  uint64_t kept_charts;
} bk_lightmap_info;

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
BK_API void bk_lightmap_desc_init(bk_lightmap_desc *desc);

/// Creates a light map of a committed scene: meshes with light map coordinates keep them, the
/// others are unwrapped, and texels are mapped to triangles, on the device's threads.
///
/// The light map keeps the geometry of the scene as it is now until bk_lightmap_follow, and follows
/// its lights. Logs a
/// warning if the scene lies so far from the origin that rays start more than a quarter of a texel
/// above surfaces (32 rounding steps of its coordinates).
///
/// Cost: most of the time goes into unwrapping, 20 to 50 s per million triangles and thread.
///
/// @param scene  committed scene, kept alive by the light map
/// @param desc  parameters; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the light map, which the caller releases with bk_lightmap_release; NULL on
///   failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `desc` is out of its range, or a mesh names a page
///   beyond 2^29 texels
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
/// @retval BK_ERROR_OUT_OF_MEMORY  there would be more than 2^29 texels, they do not fit, or the
///   memory callback refuses
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_lightmap_create(const bk_scene *scene,
                             const bk_lightmap_desc *desc,
                             bk_progress_fn progress,
                             void *user,
                             bk_lightmap **out);

/// Creates a light map as bk_lightmap_create does, of a scene that was described anew after meshes
/// were added, removed or edited, and takes over from the light map of the scene before: curved
/// surfaces that both scenes have keep their charts, and texels far from all changes are not
/// searched for those that nobody can see. bk_bake_changed_from then keeps their light.
///
/// Meshes, and triangles in them, are the same if all their numbers are, bit for bit, in the same
/// place. Far is more than four texels from boxes around all that only one of the scenes has, and
/// more than its width from a chart with a side that is seen now and was not, or the other way
/// round; that a texel sees nothing but backs farther away is not noticed. Where charts lie on their
/// pages depends on all of them: UVs are new. With another `desc`, with `texels_per_unit` 0 (which
/// then is another density), or if a lamp was moved, added or removed, charts are taken over, and
/// all texels are searched. bk_lightmap_info.kept_charts says of how many charts texels were taken
/// over.
///
/// Cost: that of matching triangles, up to a second per million, of laying out the pages, and of
/// unwrapping new surfaces. Measured beside bk_lightmap_create: docs/performance.md, "Edits".
///
/// @param scene  committed scene, kept alive by the light map
/// @param desc  parameters; NULL for the defaults
/// @param earlier  light map of the scene before, baked or not, on any device
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the light map, which the caller releases with bk_lightmap_release; NULL on
///   failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `desc` is out of its range, a mesh names a page
///   beyond 2^29 texels, or `earlier` is NULL
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted, or another call
///   is changing the earlier light map
/// @retval BK_ERROR_OUT_OF_MEMORY  there would be more than 2^29 texels, they do not fit, or the
///   memory callback refuses
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_lightmap_create_from(const bk_scene *scene,
                                  const bk_lightmap_desc *desc,
                                  const bk_lightmap *earlier,
                                  bk_progress_fn progress,
                                  void *user,
                                  bk_lightmap **out);

/// Updates a light map to the geometry of its scene after bk_scene_refit. Charts, pages and UVs
/// stay as they are, and so do an engine's vertex buffers. Without this call the light map keeps
/// the old geometry.
///
/// Buried texels are searched again around moved surfaces; the sides of two-sided surfaces that
/// have texels, and the density of texels, stay as they were at bk_lightmap_create. The light stays
/// until the next bake; bk_bake_changed bakes it where it has changed. Until then the light map
/// keeps the scene in both states in memory. bk_live_follow updates
/// live objects.
///
/// Cost: half a second per million texels and thread. Does nothing if the light map has the state
/// of the scene already.
///
/// @param lightmap  any light map of the scene
/// @param scene  the scene from which the light map was created, after a refit
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  the light map is of another scene
/// @retval BK_ERROR_INVALID_STATE  a triangle with texels has become degenerate or not finite;
///   bk_last_error names it. Or the scene is being refitted, or another call is using the light map
/// @retval BK_ERROR_OUT_OF_MEMORY  the texels do not fit, or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_lightmap_follow(bk_lightmap *lightmap,
                             const bk_scene *scene,
                             bk_progress_fn progress,
                             void *user);

/// Saves charts and texels of a light map, but no light, to be loaded by bk_lightmap_load_layout
/// where the same scene is lit again.
///
/// Experimental: another version of the library may refuse the file.
///
/// Cost: a part of a second for a million texels.
///
/// @param lightmap  light map, baked or not
/// @param path  name of the file, which is replaced as a whole or not at all; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  a buffer does not fit
/// @retval BK_ERROR_IO  the file cannot be written; bk_last_error names it
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_EXPERIMENTAL
bk_result bk_lightmap_save_layout(const bk_lightmap *lightmap,
                                  const char *path,
                                  bk_progress_fn progress,
                                  void *user);

/// Creates the light map whose layout bk_lightmap_save_layout wrote, as bk_lightmap_create would,
/// with the same bits, without unwrapping.
///
/// If the file is refused, create the light map anew and save its layout.
///
/// Files from untrusted sources are safe to load: every number is checked. Charts may lie anywhere
/// on their pages, though.
///
/// Experimental: another version of the library may refuse the file.
///
/// Cost: a part of a second for a million triangles.
///
/// @param scene  committed scene, kept alive by the light map
/// @param desc  parameters with which the light map was created; NULL for the defaults
/// @param path  name of the file; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the light map, which the caller releases with bk_lightmap_release; NULL on
///   failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `desc` is out of its range, or the file is of another
///   scene, other parameters, another version of the library or instruction set (AVX2 and AVX-512
///   count as one), or with sun or sky instead of without; bk_last_error says which
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
/// @retval BK_ERROR_IO  the file cannot be read, is damaged, or is another kind of file;
///   bk_last_error names it
/// @retval BK_ERROR_OUT_OF_MEMORY  the light map does not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_EXPERIMENTAL
bk_result bk_lightmap_load_layout(const bk_scene *scene,
                                  const bk_lightmap_desc *desc,
                                  const char *path,
                                  bk_progress_fn progress,
                                  void *user,
                                  bk_lightmap **out);

/// Adds one reference.
///
/// @param lightmap  NULL is ignored
BK_API void bk_lightmap_retain(bk_lightmap *lightmap);

/// Releases one reference.
///
/// @param lightmap  NULL is ignored
BK_API void bk_lightmap_release(bk_lightmap *lightmap);

/// Sets `struct_size` and clears the other fields.
///
/// @param info  structure to fill in; NULL is ignored
BK_API void bk_lightmap_info_init(bk_lightmap_info *info);

/// Gets numbers about the layout of a light map.
///
/// @param lightmap  any light map
/// @param out  receives the numbers
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
BK_API bk_result bk_lightmap_get_info(const bk_lightmap *lightmap, bk_lightmap_info *out);

/// Copies the light map coordinates of the triangles of a mesh.
///
/// @param lightmap  any light map
/// @param mesh  number of the mesh
/// @param out_corner_uvs  receives u and v in [0, 1] of each corner, 6 floats per triangle, aligned
///   to 4 bytes; may be NULL
/// @param out_page_per_triangle  receives the page of each triangle, BK_NONE for triangles without
///   texels, aligned to 4 bytes; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such mesh, or it has instances
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  a copy does not fit
BK_API
bk_result bk_lightmap_mesh_uvs(const bk_lightmap *lightmap,
                               uint32_t mesh,
                               float *out_corner_uvs,
                               uint32_t *out_page_per_triangle);

/// Copies the light map coordinates of the backs of the triangles of a mesh.
///
/// A shader that reads `gl_FrontFacing ? uv : back_uv`, and the page accordingly, shows the right
/// light on both sides. Where a back has no separate texels (see bk_lightmap_desc.both_sides), its
/// coordinates and page are those of the front.
///
/// @param lightmap  any light map
/// @param mesh  number of the mesh
/// @param out_corner_uvs  receives u and v in [0, 1] of each corner, 6 floats per triangle, aligned
///   to 4 bytes; may be NULL
/// @param out_page_per_triangle  receives the page of each triangle, BK_NONE for triangles without
///   texels, aligned to 4 bytes; may be NULL
/// @param out_separate_per_triangle  receives one byte per triangle: 1 if the back has separate
///   texels, else 0; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such mesh, or it has instances
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  a copy does not fit
BK_API
bk_result bk_lightmap_mesh_back_uvs(const bk_lightmap *lightmap,
                                    uint32_t mesh,
                                    float *out_corner_uvs,
                                    uint32_t *out_page_per_triangle,
                                    uint8_t *out_separate_per_triangle);

/// Copies the light map coordinates of the triangles of an instance.
///
/// @param lightmap  any light map
/// @param instance  number of the instance
/// @param out_corner_uvs  receives u and v in [0, 1] of each corner, 6 floats per triangle of its
///   mesh, aligned to 4 bytes; may be NULL
/// @param out_page_per_triangle  receives the page of each triangle, BK_NONE for triangles without
///   texels, aligned to 4 bytes; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  a copy does not fit
BK_API
bk_result bk_lightmap_instance_uvs(const bk_lightmap *lightmap,
                                   uint32_t instance,
                                   float *out_corner_uvs,
                                   uint32_t *out_page_per_triangle);

/// Copies the light map coordinates of the backs of the triangles of an instance, as
/// bk_lightmap_mesh_back_uvs does for a mesh.
///
/// @param lightmap  any light map
/// @param instance  number of the instance
/// @param out_corner_uvs  receives u and v in [0, 1] of each corner, 6 floats per triangle of its
///   mesh, aligned to 4 bytes; may be NULL
/// @param out_page_per_triangle  receives the page of each triangle, BK_NONE for triangles without
///   texels, aligned to 4 bytes; may be NULL
/// @param out_separate_per_triangle  receives one byte per triangle: 1 if the back has separate
///   texels, else 0; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  a copy does not fit
BK_API
bk_result bk_lightmap_instance_back_uvs(const bk_lightmap *lightmap,
                                        uint32_t instance,
                                        float *out_corner_uvs,
                                        uint32_t *out_page_per_triangle,
                                        uint8_t *out_separate_per_triangle);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup bake Baking
 *
 * A bake computes the light of a light map in stages: photons, radiance map, gather map (indirect
 * light), direct light, composition, stitching of seams. Stages that the scene does not need are
 * left out.
 *
 * Thread safety: one thread at a time may bake a light map; a second one fails with
 * BK_ERROR_INVALID_STATE.
 *
 * Cost: see bk_bake; the other functions take microseconds at most.
 *
 * @{
 */
/* ============================================================================================== */

/// Bit of left_out: indirect light with photons, radiance map and gather map.
#define BK_LEFT_OUT_INDIRECT 1

/// Bit of left_out: photons and their estimate, so that no light is reflected more than once.
#define BK_LEFT_OUT_PHOTONS 2

/// Bit of left_out: direct light, as the scene has no lights.
#define BK_LEFT_OUT_DIRECT 4

/// Bit of left_out: sampling of area lights.
#define BK_LEFT_OUT_AREA_LIGHTS 8

/// Bit of left_out: radiance of back sides.
#define BK_LEFT_OUT_BACK_SIDES 16

/// Bit of left_out: blur of the gather map.
#define BK_LEFT_OUT_BLUR 32

/// Bit of left_out: unwrapping, as all meshes have usable light map coordinates.
#define BK_LEFT_OUT_UNWRAP 64

/// Bit of left_out: interpolation of shading normals.
#define BK_LEFT_OUT_SHADING_NORMALS 128

/// Bit of left_out: look-ups of albedo textures.
#define BK_LEFT_OUT_TEXTURES 256

/// Bit of left_out: alpha tests.
#define BK_LEFT_OUT_CUTOUTS 512

/// Bit of left_out: light that passes through surfaces.
#define BK_LEFT_OUT_TRANSMISSION 1024

/// Bit of left_out: light of skies.
#define BK_LEFT_OUT_SKY 2048

/// Bit of left_out: discs of directional lights.
#define BK_LEFT_OUT_SUN_DISC 4096

/// Bit of left_out: sampling of many lights, as there are at most 64 point and spot lights, each of
/// which gets a shadow ray, and at most 64 rect lights and emissive triangles. More of either kind
/// are sampled with up to 4 times bk_bake_params.direct_samples shadow rays for all of them.
#define BK_LEFT_OUT_MANY_LIGHTS 8192

/// Bit of left_out: stitching of seams.
#define BK_LEFT_OUT_SEAMS 16384

/// Bit of left_out: sampling of bright patches of surfaces as lights, as gather rays find most of
/// them.
#define BK_LEFT_OUT_BRIGHT_PATCHES 32768

/// Bit of left_out: light by direction, as bk_bake_params.directional_indirect and directional_direct
/// are 0.
#define BK_LEFT_OUT_DIRECTIONAL 65536

/// Quality: a look within a fraction of the default's time. Indirect light is coarse, penumbrae are
/// noisy.
#define BK_QUALITY_PREVIEW 0

/// Quality: the defaults.
#define BK_QUALITY_MEDIUM 1

/// Quality: final light. Finer maps; corners, gaps and contacts are computed instead of looked up.
#define BK_QUALITY_HIGH 2

/// Quality: paths from every texel, without blur, in 4 passes, to compare others with. No error of
/// it stays if `passes` is raised or `target_error` set.
#define BK_QUALITY_REFERENCE 3

/// Stage of bk_bake_share: tracing of photons.
#define BK_SHARE_PHOTONS 0

/// Stage of bk_bake_share: the radiance map, which needs the photons of all shares.
#define BK_SHARE_RADIANCE 1

/// Parameters of bk_bake.
///
/// Measured curves of these fields: docs/accuracy.md, "Which knobs have a curve".
typedef struct bk_bake_params {
  /// Size of this structure in bytes, set by bk_bake_params_init.
  uint32_t struct_size;
  /// Maximum number of reflections of light before it reaches a texel; 0: Russian roulette alone
  /// decides. Leave it at 0: a limit saves little time and darkens closed bright rooms (with 4,
  /// the indirect light of the Cornell box is 9 % too low). Default: 0.
  uint32_t max_bounces;
  /// Number of photons to emit, at most 2^32; 0: no light that is reflected more than once. A
  /// pilot of up to 3/16 as many, at most 196,608, finds out beforehand where to send them. Raise
  /// it against blotches that are the same with every number of gather rays; time and memory of
  /// the photons grow in proportion, and beyond 1,000,000 the error fell by a tenth in the
  /// Cornell box. Default: 1,000,000.
  uint64_t photon_count;
  /// Number of rays per texel of the gather map, at most 65536; 0: no indirect light. Each 64
  /// rays are accompanied by up to 32 shadow rays to bright patches of surfaces, where there are
  /// any (BK_LEFT_OUT_BRIGHT_PATCHES). Light map texels for which none of the gather texels
  /// around is a valid source of interpolation (1 to 3 %), and those beyond
  /// `interpolation_error` or `interpolation_contrast`, trace `own_rays` themselves.
  /// Raise it to 256 for final light: noise falls with its root, the time of the gather map grows
  /// in proportion; 32 suffice for a preview. Default: 128.
  uint32_t gather_rays;
  /// Search radius of photons in scene units, finite and at least 1.2e-38; 0: from the number of
  /// photons that reach surfaces and the lit area, and at least three quarters of a texel of the
  /// radiance map, so that no photon lies between the discs of the estimates. Photons (and area
  /// of the disc) that are occluded from the centre of the disc, for example behind a wall, are
  /// excluded from the estimate. Leave it at 0; a larger radius has less noise, takes more time
  /// per estimate, and blurs the light behind furniture; half of the automatic one has 1.5 times
  /// the error in the Cornell box. Default: 0.
  float radius;
  /// Distance, in texels of the radiance map, up to which the light reflected where a gather ray
  /// hits is computed by a short path instead of looked up, 0 to infinity; 0: never. Set it to 1 for
  /// final light, where corners, gaps behind furniture and contacts matter: a fifth to a half more
  /// time. INFINITY traces paths from every hit, where `photon_count` may be 0: nothing but surfaces
  /// behind sheets that transmit is looked up in the radiance map, and the error falls as long as
  /// `gather_rays` are raised, from several times the noise. Default: 0.
  float near_hits;
  /// Radius of the gather map's blur in texels of the gather map, at most 16; 0: no blur. Lower
  /// it to 1 or 0, with more gather rays, where contact shadows matter; it costs little time. 4
  /// blurs more than it smooths. With 0 the noise of direct light from skies, area lights and many
  /// lights stays, too, which is averaged over up to 9 × 9 texels of the light map otherwise, as
  /// far as they differ by no more than noise. Default: 2.
  uint32_t blur_radius;
  /// Number of shadow rays per light map texel and area light or disc of a directional light, 1
  /// to 4096. More than four area lights share four times as many rays; a sky takes four times as
  /// many, and many lights together do (BK_LEFT_OUT_MANY_LIGHTS). The rays start from 4 points of
  /// the texel, or from 16 in the penumbra of a disc. Point, spot and parallel lights take one
  /// ray each, and 4 to 16 more, spread over the texel, where shadow edges cross it. Raise it to
  /// 64 where soft shadows are grainy; the time of direct light of area lights, discs and skies
  /// grows in proportion. Default: 16.
  uint32_t direct_samples;
  /// Seed of all random numbers. The same seed gives the same bits on any number of threads.
  /// Change it to see which part of an error is noise; it costs nothing. Default: 0.
  uint64_t seed;
  /// Limit in bytes of the memory that the bake takes in addition to scene and light map; 0: no
  /// limit. Set it where a failed call is better than a full machine; coarser maps and fewer
  /// photons take less. Default: 0.
  uint64_t memory_budget;
  /// Number of the first covered texel to bake, to spread a bake over several runs; at most
  /// bk_lightmap_info.texels. Ranges share out the gather map and direct light only: each run
  /// traces all photons and fills the whole radiance map. Default: 0.
  uint64_t texel_begin;
  /// Number of the covered texel behind the last one to bake, above `texel_begin` and at most
  /// bk_lightmap_info.texels; 0: all. See `texel_begin`. Default: 0.
  uint64_t texel_end;
  /// 1: stitch seams. Where a smooth surface is cut in the light map, the texels along the edge
  /// are changed so that both sides look the same under bilinear filtering, but for points where
  /// the texels of both sides face more than 30 degrees apart or have light that differs by more
  /// than a factor of 4. Seams are stitched when all texels are baked. Live updates do not
  /// stitch: their finished texels have the bits of a bake with 0. 0: leave seams as they are.
  /// Set it to 0 where results are compared with live updates or seams do not matter; it takes
  /// bk_bake_stats.seam_seconds. Default: 1.
  uint32_t stitch;
  /// Experimental: interval in seconds between two writes of the checkpoint, 0 to 1e9. A process
  /// that is killed loses at most the work of this interval; with 0, that of the blocks of texels
  /// under way. Lower it where machines are taken away without notice; flushes to disk never take
  /// more than a hundredth of the time. Default: 10.
  float checkpoint_seconds;
  /// Experimental: name of the checkpoint, a file in which the bake keeps finished work; UTF-8.
  /// May be NULL: no checkpoint. Default: NULL.
  ///
  /// A bake with the same scene, lights, light map and parameters that finds the file continues
  /// from it, whether the bake before was cancelled, failed or was killed, and gives the bits of
  /// an uninterrupted bake, on any number of threads. The file is created if it does not exist
  /// and stays when the bake is complete: delete it when the light has been saved. If the file
  /// cannot be written later, for example because the disk is full, the bake continues and logs a
  /// warning, and the file stays readable. See bk_bake for errors, which leave the file as it is.
  const char *checkpoint;
  /// 1: compute light that was reflected by other surfaces by direction too (SH L1), for surfaces
  /// with normal maps. Reading starts at BK_LAYER_L0. It comes from the same rays; in memory it
  /// takes 48 bytes per texel of the light map, and during the bake 96 per texel of the gather
  /// map. bk_live_params has the same fields. Default: 0.
  uint32_t directional_indirect;
  /// 1: the same for light that comes straight from lights, for 48 bytes more per texel of the light
  /// map during the bake. With both, the layers hold the sum.
  /// Set only `directional_indirect` where the application draws the lights itself. Default: 0.
  uint32_t directional_direct;
  /// Number of passes, 1 to 4096: whole bakes with different random numbers, whose mean is the
  /// light. n of them take n times as long and have 1/n of the noise's variance, that of photons
  /// included. From two on, BK_LAYER_ERROR and bk_bake_stats.error estimate the noise that is
  /// left, and light can be read from two halves of the passes, for denoisers
  /// (BK_LAYER_FIRST_HALF). The bake takes 61 bytes more per texel of the light map, 36 of which
  /// stay. A checkpoint grows with each pass. Default: 1.
  uint32_t passes;
  /// If > 0, there are as many passes as it takes, at least 4 and `passes` and at most 4096, until
  /// bk_bake_stats.error is no larger; for bakes of all texels only. 0.05 is a good preview, 0.01
  /// is hard to see. Errors by blur and coarse maps are not noise and stay: see near_hits,
  /// blur_radius and bk_lightmap_desc.gather_divisor, or bk_quality_set. Default: 0.
  float target_error;
  /// Estimated error of interpolation between texels of the gather map above which texels of the
  /// light map trace rays themselves, as in corners, behind furniture and under arches; > 0,
  /// INFINITY: only where there is nothing to interpolate. It is the width of a gather texel by
  /// the harmonic mean distance of the surfaces that it sees, plus 4 times the root of 1 − cos of
  /// the angle between normals (after Ward, Rubinstein and Clear 1988), plus, outside of gaps
  /// narrower than a gather texel, 3 times the distance, in widths of a gather texel, between the
  /// texel and the mean position of the gather texels that nothing hides from it. Light that is
  /// gathered because of this distance alone counts only as far as it differs from the interpolated one
  /// by more than noise, unless interpolation_contrast is INFINITY. 0.5 for final light;
  /// INFINITY for a preview, or where a scene is open and flat. 1 halves the error of a furnished
  /// room for a tenth more time, and takes up to a quarter more elsewhere: docs/accuracy.md,
  /// "Interpolation error". Default: 1.5.
  float interpolation_error;
  /// Contrast of the light of the texels of the gather map between which a texel of the light map
  /// interpolates, above which it traces rays itself, as at the edges of sunlit spots and of
  /// shadows of indirect light; > 0, INFINITY: never, as for a preview. It is the standard deviation
  /// of their light divided by their mean, without the part that their noise explains. The light that
  /// such a texel gathers counts as far as it differs from the interpolated one by more than noise:
  /// docs/accuracy.md, "Interpolation contrast". Default: 0.15.
  float interpolation_contrast;
  /// Number of rays of texels of the light map that trace rays themselves, at most 64, and no more
  /// than `gather_rays`; 0: as many as `gather_rays`, at most 64. Those with few others beside them
  /// have twice as many, within the same limits. With 16 a bake takes 2 to 10 % less time, for up to
  /// 29 % more error: docs/accuracy.md, "Rays of texels that gather for themselves". Default: 0.
  uint32_t own_rays;
  /// Number of shares of bk_bake_share, 1 to 65,536; not read if `shares` is NULL. Default: 0.
  uint32_t share_count;
  /// Experimental: beginning of the names of the files that bk_bake_share writes, for example "out/"
  /// for files in the folder out, which must exist; UTF-8. bk_bake then neither traces photons nor
  /// fills the radiance map, but reads the radiance map of all shares from their files, and
  /// photons and the radiance map of bk_bake_stats are without rays of the shares. May be NULL:
  /// there are no shares. Default: NULL.
  const char *shares;
} bk_bake_params;

/// Numbers about one stage of a bake.
typedef struct bk_stage_stats {
  /// Duration in seconds.
  double seconds;
  /// Number of rays traced.
  uint64_t rays;
  /// Size of the stage's buffers in bytes.
  uint64_t bytes;
} bk_stage_stats;

/// Numbers about a bake.
typedef struct bk_bake_stats {
  /// Size of this structure in bytes, set by bk_bake_stats_init.
  uint32_t struct_size;
  /// BK_LEFT_OUT bits: work that the scene does not need.
  uint32_t left_out;
  /// Duration of the whole bake in seconds.
  double seconds;
  /// Maximum of the memory that the device's objects held at once, in bytes, scene and light map
  /// included.
  uint64_t peak_bytes;
  /// Number of photons emitted.
  uint64_t photons_emitted;
  /// Number of photons stored on surfaces.
  uint64_t photons_stored;
  /// Tracing and sorting of photons.
  bk_stage_stats photons;
  /// Radiance map: outgoing radiance from photons and direct light.
  bk_stage_stats radiance;
  /// Gather map: indirect light.
  bk_stage_stats gather;
  /// Direct light with shadow rays.
  bk_stage_stats direct;
  /// Filtering and composition.
  bk_stage_stats compose;
  /// Number of two-sided charts whose texels show the back, because the distance that is seen
  /// from it times the cube root of its light is more than twice that of the front.
  uint64_t back_charts;
  /// Number of points along stitched edges, at most half a texel apart.
  uint64_t seam_points;
  /// Difference of light between the two sides of stitched edges under bilinear filtering, before
  /// the stitching: root mean square over the length of the edges, relative to the mean
  /// irradiance there. 0 without seams.
  double seam_rms_before;
  /// The same relative difference after the stitching.
  double seam_rms_after;
  /// Duration of finding and stitching seams, in seconds.
  double seam_seconds;
  /// Estimated relative error of the irradiance, as far as it is noise: the root of the mean over
  /// texels and channels of its variance by its square; texels darker than a tenth of the mean
  /// count as if they were so bright. 0 after a single pass, which gives no estimate.
  double error;
  /// Number of passes. Seconds, rays and photons above are sums over them.
  uint64_t passes;
  /// Number of texels that kept all of their light; 0 unless bk_bake_changed or
  /// bk_bake_changed_from baked.
  uint64_t kept_texels;
} bk_bake_stats;

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
BK_API void bk_bake_params_init(bk_bake_params *params);

/// Sets the fields that trade error for time to those of a quality, and leaves all others: density,
/// seed, budget and so on. Measured error and time: docs/accuracy.md, "Qualities".
///
/// bk_lightmap_desc: `gather_divisor`, `radiance_divisor`. bk_bake_params: `photon_count`,
/// `gather_rays`, `near_hits`, `interpolation_error`, `interpolation_contrast`, `blur_radius`,
/// `direct_samples`, `passes`.
///
/// @param quality  one of the BK_QUALITY values
/// @param desc  structure that bk_lightmap_desc_init has filled in; may be NULL
/// @param params  structure that bk_bake_params_init has filled in; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such quality, or a `struct_size` is wrong; nothing
///   is set
BK_API bk_result bk_quality_set(uint32_t quality, bk_lightmap_desc *desc, bk_bake_params *params);

/// Sets `struct_size` and clears the other fields.
///
/// @param stats  structure to fill in; NULL is ignored
BK_API void bk_bake_stats_init(bk_bake_stats *stats);

/// Bakes a light map: computes the light of all texels, or of a range, on the device's threads.
///
/// Can be called again, with other lights or parameters. The same scene, lights, light map,
/// parameters and seed give the same bits on any number of threads, in one bake or in several of
/// some texels each, and on AVX2 and AVX-512; the portable kernels, which round products and sums
/// separately, give others. All light is finite and >= 0: the irradiance of each light is clamped
/// to 1e30 W/m2. A bake that fails or is cancelled keeps the light of earlier bakes, and can be
/// repeated.
///
/// Cost: seconds to hours, in proportion to the number of texels, `gather_rays` and
/// `direct_samples`.
///
/// @param lightmap  any light map
/// @param params  parameters; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives numbers about the bake; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range, or the checkpoint or a
///   share is of another bake; bk_last_error says in which respect
/// @retval BK_ERROR_INVALID_STATE  another call is using the light map, or another bake the
///   checkpoint
/// @retval BK_ERROR_OUT_OF_MEMORY  `memory_budget` is exceeded or the memory callback refuses
/// @retval BK_ERROR_IO  the checkpoint or a share is damaged, is another kind of file, or cannot be
///   read, or the checkpoint cannot be created
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_bake(bk_lightmap *lightmap,
                  const bk_bake_params *params,
                  bk_progress_fn progress,
                  void *user,
                  bk_bake_stats *out);

/// Bakes a light map again where its light has changed, after lights were set (bk_scene_set_light)
/// or the scene has moved (bk_lightmap_follow).
///
/// Photons are traced again; texels of the radiance map that they and lamps reach as before keep
/// their radiance. Indirect light is computed again around moved
/// surfaces, and where probes find it changed: rays from one or two texels of every 8 x 8 texels of
/// the gather map, traced in the scene before and after. Direct light is computed again where a
/// moved surface lies, or lay, in the way to a light, and everywhere if a light was set or an
/// emissive surface moved. These texels get the light that bk_bake gives them, and its bits if
/// `keep_error` is 0; the others keep their light. If there is no light yet, or the last bake had
/// other parameters, everything is baked. bk_bake_stats.kept_texels and bk_plan_describe report how
/// much was kept.
///
/// Each call may leave an error of `keep_error`, and these errors add up: use bk_bake for final
/// light. With several passes, `keep_error` below the noise of one pass's photons keeps little, and
/// the radiance map is made anew.
///
/// Cost: photons and seams as in a bake; of the other stages the part that changed.
/// Measured: docs/performance.md, "Edits".
///
/// @param lightmap  any light map
/// @param params  parameters of the last bake, without a range of texels, checkpoint, shares and
///   target_error; NULL for the defaults
/// @param keep_error  change of light below which texels keep it, as a fraction of their irradiance
///   or, if that is more, of a tenth of the mean irradiance; finite, >= 0. 0.03 is hard to see.
///   Texels of the radiance map keep their radiance by the same measure, unless it is 0
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives numbers about the bake; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  `keep_error` or a field of `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  another call is using the light map
/// @retval BK_ERROR_OUT_OF_MEMORY  `memory_budget` is exceeded or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_bake_changed(bk_lightmap *lightmap,
                          const bk_bake_params *params,
                          float keep_error,
                          bk_progress_fn progress,
                          void *user,
                          bk_bake_stats *out);

/// Bakes a light map and keeps light of an earlier one, of a scene of which this one's is a
/// revision: after meshes were added, removed, edited, or given other materials.
///
/// The new scene is described and committed like any other, and its light map made with the
/// `texels_per_unit` (not 0), divisors and other fields of the earlier one, so that surfaces which
/// both scenes have are given the same texels. Surfaces are matched by content and place: whole
/// objects first, then single triangles of the others; where a mesh stands in the description does
/// not matter. Light is compared and
/// baked as bk_bake_changed does it; surfaces that only one of the scenes has count as moved. Light
/// that the light map already has is replaced. If the earlier light map has no light, was baked with
/// other parameters or has no surface in common with this one, everything is baked.
///
/// Errors add up as in bk_bake_changed. bk_lightmap_create_from makes the light map without
/// unwrapping common surfaces; a cache folder (bk_device_desc.cache_folder) saves unwraps, too.
///
/// Cost: as bk_bake_changed, and up to some 100 bytes and a microsecond per triangle of objects that
/// changed, less of those that did not; the earlier light is held a second time while it is baked.
/// Measured: docs/performance.md, "Edits".
///
/// Thread-safety: the earlier light map is read for the whole call; other calls may read it
/// meanwhile.
///
/// @param lightmap  any light map
/// @param earlier  another light map, of another scene or the same one, on any device
/// @param params  parameters of the last bake of `earlier`, without a range of texels, checkpoint,
///   shares and target_error; NULL for the defaults
/// @param keep_error  change of light below which texels keep it, as a fraction, as in
///   bk_bake_changed; finite, >= 0
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives numbers about the bake; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  `earlier` is `lightmap`, or `keep_error` or a field of
///   `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  another call is using the light map, or changing the earlier one
/// @retval BK_ERROR_OUT_OF_MEMORY  `memory_budget` is exceeded or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_bake_changed_from(bk_lightmap *lightmap,
                               const bk_lightmap *earlier,
                               const bk_bake_params *params,
                               float keep_error,
                               bk_progress_fn progress,
                               void *user,
                               bk_bake_stats *out);

/// Bakes one share of the photons or of the radiance map, on which all texels depend, and writes it
/// to a file: machines that bake some texels each (texel_begin and texel_end of bk_bake_params) need
/// not each trace all photons and fill the whole map.
///
/// First all shares of photons are computed, on any machines and in any order; when they are there,
/// all shares of the radiance map, each of which reads the photons of all; then all texels, with the
/// same `shares` and `share_count`. All other fields of `params` but `memory_budget`, the range of
/// texels and the checkpoint must be the same in all these calls, and so must scene, lights and
/// layout. The light has the bits of a bake without shares, whatever `share_count` is.
///
/// The file of share K of N is `shares` followed by photons-K-of-N.bkshare or
/// radiance-K-of-N.bkshare (and by -pass-P before .bkshare, from the second pass on). It is replaced
/// as a whole or not at all. A whole file of the same share that is there already is kept, and the
/// call then only reads it: after an interruption or the loss of a machine, the same calls complete
/// the work. Files may be copied between machines and renamed with another prefix. A
/// photon takes 48 bytes in its file, a texel of the radiance map 12. Stages that the scene does not
/// need write no file. Files from untrusted sources are safe to read: every number is checked, and
/// light is finite and >= 0.
///
/// Any number of threads may compute shares of one light map at the same time, but not during a
/// bake.
///
/// Cost: of photons and the radiance map in a bake the N-th part; beside it, a pilot of photons for
/// each share of photons (see bk_bake_params.photon_count), and reading and sorting of all photons
/// for each share of the radiance map. Measured: docs/performance.md, "Many machines".
///
/// Experimental: another version of the library may refuse the file.
///
/// @param lightmap  any light map
/// @param params  parameters of the bake; not NULL, with `shares` and `share_count`
/// @param stage  one of the BK_SHARE values
/// @param share  number of the share, less than `share_count`
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives numbers about photons and the radiance map, without rays where a file was
///   read; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range, `shares` is NULL,
///   `target_error` is not 0, there is no such stage or share, or the photons of a share are of
///   another bake; bk_last_error says in which respect
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  `memory_budget` is exceeded or the memory callback refuses
/// @retval BK_ERROR_IO  the photons of a share are missing, damaged or cannot be read, or the file
///   cannot be written
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_EXPERIMENTAL
bk_result bk_bake_share(const bk_lightmap *lightmap,
                        const bk_bake_params *params,
                        uint32_t stage,
                        uint32_t share,
                        bk_progress_fn progress,
                        void *user,
                        bk_bake_stats *out);

/// Writes a text about the last bake, one line per stage: whether it ran or was left out, and why.
/// Before the first bake the text is about a bake with default parameters.
///
/// @param lightmap  any light map
/// @param dst  receives as much of the text as fits, UTF-8 with a NUL; may be NULL if `capacity` is
///   0
/// @param capacity  size of `dst` in bytes
/// @return  length of the whole text in bytes without its NUL, whatever the capacity; 0 on failure,
///   for example during a bake
BK_API size_t bk_plan_describe(const bk_lightmap *lightmap, char *dst, size_t capacity);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup read Reading and saving light maps
 *
 * Thread safety: any thread; during a bake of the light map these functions fail with
 * BK_ERROR_INVALID_STATE.
 *
 * Cost: reading copies a page, in up to 0.2 s per million texels; writing files takes the time of
 * compression and of the disk.
 *
 * @{
 */
/* ============================================================================================== */

/// Layer: irradiance in W/m2, direct and indirect. RGB: BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F.
#define BK_LAYER_COMBINED 0

/// Layer: irradiance in W/m2 that was reflected by other surfaces. RGB.
#define BK_LAYER_INDIRECT 1

/// Layer: irradiance in W/m2 that comes straight from lights. RGB.
#define BK_LAYER_DIRECT 2

/// Layer: outgoing radiance in W/(m2 sr), as gather rays see it. RGB.
#define BK_LAYER_RADIANCE 3

/// Layer: 1 for a texel that a triangle covers; 0.5 for one whose light is copied from its
/// neighbours, because it lies in the padding around a chart or inside a solid; 0 for an empty one.
/// After a bake of a range of texels, texels that are not baked yet and the padding that repeats
/// them are 0 too; before the first bake covered texels are 1. BK_FORMAT_R32F.
#define BK_LAYER_VALIDITY 4

/// Layer: position of the texel's sample in scene units; 0 where no triangle covers the texel. RGB.
#define BK_LAYER_POSITION 5

/// Layer: unit normal of the texel's sample, on the side whose light it holds (before a bake the
/// front, but for separate texels of backs); 0 where no triangle covers the texel. RGB.
#define BK_LAYER_NORMAL 6

/// Layer: number of the triangle that covers the texel, counted through all meshes in their order;
/// BK_NONE where there is none. BK_FORMAT_R32U.
#define BK_LAYER_TRIANGLE 7

/// Layer: mean radiance over the sphere, of which the half below the surface is dark, in W/(m2 sr),
/// of the light that bk_bake_params.directional_indirect and directional_direct asked for:
/// 1 / (4 pi) times the integral of radiance. RGB. The guide ("Normal maps") has shader code.
#define BK_LAYER_L0 8

/// Layer: the same mean of radiance times the x coordinate of the direction it comes from, in the
/// axes of the scene, in W/(m2 sr): -L0 to L0. RGB.
#define BK_LAYER_L1X 9

/// Layer: the same for y. RGB.
#define BK_LAYER_L1Y 10

/// Layer: the same for z. RGB.
#define BK_LAYER_L1Z 11

/// Layer: L1X / L0, -1 to 1; 0 where there is no light. RGB, or BK_FORMAT_RGBA8 as 0.5 + 0.5 times
/// the ratio.
#define BK_LAYER_RATIO_X 12

/// Layer: L1Y / L0. RGB or BK_FORMAT_RGBA8.
#define BK_LAYER_RATIO_Y 13

/// Layer: L1Z / L0. RGB or BK_FORMAT_RGBA8.
#define BK_LAYER_RATIO_Z 14

/// Layer: dominant direction, L1 / L0 of the sum of the channels: a vector (x, y, z) towards the
/// light whose length is 1 if all comes from one direction and 0.5 under a uniform sky. RGB or
/// BK_FORMAT_RGBA8.
#define BK_LAYER_DIRECTION 15

/// Layer: standard error of the irradiance in COMBINED, in W/m2: the noise that is left after a bake
/// of several passes (bk_bake_params.passes), estimated from as many values. RGB.
#define BK_LAYER_ERROR 16

/// Layer: number of the chart whose light the texel holds or, in the padding around the chart,
/// repeats; separate texels of a chart's back have another number. BK_NONE where there is none. A
/// filter that stays within texels of one number crosses no border of a chart. BK_FORMAT_R32U.
#define BK_LAYER_CHART 17

/// Flag added to BK_LAYER_COMBINED, INDIRECT or DIRECT: from half of the passes of the bake alone, the
/// first pass and every second one after it. The two halves have independent noise, and their mean
/// is the layer. For denoisers; see the guide ("Denoising").
#define BK_LAYER_FIRST_HALF 256

/// Flag added to BK_LAYER_COMBINED, INDIRECT or DIRECT: from the other half of the passes.
#define BK_LAYER_SECOND_HALF 512

/// Format: three floats, 12 bytes per texel.
#define BK_FORMAT_RGB32F 1

/// Format: four half floats, 8 bytes per texel. Alpha is 1; values beyond 65504 are clamped to it.
#define BK_FORMAT_RGBA16F 2

/// Format: one float, 4 bytes per texel.
#define BK_FORMAT_R32F 3

/// Format: one uint32_t, 4 bytes per texel.
#define BK_FORMAT_R32U 4

/// Format: four bytes, each 255 times a value from 0 to 1, for layers of ratios. Alpha is 255.
#define BK_FORMAT_RGBA8 5

/// Kind of file: float images of the light layers, PREFIXpageN-LAYER.exr with LAYER one of
/// combined, indirect, direct, radiance; with light by direction also l0, ratio-x, ratio-y, ratio-z.
#define BK_FILE_EXR 1

/// Kind of file: tone-mapped 8-bit images of the light layers for viewing, PREFIXpageN-LAYER.png;
/// with light by direction also its ratios, as in BK_FORMAT_RGBA8.
#define BK_FILE_PNG 2

/// Kind of file: the scene with its light map for viewers and engines, PREFIXscene.glb (glTF 2.0).
///
/// The light map is addressed by TEXCOORD_1. Materials without a texture are unlit and have the
/// light map as baseColorTexture, so that any viewer shows the light. The others keep their texture
/// as baseColorTexture on TEXCOORD_0 and have the light map as occlusionTexture on TEXCOORD_1:
/// viewers with lights of their own dim those by it, and importers find it there. Each page is an
/// 8-bit sRGB image of irradiance times an exposure, compressed above 0.6; the extras of the asset
/// and of each material state texture, exposure and curve. Triangles whose backs have separate
/// texels are written twice, one-sided.
#define BK_FILE_GLB 3

/// Copies one layer of one page.
///
/// In the layers of light each texel of the padding repeats the nearest covered texel.
///
/// @param lightmap  light map; baked, if the layer holds light
/// @param page  number of the page
/// @param layer  one of the BK_LAYER values; COMBINED, INDIRECT, DIRECT, RADIANCE and those from L0 to
///   ERROR hold light. COMBINED, INDIRECT and DIRECT with or without one of the flags of halves
/// @param format  one of the BK_FORMAT values that the layer allows
/// @param dst  receives bk_lightmap_info.height rows of bk_lightmap_info.width texels; needs no
///   alignment
/// @param row_stride  distance between rows in bytes, at least the bytes of a row; 0: packed
/// @retval BK_ERROR_INVALID_ARGUMENT  page or layer does not exist, the format does not suit the
///   layer, or `row_stride` is too small
/// @retval BK_ERROR_INVALID_STATE  the layer holds light and there was no bake, or none that
///   asked for light by direction (layers from L0 to DIRECTION) or had several passes (ERROR and
///   halves), or the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  a page does not fit
BK_API
bk_result bk_lightmap_read(const bk_lightmap *lightmap,
                           uint32_t page,
                           uint32_t layer,
                           uint32_t format,
                           void *dst,
                           size_t row_stride);

/// Replaces layers of a baked light map by light of the caller's, for example by denoised light. All
/// that reads, samples, saves or writes the light map uses it from then on, until the next bake.
///
/// Values of texels with validity 1 are taken (BK_LAYER_VALIDITY); others, as in the padding, are
/// ignored: texels inside of solids get the new light of the texel that they repeat. Seams are
/// stitched anew, if the bake stitched them. BK_LAYER_RADIANCE and BK_LAYER_ERROR stay those of the
/// bake, and halves differ by as much as before. A call that fails changes nothing.
///
/// Cost: copying the texels, and bk_bake_stats.seam_seconds.
///
/// @param lightmap  light map of which all texels are baked
/// @param layers  layers to replace, each once: BK_LAYER_DIRECT, BK_LAYER_INDIRECT and, after a bake with
///   light by direction, BK_LAYER_L0, BK_LAYER_L1X, BK_LAYER_L1Y and BK_LAYER_L1Z; where L1 is longer
///   than L0, it is shortened
/// @param layer_count  number of elements of `layers`
/// @param format  BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F, whose alpha is ignored
/// @param texels  for each of `layers`, its pages one after the other, each of them
///   bk_lightmap_info.height packed rows; finite, up to 1e30, and >= 0 but for L1; needs no alignment
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a layer cannot be written or comes twice, the format is another
///   one, or a value is none of light; bk_last_error names the texel
/// @retval BK_ERROR_INVALID_STATE  not all texels are baked, there was no light by direction, or
///   another call is using the light map
/// @retval BK_ERROR_OUT_OF_MEMORY  a copy of the light does not fit
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_lightmap_write(bk_lightmap *lightmap,
                            const uint32_t *layers,
                            size_t layer_count,
                            uint32_t format,
                            const void *texels,
                            bk_progress_fn progress,
                            void *user);

/// Writes a baked light map to files.
///
/// Each file is written beside the old one of its name (NAME.part), flushed to disk, and renamed:
/// whatever ends the call early, for example a full disk, a cancel or a kill, each old file is kept
/// or replaced as a whole. After a kill NAME.part may be left over; the next save overwrites it.
///
/// @param lightmap  baked light map
/// @param path_prefix  beginning of the file names that the BK_FILE values state, for example
///   "out/" for files in the folder out, which must exist; UTF-8
/// @param file_format  one of the BK_FILE values
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_IO  a file cannot be written or another call is writing it; bk_last_error names
///   it
/// @retval BK_ERROR_INVALID_STATE  there was no bake, or the light map is being baked
/// @retval BK_ERROR_UNSUPPORTED  the library was built without files, or a GLB file would have more
///   than 4 GiB
/// @retval BK_ERROR_OUT_OF_MEMORY  the images do not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_lightmap_save(const bk_lightmap *lightmap,
                           const char *path_prefix,
                           uint32_t file_format,
                           bk_progress_fn progress,
                           void *user);

/// Saves the light of all texels that have been baked so far, to be loaded by
/// bk_lightmap_load_result in another process or on another machine.
///
/// Experimental: another version of the library may refuse the file.
///
/// @param lightmap  baked light map
/// @param path  name of the file, which is replaced as a whole or not at all; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_STATE  there was no bake, the light map is being baked, or bakes with
///   different parameters or lights filled the texels
/// @retval BK_ERROR_OUT_OF_MEMORY  a buffer does not fit
/// @retval BK_ERROR_IO  the file cannot be written; bk_last_error names it
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_EXPERIMENTAL
bk_result bk_lightmap_save_result(const bk_lightmap *lightmap,
                                  const char *path,
                                  bk_progress_fn progress,
                                  void *user);

/// Loads light that bk_lightmap_save_result wrote for a light map of the same scene, lights and
/// layout.
///
/// Light of texels that the file does not hold stays. So several machines can bake some texels each
/// (texel_begin and texel_end of bk_bake_params, all else equal), and one of them loads all files,
/// in any order: the light then has the bits of one bake, and seams are stitched with the last
/// texels. A call that fails changes nothing.
///
/// Files from untrusted sources are safe to load: every number is checked, and light is finite and
/// >= 0. It may be any such light, though.
///
/// Experimental: another version of the library may refuse the file.
///
/// @param lightmap  any light map
/// @param path  name of the file; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  the file is of another scene, light map, version of the
///   library or instruction set (AVX2 and AVX-512 count as one), or of other lights; bk_last_error
///   says which
/// @retval BK_ERROR_INVALID_STATE  another call is using the light map, or the file holds some
///   texels only and the light map holds light of a bake with other parameters
/// @retval BK_ERROR_IO  the file cannot be read, is damaged, or is another kind of file;
///   bk_last_error names it
/// @retval BK_ERROR_OUT_OF_MEMORY  the light does not fit
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_EXPERIMENTAL
bk_result bk_lightmap_load_result(bk_lightmap *lightmap,
                                  const char *path,
                                  bk_progress_fn progress,
                                  void *user);

/** @} */

/* ============================================================================================== */
/**
 * @defgroup live Live updates
 *
 * A live object lights a scene at once, coarsely, and refines the light while a camera moves
 * through it: call bk_live_update once per frame with the camera and a time budget, fetch the
 * rectangles of texels that changed, and read and upload them. All levels of detail (LODs) are
 * shown in pages of the light map's size and layout; lower LODs are interpolated. Source: Schouls
 * 2017, section 3.3.
 *
 * Thread safety: any thread, one call at a time per live object: a second call that comes while
 * the first runs fails with BK_ERROR_INVALID_STATE and changes nothing. bk_live_read,
 * bk_live_cell_lods and bk_live_lod_at exclude other calls but not each other.
 *
 * Cost: see each function; those without a remark take microseconds.
 *
 * @{
 */
/* ============================================================================================== */

/// Mode: refine the surfaces in view, first where estimated error times visibility is largest.
#define BK_LIVE_VIEW 0

/// Mode: refine the grid cells near the camera, visible ones first. A cell shows its next LOD when
/// all its texels have it.
#define BK_LIVE_POSITION 1

/// Mode: refine anywhere, at random, for comparison.
#define BK_LIVE_UNIFORM 2

/// Handle of a live object.
typedef struct bk_live bk_live;

/// Parameters of bk_live_create.
///
/// Measured curves of these fields: docs/performance.md, "Live updates".
typedef struct bk_live_params {
  /// Size of this structure in bytes, set by bk_live_params_init.
  uint32_t struct_size;
  /// One of the BK_LIVE modes. In Sponza an error of 1 % took BK_LIVE_VIEW 2.3 s and
  /// BK_LIVE_POSITION 4.0 s; the latter changes the LOD of whole cells at a time, which
  /// bk_live_cell_lods reports. Default: BK_LIVE_VIEW.
  uint32_t mode;
  /// Number of levels of detail, 1 to 4: the lowest computes every 2^(lod_count - 1)-th texel of
  /// the gather map along each axis, the highest all. Raise it for a sooner and coarser first
  /// picture; lower it where coarse light must not be seen. Default: 3.
  uint32_t lod_count;
  /// Number of rounds of 64 rays that each texel of a cell needs before the cell shows its next
  /// LOD, 1 to `max_rounds`. Raise it so that cells change their LOD with less noise and later.
  /// Default: 1.
  uint32_t promote_threshold;
  /// Number of rounds of 64 rays after which a texel is finished, 1 to 1024. Raise it for less
  /// final noise, lower it to be finished sooner: 1 round has the rays of a default bake, 4 those
  /// of final light, and the time until all is finished grows in proportion. Default: 16.
  uint32_t max_rounds;
  /// Maximum number of rays that an update traces, whatever its budget; 0: no limit. Set it where
  /// the work per frame must not depend on the speed of the machine, as in tests. Default: 0.
  uint32_t rays_per_update;
  /// Radius of a blur for display, in texels of the gather map, 0 to 16; accumulated indirect light
  /// is not blurred. With 0 noisy direct light is not blurred either, as in a bake. Lower it to 1
  /// or 0 where contact shadows matter and noise at the beginning does not; it costs time when
  /// texels are shown. Default: 2.
  uint32_t blur;
  /// Distance, in texels of the radiance map, up to which light is computed where gather rays hit,
  /// see bk_bake_params. Default: 0.
  float near_hits;
  /// Edge of a grid cell in scene units, finite and >= 0; 0: a sixteenth of the scene's longest
  /// side. A grid of more than 2^24 cells is refused. Lower it for finer decisions in
  /// BK_LIVE_POSITION; more cells take more time per update to sort. Default: 0.
  float cell_size;
  /// 1: begin with a first impression of the light that was reflected by other surfaces: a quarter of
  /// the photons, few points per texel of the radiance map, and light that may cross walls by a texel of
  /// the gather map. All that a bake computes then follows on a thread of its own beside the updates,
  /// while bk_live_stats.light_pending is 1, and replaces it: finished light is the same. Set it to 1
  /// where the first picture must come soon on a machine of few cores (Sponza: 1.5 instead of 3.2 s
  /// from nothing); the update that replaces it may take longer than its budget (34 ms there, once).
  /// States are saved and restored when nothing is pending. Default: 0.
  uint32_t quick_start;
  /// Seed of all random numbers, see bk_bake_params. Default: 0.
  uint64_t seed;
  /// Number of photons to emit, see bk_bake_params. Lower it where bk_live_create and changes of
  /// light must be quick: both trace all photons. Default: 1,000,000.
  uint64_t photon_count;
  /// Maximum number of reflections, see bk_bake_params. Leave it at 0. Default: 0.
  uint32_t max_bounces;
  /// Number of shadow rays per light map texel and area light, see bk_bake_params. Lower it where
  /// lights change often: direct light is computed anew each time. Default: 16.
  uint32_t direct_samples;
  /// Search radius of photons in scene units, see bk_bake_params. Default: 0.
  float radius;
  /// 1: the device's threads go on working between updates, on the surfaces that the last one
  /// saw. 0: they rest. Set it to 1 where the application leaves cores idle between updates:
  /// light converges sooner, and the cores are busy all the time. Default: 0.
  uint32_t background;
  /// Estimated error of interpolation above which texels trace rays themselves, see
  /// bk_bake_params. These rays come before the first light and before that of new lights. Set it
  /// to 1.5 for those of a default bake. There is no interpolation_contrast here, as the gather map
  /// of live updates comes after that choice: they end with the light of a bake whose
  /// interpolation_contrast is INFINITY. Default: INFINITY.
  float interpolation_error;
  /// Number of rays of texels of the light map that trace rays themselves, see bk_bake_params; 0:
  /// 64, as in a default bake. They come before the first light. Default: 16.
  uint32_t own_rays;
  /// 1: compute light that was reflected by other surfaces by direction too, as
  /// bk_bake_params.directional_indirect does. It takes 240 bytes more per texel of the gather map, half
  /// as much again once a light has changed, and a fifth more time until light is finished.
  /// Default: 0.
  uint32_t directional_indirect;
  /// 1: the same for light that comes straight from lights, for about 120 bytes more per texel of the
  /// light map (48 per texel of tiles, which overlap). With both, the layers hold the sum.
  /// Default: 0.
  uint32_t directional_direct;
} bk_live_params;

/// A perspective camera.
typedef struct bk_camera {
  /// Size of this structure in bytes, set by bk_camera_init.
  uint32_t struct_size;
  /// Width of the picture in pixels, >= 1; only the ratio to `height` matters. Default: 1920.
  uint32_t width;
  /// Height of the picture in pixels, >= 1. Default: 1080.
  uint32_t height;
  /// Position in scene units. Default: the origin.
  float position[3];
  /// Direction of view, a vector of any length > 0. Default: -z.
  float forward[3];
  /// Upward direction, a vector of any length > 0, not parallel to `forward`. Default: +y.
  float up[3];
  /// Vertical field of view in radians, in (0, pi). Default: 1.
  float fov_y;
} bk_camera;

/// Limits of an update. With time and rays 0 nothing is traced.
typedef struct bk_budget {
  /// Size of this structure in bytes, set by bk_budget_init.
  uint32_t struct_size;
  /// Time limit in milliseconds, finite and >= 0; 0: none. Default: 4.
  float milliseconds;
  /// Limit of the number of rays; 0: none. A round of 64 rays that has begun is finished.
  /// Default: 0.
  uint64_t rays;
  /// Maximum size in bytes of the texels in the rectangles that bk_live_dirty_rects fetches until
  /// the next update, 8 bytes per texel (BK_FORMAT_RGBA16F), at least 1024; 0: no limit. Set it so
  /// that no frame reads and uploads more than it has time for, also after the start and after a
  /// change of light: surfaces in view whose light has changed most come first, the others in later
  /// updates. The time that bk_live_read takes for that many texels is then kept free within
  /// `milliseconds`, up to half of it; if reading takes longer, fewer bytes come. Default: 0.
  uint64_t max_dirty_bytes;
} bk_budget;

/// Numbers about an update, and the state after it.
typedef struct bk_live_stats {
  /// Size of this structure in bytes, set by bk_live_stats_init.
  uint32_t struct_size;
  /// 1 while indirect light is being recomputed because a light has changed, or after a quick start;
  /// else 0.
  uint32_t light_pending;
  /// Duration of the update in milliseconds.
  float milliseconds;
  /// Estimated relative error of the indirect light that the camera sees.
  float visible_error;
  /// Fraction of the light map that is finished, 0 to 1.
  float finished;
  /// Fraction of the surfaces in view that is finished, 0 to 1.
  float visible_finished;
  /// Number of rays traced by the update, and in the background since the update before.
  uint64_t rays;
  /// Number of rays traced since the live object was created.
  uint64_t total_rays;
  /// Number of cells that went to a higher LOD (BK_LIVE_POSITION).
  uint32_t cells_promoted;
  /// Number of blocks of 8 x 8 texels of the gather map whose shown light changed.
  uint32_t blocks_changed;
  /// Size of the live object in bytes.
  uint64_t bytes;
  /// Size in bytes that the live object would have with all LODs in use everywhere.
  uint64_t bytes_full;
  /// Size in bytes of the texels in the rectangles that bk_live_dirty_rects fetches now, 8 bytes
  /// per texel.
  uint64_t dirty_bytes;
  /// Size in bytes of the changed texels that bk_budget.max_dirty_bytes leaves to later updates.
  uint64_t dirty_bytes_left;
} bk_live_stats;

/// Geometry of the light map grid.
typedef struct bk_cell_info {
  /// Size of this structure in bytes, set by bk_cell_info_init.
  uint32_t struct_size;
  /// Number of cells along x, y and z.
  uint32_t dimensions[3];
  /// Lower corner of the first cell, in scene units.
  float origin[3];
  /// Edge of a cell in scene units.
  float cell_size;
} bk_cell_info;

/// A rectangle of texels of a page.
typedef struct bk_rect {
  /// Number of the page.
  uint32_t page;
  /// LOD to read; in dirty rectangles always the highest, lod_count - 1.
  uint32_t lod;
  /// First column, in texels.
  uint32_t x;
  /// First row, in texels.
  uint32_t y;
  /// Number of columns, in texels.
  uint32_t width;
  /// Number of rows, in texels.
  uint32_t height;
} bk_rect;

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
BK_API void bk_live_params_init(bk_live_params *params);

/// Sets `struct_size` and fills in the defaults.
///
/// @param camera  structure to fill in; NULL is ignored
BK_API void bk_camera_init(bk_camera *camera);

/// Sets `struct_size` and fills in the defaults.
///
/// @param budget  structure to fill in; NULL is ignored
BK_API void bk_budget_init(bk_budget *budget);

/// Sets `struct_size` and clears the other fields.
///
/// @param stats  structure to fill in; NULL is ignored
BK_API void bk_live_stats_init(bk_live_stats *stats);

/// Sets `struct_size` and clears the other fields.
///
/// @param info  structure to fill in; NULL is ignored
BK_API void bk_cell_info_init(bk_cell_info *info);

/// Creates a live object: computes photons and the lowest LOD under the present lights, on the
/// device's threads. All pages are dirty afterwards.
///
/// Cost: a second or two for a large scene.
///
/// @param lightmap  light map whose layout is used; need not be baked, is not changed, and may be
///   released
/// @param params  parameters; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the live object, which the caller releases with bk_live_release; NULL on
///   failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  the live object does not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_live_create(bk_lightmap *lightmap,
                         const bk_live_params *params,
                         bk_progress_fn progress,
                         void *user,
                         bk_live **out);

/// Creates a live object of a scene that was described anew, after meshes were added, removed or
/// edited, with the parameters of the live object of the scene before, which is not changed.
///
/// Blocks of texels that show the same surfaces keep their rays, and their direct light where nothing
/// that changed lies between them and a light. When all photons of the new scene have been traced, rays
/// of a few texels of each block find out whether its indirect light differs by more than `keep_error`; if
/// it does, it is gathered again, while the old light fades out. With bk_live_params.quick_start all that
/// can be kept is shown at once, and photons are traced beside the updates, while
/// bk_live_stats.light_pending is 1; else they are traced in this call. If light was pending in the earlier
/// object, its light is shown until new rays replace it. All pages are dirty afterwards. Until the photons
/// have come, the live object keeps the scene before in memory, with its device.
///
/// Cost: up to half as much again as bk_live_create, with quick_start two to three times as much: in
/// Sponza 1.8 instead of 0.9 seconds on two threads; see docs/performance.md, "Edits".
///
/// @param lightmap  light map of the new scene, best made by bk_lightmap_create_from; need not be baked,
///   is not changed, and may be released
/// @param earlier  live object of the scene before; it may be released afterwards
/// @param keep_error  change of light below which blocks keep it, as a fraction of their light or, if
///   that is more, of a tenth of the mean light; finite, >= 0. 0.03 is hard to see
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the live object, which the caller releases with bk_live_release; NULL on
///   failure
/// @retval BK_ERROR_INVALID_ARGUMENT  `keep_error` is out of its range, or the earlier object's cell_size
///   is too small for the new scene
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked, or another call is using the earlier
///   object
/// @retval BK_ERROR_OUT_OF_MEMORY  both live objects do not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_API
bk_result bk_live_create_from(bk_lightmap *lightmap,
                              bk_live *earlier,
                              float keep_error,
                              bk_progress_fn progress,
                              void *user,
                              bk_live **out);

/// Adds one reference.
///
/// @param live  NULL is ignored
BK_API void bk_live_retain(bk_live *live);

/// Releases one reference.
///
/// The last release stops work between updates and the recomputation of indirect light, and waits
/// until both have ended; no callback comes from them afterwards. It may be made in a callback, on
/// any thread. Only if it is made in a memory callback that the recomputation of indirect light
/// calls, that work ends just after the callback has returned, and may call the memory callback
/// once more for the memory that it frees. A thread that makes the last release must not hold a
/// lock that a callback takes.
///
/// @param live  NULL is ignored
BK_API void bk_live_release(bk_live *live);

/// Updates the light for as long as the budget allows, on the device's threads.
///
/// Cost: the budget, which is exceeded by 0.04 ms in the median.
///
/// @param live  live object
/// @param camera  camera with finite coordinates; may be inside walls or outside the scene
/// @param budget  limits; NULL for 4 milliseconds
/// @param out  receives numbers about the update; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `camera` or `budget` is out of its range or not
///   finite
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_OUT_OF_MEMORY  a higher LOD or recomputed indirect light does not fit, or the
///   memory callback refuses; finished work stays, and the next update tries again
BK_API
bk_result bk_live_update(bk_live *live,
                         const bk_camera *camera,
                         const bk_budget *budget,
                         bk_live_stats *out);

/// Fetches rectangles of texels whose shown light has changed since they were last fetched, padding
/// around charts included. Rectangles are merged where that adds few texels, and are at most as many
/// as the last update's bk_budget.max_dirty_bytes allows.
///
/// @param live  live object
/// @param out  receives at most `capacity` rectangles, aligned to 4 bytes; may be NULL if
///   `capacity` is 0
/// @param capacity  number of rectangles that `out` holds
/// @param count  receives the number of rectangles fetched; the others are kept for the next call,
///   so fetch until `count` is less than `capacity`
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
BK_API
bk_result bk_live_dirty_rects(bk_live *live,
                              bk_rect *out,
                              size_t capacity,
                              size_t *count);

/// Copies the shown light of a rectangle of a page.
///
/// Cost: about 0.2 microseconds per texel; more for layers of light by direction and for an LOD below
/// the highest.
///
/// @param live  live object
/// @param page  number of the page
/// @param lod  lod_count - 1 for the light as shown; less for the light as it would be shown if no
///   texel were above that LOD
/// @param layer  BK_LAYER_COMBINED, INDIRECT or DIRECT; or one from BK_LAYER_L0 to DIRECTION, of a live
///   object that was created with `directional_indirect` or `directional_direct`
/// @param format  BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F; for ratios and DIRECTION also BK_FORMAT_RGBA8
/// @param rect  `x`, `y`, `width` and `height` of the rectangle; its `page` and `lod` are ignored.
///   NULL: the whole page
/// @param dst  receives the rectangle's rows; needs no alignment
/// @param row_stride  distance between rows in bytes, at least the bytes of a row; 0: packed
/// @retval BK_ERROR_INVALID_ARGUMENT  page, LOD, layer or format does not exist, the layer is another
///   one, the format does not suit it, the rectangle is not within the page, or `row_stride` is too
///   small
/// @retval BK_ERROR_INVALID_STATE  another call is changing the live object, or it was created without
///   light by direction
/// @retval BK_ERROR_OUT_OF_MEMORY  the rectangle does not fit
BK_API
bk_result bk_live_read(const bk_live *live,
                       uint32_t page,
                       uint32_t lod,
                       uint32_t layer,
                       uint32_t format,
                       const bk_rect *rect,
                       void *dst,
                       size_t row_stride);

/// Copies the light map grid and the LOD that each of its cells shows, for example into a 3D
/// texture.
///
/// @param live  live object
/// @param info  receives the geometry of the grid
/// @param out  receives one LOD per cell, x fastest, 255 for cells without surfaces; may be NULL if
///   `capacity` is 0
/// @param capacity  size of `out` in bytes, at least the number of cells; 0 to get `info` only
/// @retval BK_ERROR_INVALID_ARGUMENT  `capacity` is too small
/// @retval BK_ERROR_INVALID_STATE  another call is changing the live object
/// @retval BK_ERROR_OUT_OF_MEMORY  a copy does not fit
BK_API
bk_result bk_live_cell_lods(const bk_live *live,
                            bk_cell_info *info,
                            uint8_t *out,
                            size_t capacity);

/// Returns the LOD that is shown at a position.
///
/// @param live  live object
/// @param position  three floats, in scene units
/// @return  the LOD; BK_NONE outside the grid, in cells without surfaces, and on failure
BK_API uint32_t bk_live_lod_at(const bk_live *live, const float *position);

/// Announces that bk_scene_set_light has changed lights.
///
/// Direct light follows in the next updates, first where the camera looks. Photons are traced again
/// on a thread of their own; indirect light follows as they arrive, while the old light fades out.
/// One call can follow several changes.
///
/// @param live  live object
/// @param light  number of one of the lights that changed
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such light
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_OUT_OF_MEMORY  the recomputation of indirect light does not fit or the memory
///   callback refuses
BK_API bk_result bk_live_light_changed(bk_live *live, uint32_t light);

/// Updates live light to the geometry of its light map after bk_lightmap_follow. Pages, UVs and the
/// grid stay, and so does the light of blocks that the move does not change.
///
/// Direct light follows in the next updates where moved surfaces lie, or lay, between a block and a
/// light. Photons are traced again on a thread of its own: first a sixteenth of them, whose light is
/// gathered near moved surfaces only, then all. With these, rays of a few texels of each block find
/// out whether its light has changed. A move on the way to another one needs no waiting. If
/// bk_scene_set_light has changed lights too, this call announces them, and all light is computed
/// anew. Until the photons have come, the live object keeps the scene in both states in memory.
///
/// Cost: 0.1 to 0.3 seconds per million texels and thread. Does nothing if the live object has the
/// state of the light map already.
///
/// @param live  live object
/// @param lightmap  the light map from which it was created, after bk_lightmap_follow
/// @param keep_error  change of light below which blocks keep it, as a fraction of their light or, if
///   that is more, of a tenth of the mean light; finite, >= 0. 0.03 is hard to see
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  the live object was created from another light map, or
///   `keep_error` is out of its range
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object or changing the light map
/// @retval BK_ERROR_OUT_OF_MEMORY  blocks or the recomputation of indirect light do not fit or the
///   memory callback refuses; the live object keeps the old geometry
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0; the live object keeps the old
///   geometry
BK_API
bk_result bk_live_follow(bk_live *live,
                         const bk_lightmap *lightmap,
                         float keep_error,
                         bk_progress_fn progress,
                         void *user);

/// Pauses or resumes work between updates (bk_live_params.background) and the recomputation of
/// indirect light. They resume with the next update; updates themselves go on.
///
/// Cost: pausing waits for the work under way.
///
/// @param live  live object
/// @param paused  1 to pause, 0 to resume
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_OUT_OF_MEMORY  the recomputation of indirect light does not fit or the memory
///   callback refuses
BK_API bk_result bk_live_pause(bk_live *live, uint32_t paused);

/// Saves accumulated light to a file, from which bk_live_restore continues. Light that is older
/// than the last change of a light is left out.
///
/// Experimental: another version of the library may refuse the file.
///
/// Cost: the time of writing the file.
///
/// @param live  live object
/// @param path  name of the file, which is replaced as a whole or not at all; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_IO  the file cannot be written; bk_last_error names it
/// @retval BK_ERROR_OUT_OF_MEMORY  a buffer does not fit
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_EXPERIMENTAL bk_result bk_live_save(bk_live *live, const char *path, bk_progress_fn progress, void *user);

/// Restores light that bk_live_save wrote for the same scene, light map, lights and parameters
/// (mode, cell size, promotion, blur and limits may differ). All pages are dirty afterwards. A call
/// that fails changes nothing.
///
/// Files from untrusted sources are safe to restore: every number is checked, light must be finite
/// and >= 0, and counts must fit the light map. It may be any such light, though.
///
/// Experimental: another version of the library may refuse the file.
///
/// Cost: the time of reading the file; for a moment, twice the memory of the shown light.
///
/// @param live  live object
/// @param path  name of the file; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  the file is of another scene, light map, lights or parameters
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_IO  the file cannot be read, is damaged, or is another kind of file;
///   bk_last_error names it
/// @retval BK_ERROR_OUT_OF_MEMORY  the light does not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
BK_EXPERIMENTAL bk_result bk_live_restore(bk_live *live, const char *path, bk_progress_fn progress, void *user);

/** @} */

#ifdef __cplusplus
} /* extern "C" */
#endif

#endif /* BAKELITE_H */
