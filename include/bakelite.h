/*
 * Bakelite: SIMD light-baking kernels.
 *
 * Generated from src/capi by cbindgen; do not edit. To update it:
 *     BAKELITE_UPDATE_HEADER=1 cargo test --test header
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

#ifdef __cplusplus
extern "C" {
#endif

/* ================================================================================================
 * Results and version
 *
 * Functions that can fail return a `bk_result`: BK_OK, or a negative code. The sentence that names
 * the argument and the value at fault is then in `bk_last_error()`. A call that fails changes
 * nothing unless its description says so; every object can be used as before.
 *
 * Enums and flags travel as uint32_t constants. Values and flags that are not listed are refused.
 *
 * Every structure whose name ends in _desc, _params, _info, _stats or _view starts with
 * `uint32_t struct_size`. Its `bk_..._init(&x)` function sets that size and fills in the defaults.
 * Programs compiled against an older, shorter version of a structure keep working: the missing
 * fields of an input get their defaults, and an output is written as far as it reaches. A size of
 * 0, or larger than this library knows, is BK_ERROR_INVALID_ARGUMENT.
 * ================================================================================================ */

// Major version: programs must be recompiled when it changes.
#define BK_VERSION_MAJOR 0

// Minor version: functions and fields were added.
#define BK_VERSION_MINOR 1

// Patch version: only behaviour was mended.
#define BK_VERSION_PATCH 0

// The version of this header: major << 16 | minor << 8 | patch.
#define BK_VERSION (((BK_VERSION_MAJOR << 16) | (BK_VERSION_MINOR << 8)) | BK_VERSION_PATCH)

// "None" where an index is expected or reported.
#define BK_NONE 0xffffffffu

// What became of a call: BK_OK, or one of the negative BK_ERROR codes.
typedef int32_t bk_result;

// All went well.
#define BK_OK 0

// An argument is NULL or out of its documented range.
#define BK_ERROR_INVALID_ARGUMENT (-1)

// The call is not allowed in the object's present state, or while another thread changes it.
#define BK_ERROR_INVALID_STATE (-2)

// Memory ran out, or a memory budget or the memory callback refused.
#define BK_ERROR_OUT_OF_MEMORY (-3)

// The progress callback returned 0.
#define BK_ERROR_CANCELLED (-4)

// This build or this machine cannot do it.
#define BK_ERROR_UNSUPPORTED (-5)

// A file could not be read or written, or its content is malformed.
#define BK_ERROR_IO (-6)

// A bug in the library, caught before it reached the caller.
#define BK_ERROR_INTERNAL (-7)

// The version of the library in use, to compare with BK_VERSION.
BK_API uint32_t bk_version(void);

// The name of a result, as "BK_OK"; "unknown bk_result" for a value that is none. Never NULL; the
// string is constant.
BK_API const char *bk_result_string(bk_result result);

// What went wrong in the last call of the calling thread that failed: one UTF-8 sentence that names
// the argument and the value at fault; empty if none failed yet. Never NULL; valid until the
// thread's next call into the library. Functions without a bk_result (as bk_intersect) leave their
// failures here too; a call that succeeds leaves the text alone.
BK_API const char *bk_last_error(void);

/* ================================================================================================
 * Devices and callbacks
 *
 * A device owns worker threads, the choice of instruction set, the log and the memory accounts.
 *
 * Handles (bk_device, bk_scene, bk_photon_map, bk_lightmap) are opaque and reference-counted: a
 * create function hands out one reference, bk_..._retain adds one, bk_..._release gives one back,
 * and NULL is ignored by both. What is made from an object keeps what it needs of it alive, so
 * parents may be released first. Retaining and releasing is safe from any thread.
 *
 * Callbacks may run on any thread and must not throw or jump out. They may call functions that do
 * not work on a device's threads, releases among them; the others (commit, create, bake, save,
 * BK_RAYS_PARALLEL), and changes to the object whose call they are in, fail with
 * BK_ERROR_INVALID_STATE. Strings given to callbacks are valid during the callback only.
 *
 * Floating-point state: all functions compute with rounding to nearest, with denormals and with all
 * exceptions masked, whatever the calling thread has set (in MXCSR on x86-64, in FPCR on AArch64; on
 * other architectures nothing is set), and restore the caller's state before they return. Callbacks
 * see the caller's state on the caller's thread and the default state on others; what they change of
 * it lasts until they return. That costs a call about 6 ns where the caller's state is the default
 * and 10 ns where it is not, once for all rays of bk_intersect_many, bk_occluded_many and bk_gather.
 *
 * Stacks: the calling thread needs 64 KB of stack for queries (bk_intersect, bk_occluded, their like
 * for many rays, bk_gather, bk_photon_map_estimate) and 256 KB for all other functions. The stacks of
 * the library's own threads have 4 MB, of which only what is used takes memory.
 *
 * fork: a device's threads do not follow into the child process. There, calls that need them fail
 * with BK_ERROR_INVALID_STATE; queries without BK_RAYS_PARALLEL and releases work, and so does a device
 * that is created in the child. An object that another thread is changing during the fork stays
 * locked in the child: calls with it fail with BK_ERROR_INVALID_STATE too.
 * ================================================================================================ */

// The best instruction set that the machine has.
#define BK_ISA_AUTO 0

// The baseline of the target: SSE2 on x86-64, NEON on AArch64.
#define BK_ISA_PORTABLE 1

// AVX2 with FMA.
#define BK_ISA_AVX2 2

// AVX-512 F, VL, DQ and BW.
#define BK_ISA_AVX512 3

// Log level: something failed that no result reports.
#define BK_LOG_ERROR 0

// Log level: something about the input or the run deserves attention, as skipped triangles.
#define BK_LOG_WARNING 1

// Log level: what is going on.
#define BK_LOG_INFO 2

// Worker threads, instruction set, log and memory accounts. All functions on a device are safe
// from any thread.
typedef struct bk_device bk_device;

// Receives log messages (UTF-8) with one of the BK_LOG levels, from any thread, several at a time.
typedef void (*bk_log_fn)(void *user, uint32_t level, const char *message);

// Asked before a large allocation, with its size in bytes: return 0 to refuse, and the call that
// wanted it ends with BK_ERROR_OUT_OF_MEMORY. Told after a free, with the size negative; the
// answer is ignored then. From any thread, several at a time; for the last time when the last
// object of the device is released.
typedef int32_t (*bk_memory_fn)(void *user, int64_t bytes);

// What to create a device with.
typedef struct bk_device_desc {
  // Size of this structure in bytes, set by bk_device_desc_init.
  uint32_t struct_size;
  // Worker threads, at most 1024; 0, the default: one per logical core, as far as that allows.
  // Results do not depend on it.
  uint32_t num_threads;
  // One of the BK_ISA values. Default: BK_ISA_AUTO.
  uint32_t isa;
  // Receives log messages. Default: NULL.
  bk_log_fn log;
  // Asked before large allocations. Default: NULL.
  bk_memory_fn memory;
  // Handed to log and memory; must outlive the device and all that was made from it.
  void *user;
} bk_device_desc;

// Told how far a call is: fraction in [0, 1], never falling, and the name of the stage, as
// "gather". Called on the thread that made the call, and only until that call returns: when a stage
// starts and about every 15 ms, at most 100 times in any second. (A stage that starts when 20 others
// just have is reported with the next call.) The library's own threads go on working meanwhile.
// Return 0 to cancel: the call then ends with BK_ERROR_CANCELLED, as a rule within 50 ms. NULL is
// allowed wherever one is taken.
typedef int32_t (*bk_progress_fn)(void *user, float fraction, const char *stage);

// Fills in the defaults.
BK_API void bk_device_desc_init(bk_device_desc *desc);

// Starts a device.
//
// desc: NULL for the defaults. out: receives the device, NULL on failure.
//
// Fails with BK_ERROR_UNSUPPORTED if the machine lacks the instruction set asked for, with
// BK_ERROR_OUT_OF_MEMORY if the threads cannot be started.
BK_API bk_result bk_device_create(const bk_device_desc *desc, bk_device **out);

// Counts one more reference. NULL is ignored.
BK_API void bk_device_retain(bk_device *device);

// Gives one reference back. When the last is given back, of the device and of all that was made
// from it, its threads are joined. NULL is ignored.
BK_API void bk_device_release(bk_device *device);

// Returns the instruction set in use: a BK_ISA value other than BK_ISA_AUTO; BK_ISA_AUTO if device is NULL.
//
// BK_ISA_AVX2 and BK_ISA_AVX512 give the same bits of hits and light. BK_ISA_PORTABLE rounds products and
// sums apart where the others fuse them, so its bits differ: results and checkpoints of bakes are not exchanged
// between it and the others.
BK_API
uint32_t bk_device_isa(const bk_device *device);

// The number of worker threads; 0 if device is NULL.
BK_API uint32_t bk_device_num_threads(const bk_device *device);

/* ================================================================================================
 * Scenes
 *
 * A scene is described (materials, meshes, lights, files), then committed: its acceleration
 * structure is built, and from then on it can be queried and baked but only its lights change, and
 * its vertices by bk_mesh_set_positions and bk_scene_refit. Describing, committing and moving want
 * one thread at a time per scene; a call that meets another one fails with BK_ERROR_INVALID_STATE.
 * Queries on a committed scene are safe from any threads, except during bk_scene_refit: then
 * whichever comes second fails with BK_ERROR_INVALID_STATE.
 *
 * Right-handed coordinates, any up axis, any unit of length (W/m2 then means per square unit),
 * counter-clockwise front faces, linear RGB, all surfaces diffuse. Coordinates are valid up to a
 * magnitude of 1e12.
 * ================================================================================================ */

// The files that a scene file names may lie in any folder. For scenes whose author is trusted: such a scene learns
// what files there are, and brings their texels into its light.
#define BK_LOAD_ANY_FOLDER 1

// Binned SAH.
#define BK_BUILD_QUALITY_DEFAULT 0

// Binned SAH with spatial splits: triangles may be cut. The build takes several times as long and the
// tree up to a sixth more memory. Closest hits are found with 10 to 20 % less work where large or slanted
// triangles overlap others, as in most buildings; occlusion rays may take a tenth more, since large
// triangles are met later.
#define BK_BUILD_QUALITY_HIGH 1

// A scene: being described, or committed.
typedef struct bk_scene bk_scene;

// What a file brought.
typedef struct bk_load_info {
  // Size of this structure in bytes, set by bk_load_info_init.
  uint32_t struct_size;
  // Meshes added, the first with number first_mesh.
  uint32_t meshes;
  // Number of the first mesh added.
  uint32_t first_mesh;
  // Materials added, the first with number first_material.
  uint32_t materials;
  // Number of the first material added.
  uint32_t first_material;
  // Lights added (emissive materials not counted), the first with number first_light.
  uint32_t lights;
  // Number of the first light added.
  uint32_t first_light;
  // Materials of which a reflectance was outside [0, 0.98] and was clamped to that.
  uint32_t clamped_albedos;
  // Triangles added, degenerate ones included.
  uint64_t triangles;
  // Time to read the file, in seconds.
  double seconds;
  // Textures added, the first with number first_texture. An image that cannot be read is told to the device's
  // log as a warning, and its materials do without.
  uint32_t textures;
  // Number of the first texture added.
  uint32_t first_texture;
} bk_load_info;

// Which files a scene may consist of, and how much of them.
typedef struct bk_load_params {
  // Size of this structure in bytes, set by bk_load_params_init.
  uint32_t struct_size;
  // BK_LOAD_ANY_FOLDER or 0. Default: 0.
  uint32_t flags;
  // UTF-8. Files that the scene names (material libraries, images, buffers) must lie in this folder or below,
  // symbolic links resolved. NULL, the default: in the scene file's own folder or below. Read only inside the call.
  const char *base_folder;
  // Most bytes of all decoded images together, 4 per texel. It is looked at before an image is decoded. (While one
  // is decoded, its own format takes up to 8 bytes per texel more.) Default: 2 GiB.
  uint64_t max_texture_bytes;
  // Most bytes of all files together, the scene file included. Default: 16 GiB.
  uint64_t max_file_bytes;
} bk_load_params;

// How to build the acceleration structure.
typedef struct bk_build_params {
  // Size of this structure in bytes, set by bk_build_params_init.
  uint32_t struct_size;
  // Bins per axis of the surface area heuristic, 2 to 256. Default: 64.
  uint32_t bins;
  // Most triangles per leaf, 1 to 8. Default: 4, as many as are tested at a time.
  uint32_t max_leaf;
  // One of BK_BUILD_QUALITY_*. Default: BK_BUILD_QUALITY_DEFAULT.
  uint32_t quality;
  // With BK_BUILD_QUALITY_HIGH: most references that cuts may add, in parts of the number of
  // triangles, 0 to 4; leaves grow by at most as much. Default: 0.25.
  float split_budget;
  // 1: the acceleration structure takes a fifth of the memory that it takes else, for rays that take
  // longer; hits are the same. (After BK_BUILD_QUALITY_HIGH, except for rays that graze an edge
  // within rounding.) Default: 0.
  uint32_t compact;
} bk_build_params;

// Numbers about a committed scene.
typedef struct bk_scene_stats {
  // Size of this structure in bytes, set by bk_scene_stats_init.
  uint32_t struct_size;
  // Surface area heuristic cost of the binary tree, traversal and intersection costing 1 each, at
  // the commit.
  float sah_cost;
  // Triangles in all meshes.
  uint64_t triangles;
  // Of those, degenerate or not finite at the commit, or since bk_scene_refit.
  uint64_t skipped_degenerate;
  // 8-wide nodes of the acceleration structure.
  uint64_t nodes;
  // Bytes of the acceleration structure.
  uint64_t bvh_bytes;
  // Bytes of the whole committed scene.
  uint64_t bytes;
  // Time of the build, in seconds.
  double build_seconds;
  // Surface area heuristic cost of the 8-wide tree as it is now, 1 for each node and each triangle
  // that a ray is expected to meet. Compare it with its value after the commit.
  float wide_sah_cost;
  // Times that bk_scene_refit moved something.
  uint32_t refits;
  // Time of the last of these, in seconds; 0 if there was none.
  double refit_seconds;
} bk_scene_stats;

// Creates an empty scene.
//
// device: kept alive by the scene. out: receives the scene, NULL on failure.
BK_API bk_result bk_scene_create(bk_device *device, bk_scene **out);

// Counts one more reference. NULL is ignored.
BK_API void bk_scene_retain(bk_scene *scene);

// Gives one reference back. NULL is ignored.
BK_API void bk_scene_release(bk_scene *scene);

// Sets struct_size and clears the rest.
BK_API void bk_load_info_init(bk_load_info *info);

// Fills in the defaults.
BK_API void bk_load_params_init(bk_load_params *params);

// Adds what a scene file describes: meshes, materials (emissive ones included) with their textures (PNG and
// JPEG), lights.
//
// path: UTF-8, ending in .obj (with its .mtl), .ply, .gltf or .glb. params: NULL for the defaults. progress, user:
// told how far it is, and may cancel; NULL if not wanted. out: what was added; NULL if not wanted.
//
// Only regular files are read, never devices, FIFOs or sockets. A material library or an image that cannot be read,
// or that lies where params allow none, is told to the device's log as a warning, and materials do without; a buffer
// of a glTF file that cannot be read is an error.
//
// Fails with BK_ERROR_IO, naming the file, if it cannot be read or is malformed, with BK_ERROR_UNSUPPORTED if its
// kind is unknown or the library was built without files, with BK_ERROR_OUT_OF_MEMORY beyond a limit of params, if
// the memory callback refuses or memory runs out, with BK_ERROR_CANCELLED, with BK_ERROR_INVALID_STATE after the
// commit or inside a callback; the scene is as before then. Other calls that change the scene fail meanwhile with
// BK_ERROR_INVALID_STATE.
BK_API
bk_result bk_scene_load_file(bk_scene *scene,
                             const char *path,
                             const bk_load_params *params,
                             bk_progress_fn progress,
                             void *user,
                             bk_load_info *out);

// Adds a scene made by code, with its lights: "cornell" (the Cornell box), "furnace" (a closed,
// glowing cube) or "atrium" (a two-floor court in the sun).
BK_API bk_result bk_scene_load_builtin(bk_scene *scene, const char *name);

// Fills in the defaults.
BK_API void bk_build_params_init(bk_build_params *params);

// Chooses how bk_scene_commit builds; without it the defaults hold.
BK_API bk_result bk_scene_set_build(bk_scene *scene, const bk_build_params *params);

// Ends the description: builds the acceleration structure on the device's threads. Afterwards the
// scene can be queried and baked, and only bk_scene_set_light, bk_mesh_set_positions and
// bk_scene_refit change it.
//
// progress, user: told how far it is; NULL if not wanted.
//
// Logs a warning if triangles are skipped, or if the scene lies so far from the origin that its f32
// coordinates have too few digits for its size: rays start 32 rounding steps above surfaces, and from
// about a thousand times the scene's size from the origin on that spoils light.
//
// Fails with BK_ERROR_INVALID_STATE if the scene is committed already or holds no usable triangle.
// A commit that fails or is cancelled leaves the description as it was.
BK_API bk_result bk_scene_commit(bk_scene *scene, bk_progress_fn progress, void *user);

// Gives the meshes of a committed scene the positions set by bk_mesh_set_positions since the last
// refit; without any it does nothing. Queries then meet the moved triangles, and what follows from
// positions (geometric normals, light of emissive triangles, bounds, statistics) follows.
//
// The acceleration structure keeps its shape and gets new boxes, on the device's threads, in a
// fraction of the time of a commit. It serves well while neighbours stay neighbours; where
// bk_scene_stats.wide_sah_cost has grown much since the commit, rays are slower,
// and a new scene would be better. After BK_BUILD_QUALITY_HIGH the first refit loses more than the
// cuts had gained, however little moved: scenes to be refitted want BK_BUILD_QUALITY_DEFAULT.
//
// Triangles that become degenerate or not finite are not hit while they are; those that were so at
// the commit stay out for good. Light maps, photon maps and live objects that were made before keep
// the geometry that they were made of (the scene is copied then, else changed in place) and go on
// following the scene's lights. Pointers from bk_scene_get_mesh become invalid.
//
// Fails with BK_ERROR_INVALID_STATE if the scene is not committed, if no triangle would be left that
// can be hit, or if another thread queries or changes the scene; with BK_ERROR_OUT_OF_MEMORY if the
// copy is refused. The scene is as before then, and the positions wait for the next refit.
BK_API bk_result bk_scene_refit(bk_scene *scene);

// Sets struct_size and clears the rest.
BK_API void bk_scene_stats_init(bk_scene_stats *stats);

// Numbers about a committed scene.
BK_API bk_result bk_scene_get_stats(const bk_scene *scene, bk_scene_stats *out);

// The bounding box of all valid triangles of a committed scene.
BK_API bk_result bk_scene_bounds(const bk_scene *scene, float lower[3], float upper[3]);

/* ================================================================================================
 * Textures
 *
 * Images that a scene uses. Added before its commit, and before what names them.
 *
 * Textures colour surfaces and cut holes into them. They are addressed by the first texture coordinates of
 * meshes (bk_mesh_desc.uvs), repeat beyond [0, 1], and are interpolated between the centres of texels.
 *
 * Environments are the images of skies: the whole sphere of directions by longitude and latitude. Row 0 is at
 * the zenith, the last row at the nadir; the middle of a row is the sky's front, and texels follow one another
 * to the right as seen from inside. Each texel is an area of uniform radiance, without interpolation.
 *
 * A scene without images spends neither memory nor time on them.
 * ================================================================================================ */

// Format: four bytes per texel, sRGB red, green and blue and linear alpha (255: opaque).
#define BK_TEXTURE_RGBA8_SRGB 0

// Format: three floats per texel, linear red, green and blue, finite and >= 0.
#define BK_TEXTURE_RGB32F 1

// An image. The texels are copied.
typedef struct bk_texture_desc {
  // Size of this structure in bytes, set by bk_texture_desc_init.
  uint32_t struct_size;
  // One of BK_TEXTURE. Default: BK_TEXTURE_RGBA8_SRGB.
  uint32_t format;
  // Texels along u, 1 to 16384.
  uint32_t width;
  // Texels along v, 1 to 16384.
  uint32_t height;
  // height rows of width texels. Row 0 lies at v = 0 and the first texel of a row at u = 0, as in glTF.
  const void *data;
  // Bytes from one row to the next, at least those of a row; 0: packed.
  size_t row_stride;
} bk_texture_desc;

// Fills in the defaults.
BK_API void bk_texture_desc_init(bk_texture_desc *desc);

// Adds a texture.
//
// out_id: receives its number, for materials; NULL if not wanted. Numbers count up from 0 in the order of
// addition.
//
// Fails with BK_ERROR_INVALID_ARGUMENT if a size or the stride is out of range, the format is unknown or data
// is NULL, with BK_ERROR_OUT_OF_MEMORY if there is no memory for a copy.
BK_API bk_result bk_scene_add_texture(bk_scene *scene, const bk_texture_desc *desc, uint32_t *out_id);

// Adds an environment, for lights of type BK_LIGHT_SKY. Its format must be BK_TEXTURE_RGB32F. It takes 16
// bytes per texel.
//
// out_id: receives its number; NULL if not wanted. Numbers count up from 0 in the order of addition, apart
// from those of other images.
//
// Fails with BK_ERROR_INVALID_ARGUMENT if a size or the stride is out of range, the format is another, data
// is NULL or a texel is not finite or less than 0; with BK_ERROR_OUT_OF_MEMORY if there is no memory for a
// copy; with BK_ERROR_INVALID_STATE after the commit.
BK_API
bk_result bk_scene_add_environment(bk_scene *scene,
                                   const bk_texture_desc *desc,
                                   uint32_t *out_id);

// The number of textures, committed or not; 0 on failure.
BK_API uint32_t bk_scene_texture_count(const bk_scene *scene);

// Shows a texture, without a copy.
BK_API bk_result bk_scene_get_texture(const bk_scene *scene, uint32_t id, bk_texture_desc *out);

// The number of environments, committed or not; 0 on failure.
BK_API uint32_t bk_scene_environment_count(const bk_scene *scene);

// Shows an environment, without a copy.
BK_API bk_result bk_scene_get_environment(const bk_scene *scene, uint32_t id, bk_texture_desc *out);

/* ================================================================================================
 * Materials and meshes
 *
 * Added to a scene before its commit; vertices can move after it. A refused addition changes
 * nothing.
 *
 * Input arrays are read inside the call only. Strides are in bytes, 0 means packed; neither
 * alignment nor bytes behind the last element are needed.
 * ================================================================================================ */

// Flag: the back side reflects and emits like the front. The back of a one-sided material absorbs
// what meets it and is not transmitted.
#define BK_MATERIAL_TWO_SIDED 1

// Flag: refuse degenerate triangles and vertices that are not finite, naming the first, rather
// than skip and count them.
#define BK_MESH_STRICT 1

// A diffuse material.
typedef struct bk_material_desc {
  // Size of this structure in bytes, set by bk_material_desc_init.
  uint32_t struct_size;
  // BK_MATERIAL flags. Default: 0.
  uint32_t flags;
  // Diffuse reflectance per channel, in [0, 1); with albedo_texture: its factor, in [0, 1]. Default: 0.5.
  float albedo[3];
  // Emitted radiance per channel in W/(m2 sr), >= 0. Default: 0.
  float emission[3];
  // Number of the texture that is multiplied with albedo, the product being limited to 0.98; BK_NONE: none.
  // Where a mesh has no uvs, albedo alone counts. Default: BK_NONE.
  uint32_t albedo_texture;
  // Points where the texture's alpha, interpolated and from 0 to 1, is less than this are holes, which rays and
  // photons do not meet, from whichever side. In [0, 1]; not for materials that emit. Holes cost rays that
  // meet them a second search. Default: 0, no holes.
  float alpha_cutoff;
  // Fraction of light per channel that passes straight through, from either side, as through a pane of
  // stained glass; at most 1 together with albedo. It is not textured. Light of lamps that comes through
  // is direct light. bk_intersect, bk_occluded and their like meet the surface all the same. Default: 0.
  float transmission[3];
} bk_material_desc;

// An indexed triangle mesh. The arrays are copied.
typedef struct bk_mesh_desc {
  // Size of this structure in bytes, set by bk_mesh_desc_init.
  uint32_t struct_size;
  // BK_MESH flags. Default: 0.
  uint32_t flags;
  // vertex_count positions of three floats.
  const float *positions;
  // Bytes from one position to the next, at least 12; 0: packed.
  size_t position_stride;
  // Number of vertices.
  size_t vertex_count;
  // Three vertex numbers per triangle, packed, each less than vertex_count.
  const uint32_t *indices;
  // Number of triangles; at most 2^28 in a scene.
  size_t triangle_count;
  // Optional: vertex_count shading normals of three floats.
  const float *normals;
  // Bytes from one normal to the next, at least 12; 0: packed.
  size_t normal_stride;
  // Optional: vertex_count texture coordinates of two floats, which place the textures of materials.
  const float *uvs;
  // Bytes from one texture coordinate to the next, at least 8; 0: packed.
  size_t uv_stride;
  // Optional: vertex_count light map coordinates of two floats, in [0, 1] on a page, no two
  // points of a page's triangles at the same place. Without them the mesh is unwrapped.
  const float *lightmap_uvs;
  // Bytes from one light map coordinate to the next, at least 8; 0: packed.
  size_t lightmap_uv_stride;
  // Optional, with lightmap_uvs only: light map page per triangle, packed. NULL: all on page 0.
  const uint32_t *lightmap_page;
  // Optional: material number per triangle, packed. NULL: all have `material`.
  const uint32_t *triangle_materials;
  // Material number of all triangles if triangle_materials is NULL. Default: 0.
  uint32_t material;
} bk_mesh_desc;

// The triangles of a mesh.
typedef struct bk_mesh_view {
  // Size of this structure in bytes, set by bk_mesh_view_init.
  uint32_t struct_size;
  // Material number of all triangles if triangle_materials is NULL, else BK_NONE.
  uint32_t material;
  // vertex_count positions of three floats, packed.
  const float *positions;
  // Number of vertices.
  size_t vertex_count;
  // Three vertex numbers per triangle, packed.
  const uint32_t *indices;
  // Number of triangles, degenerate ones included.
  size_t triangle_count;
  // vertex_count shading normals of three floats, packed; NULL if the mesh has none.
  const float *normals;
  // vertex_count texture coordinates of two floats, packed; NULL if the mesh has none.
  const float *uvs;
  // vertex_count light map coordinates of two floats, packed, as the caller gave them; NULL if the mesh has none.
  const float *lightmap_uvs;
  // Light map page per triangle, packed, as the caller gave them; NULL if all are on page 0.
  const uint32_t *lightmap_page;
  // Material number per triangle, packed; NULL if all have `material`.
  const uint32_t *triangle_materials;
} bk_mesh_view;

// Fills in the defaults.
BK_API void bk_material_desc_init(bk_material_desc *desc);

// Adds a material. The texture that it names must have been added before.
//
// out_id: receives its number, for meshes; NULL if not wanted. Numbers count up from 0 in the
// order of addition.
BK_API
bk_result bk_scene_add_material(bk_scene *scene,
                                const bk_material_desc *desc,
                                uint32_t *out_id);

// The number of materials, committed or not; 0 on failure.
BK_API uint32_t bk_scene_material_count(const bk_scene *scene);

// Fetches a material, committed or not.
BK_API bk_result bk_scene_get_material(const bk_scene *scene, uint32_t id, bk_material_desc *out);

// Fills in the defaults.
BK_API void bk_mesh_desc_init(bk_mesh_desc *desc);

// Adds a mesh. The materials that it names must have been added before.
//
// out_id: receives its number, as hits report it; NULL if not wanted. Numbers count up from 0 in
// the order of addition.
//
// Fails with BK_ERROR_INVALID_ARGUMENT, naming triangle and vertex, if an index or a material is
// out of range or BK_MESH_STRICT finds something.
BK_API bk_result bk_scene_add_mesh(bk_scene *scene, const bk_mesh_desc *desc, uint32_t *out_id);

// Sets new positions for all vertices of a mesh of a committed scene, to be put in force by
// bk_scene_refit; until then nothing changes. What was set for the mesh since the last refit is
// replaced.
//
// mesh: number of the mesh. positions: vertex_count positions of three floats, copied. vertex_count:
// as when the mesh was added. stride: bytes from one position to the next, at least 12; 0: packed.
// Shading normals, texture and light map coordinates stay as they were given.
//
// Positions that are not finite are taken, and their triangles are not hit after the refit, unless the
// mesh has BK_MESH_STRICT. Fails with BK_ERROR_INVALID_STATE if the scene is not committed or another
// thread is changing it.
BK_API
bk_result bk_mesh_set_positions(bk_scene *scene,
                                uint32_t mesh,
                                const float *positions,
                                size_t vertex_count,
                                size_t stride);

// The number of meshes, committed or not; 0 on failure.
BK_API uint32_t bk_scene_mesh_count(const bk_scene *scene);

// Sets struct_size and clears the rest.
BK_API void bk_mesh_view_init(bk_mesh_view *view);

// Shows the triangles of a mesh of a committed scene, without a copy.
//
// out: receives pointers that are valid while the scene lives, until the next bk_scene_refit.
BK_API bk_result bk_scene_get_mesh(const bk_scene *scene, uint32_t mesh, bk_mesh_view *out);

/* ================================================================================================
 * Lights
 *
 * Added to a scene before its commit, changed at any time. Emissive materials make lights too.
 * ================================================================================================ */

// Radiates from a position equally in all directions. color: radiant intensity in W/sr.
#define BK_LIGHT_POINT 1

// Radiates from a position in a cone around direction: fully up to cone_inner radians from it, not
// at all beyond cone_outer, smoothly in between. color: radiant intensity on the axis in W/sr.
#define BK_LIGHT_SPOT 2

// Light from infinitely far away that travels along direction: parallel or, with an angular_radius,
// from a disc of uniform radiance (the sun). color: irradiance on a plane that faces the middle of the
// disc, with all of it above its horizon, in W/m2. A disc takes direct_samples shadow rays per point.
#define BK_LIGHT_DIRECTIONAL 3

// A parallelogram with a corner at position and the edges edge_u and edge_v, which radiates from
// the side that edge_u x edge_v points to. color: radiance in W/(m2 sr). Rays do not hit it.
#define BK_LIGHT_RECT 4

// Light from all directions, infinitely far away: color is its radiance in W/(m2 sr) or, with an
// environment, the factor of the image. Takes 4 direct_samples shadow rays per point. Gather rays that
// leave the scene bring nothing: the sky is part of the direct light, as all lights are.
#define BK_LIGHT_SKY 5

// A light. Fields that its type does not use are ignored.
typedef struct bk_light_desc {
  // Size of this structure in bytes, set by bk_light_desc_init.
  uint32_t struct_size;
  // One of the BK_LIGHT values. Default: BK_LIGHT_POINT.
  uint32_t type;
  // Point, spot, and a corner of rect. Default: 0.
  float position[3];
  // Spot and directional: where the light travels, of any length but 0. Default: 0, to be set.
  float direction[3];
  // Rect: an edge. Default: 0, to be set.
  float edge_u[3];
  // Rect: the other edge, not parallel to edge_u. Default: 0, to be set.
  float edge_v[3];
  // Linear RGB, >= 0, in the unit of the type. Default: 1.
  float color[3];
  // Spot: half angle of the cone of full intensity, in radians, in [0, cone_outer]. Default: 0.
  float cone_inner;
  // Spot: half angle of the whole cone, in radians, in (0, pi]. Default: pi/4.
  float cone_outer;
  // Directional: radius of the disc in radians, in [0, pi/2]; less than 1e-5: parallel. The sun's is
  // 0.00465. Default: 0.
  float angular_radius;
  // Sky: number of its image, see bk_scene_add_environment; BK_NONE: none, the same radiance from all
  // directions. Default: BK_NONE.
  uint32_t environment;
  // Sky: where the zenith of the image is, of any length but 0. The front of the image then looks along
  // -z, or along +y if up is less than 45 degrees from the z axis, made perpendicular to up. Default:
  // (0, 1, 0).
  float up[3];
  // Sky: turns the image about up, counter-clockwise as seen from its tip, in radians. Default: 0.
  float rotation;
} bk_light_desc;

// Fills in the defaults.
BK_API void bk_light_desc_init(bk_light_desc *desc);

// Adds a light.
//
// out_id: receives its number; NULL if not wanted. Numbers count up from 0 in the order of
// addition.
BK_API bk_result bk_scene_add_light(bk_scene *scene, const bk_light_desc *desc, uint32_t *out_id);

// Replaces light `id`, before or after the commit; its type may change. A light is taken away by
// giving it no colour. What is being baked keeps the lights that it started with; a live object is
// told by bk_live_light_changed.
BK_API bk_result bk_scene_set_light(bk_scene *scene, uint32_t id, const bk_light_desc *desc);

// Fetches a light, committed or not.
BK_API bk_result bk_scene_get_light(const bk_scene *scene, uint32_t id, bk_light_desc *out);

// The number of lights (emissive materials not counted), committed or not; 0 on failure.
BK_API uint32_t bk_scene_light_count(const bk_scene *scene);

/* ================================================================================================
 * Rays
 *
 * All functions take a committed scene and are safe from any threads. A closest hit is the one with
 * the least t in tmin < t <= tmax; among equal t the triangle that was added first, whichever
 * function is asked. Directions need not be normalised; t is in units of the direction's length.
 * Both sides of a triangle are hit. A ray with a NaN, an origin beyond 1e18 or a zero direction hits
 * nothing.
 * ================================================================================================ */

// Flag: spread the rays over the device's threads. Without it the calling thread does the work.
#define BK_RAYS_PARALLEL 1

// The points origin + t direction with tmin < t <= tmax.
typedef struct bk_ray {
  float origin[3];
  float tmin;
  float direction[3];
  float tmax;
} bk_ray;

// What a ray hits. A miss has t = +infinity, u = v = 0, and BK_NONE in the rest.
typedef struct bk_hit {
  // Distance in units of the direction's length.
  float t;
  // Barycentric weight of the triangle's vertex 1.
  float u;
  // Barycentric weight of the triangle's vertex 2.
  float v;
  // Number of the triangle in its mesh.
  uint32_t triangle;
  // Number of the mesh.
  uint32_t mesh;
  // Not used yet: BK_NONE.
  uint32_t instance;
} bk_hit;

// The closest hit of one ray. On failure (a scene that is NULL or not committed, a NULL ray) out
// receives a miss, and bk_last_error the reason.
BK_API void bk_intersect(const bk_scene *scene, const bk_ray *ray, bk_hit *out);

// Whether anything lies on the ray: 1 or 0. On failure 0, and bk_last_error has the reason.
BK_API int32_t bk_occluded(const bk_scene *scene, const bk_ray *ray);

// The closest hits of many rays. Fastest where consecutive rays share origin, tmin and tmax and go
// nearly the same way, as those of a pinhole camera do in small square tiles of pixels; the hits are
// the same, bit for bit, in any order of rays.
//
// rays: count rays, aligned to 4 bytes. flags: 0 or BK_RAYS_PARALLEL. out: receives
// count hits in the order of the rays; must not overlap them.
BK_API
bk_result bk_intersect_many(const bk_scene *scene,
                            const bk_ray *rays,
                            size_t count,
                            uint32_t flags,
                            bk_hit *out);

// Whether anything lies on each of many rays.
//
// rays: count rays, aligned to 4 bytes. flags: 0 or BK_RAYS_PARALLEL. out: receives
// count bytes, 1 or 0, in the order of the rays; must not overlap them.
BK_API
bk_result bk_occluded_many(const bk_scene *scene,
                           const bk_ray *rays,
                           size_t count,
                           uint32_t flags,
                           uint8_t *out);

// The closest hits of rays that share an origin, with 0 < t <= tmax: those of bk_intersect_many.
// Faster than as many single rays; use 32 directions and more.
//
// directions: count directions of three floats, packed, aligned to 4 bytes. flags:
// BK_RAYS_PARALLEL. out: receives count hits in the order of the directions; must not overlap them.
BK_API
bk_result bk_gather(const bk_scene *scene,
                    const float origin[3],
                    const float *directions,
                    size_t count,
                    float tmax,
                    uint32_t flags,
                    bk_hit *out);

/* ================================================================================================
 * Photon maps
 *
 * A photon map is light frozen on surfaces: photons emitted by the lights in proportion to their
 * power, traced with Russian roulette, and kept where they meet diffuse surfaces. It gives the
 * irradiance at any point. It is complete when created and never changes; all functions on it are
 * safe from any threads.
 * ================================================================================================ */

// Flag: leave out photons that come straight from a light; the map then holds indirect light only.
#define BK_PHOTONS_INDIRECT_ONLY 1

// A photon map.
typedef struct bk_photon_map bk_photon_map;

// How to trace photons.
typedef struct bk_photon_params {
  // Size of this structure in bytes, set by bk_photon_params_init.
  uint32_t struct_size;
  // BK_PHOTONS flags. Default: 0.
  uint32_t flags;
  // Photons to emit, 1 to 2^32. They meet 1 / (1 - albedo) surfaces each, and take 96 bytes for each
  // while the map is made, half of them later. Default: 1,000,000.
  uint64_t photon_count;
  // Most surfaces that a photon meets; 0, the default: Russian roulette alone ends its path. At most
  // 10,000 in any case.
  uint32_t max_bounces;
  // Search radius of the estimate in scene units, finite and at least 1.2e-38; 0, the default: from
  // the density of photons.
  float radius;
  // Half the height of the search cylinder, as a fraction of the radius, finite and > 0.
  // Default: 0.25.
  float half_height;
  // Constant of Jensen's cone filter, >= 1; +infinity: no filter. Default: 1.1.
  float cone_k;
  // Seed of all random numbers. The same seed gives the same bits on any number of threads.
  // Default: 0.
  uint64_t seed;
  // Bytes that the map may take while it is made; 0, the default: no limit.
  uint64_t memory_budget;
} bk_photon_params;

// The stored photons, array by array.
typedef struct bk_photon_view {
  // Size of this structure in bytes, set by bk_photon_view_init.
  uint32_t struct_size;
  // Search radius in use, in scene units.
  float radius;
  // Number of stored photons.
  size_t count;
  // count times three floats, packed: where it lies.
  const float *position;
  // count times three floats, packed: unit direction of travel.
  const float *direction;
  // count times three floats, packed: power in W.
  const float *power;
} bk_photon_view;

// Fills in the defaults.
BK_API void bk_photon_params_init(bk_photon_params *params);

// Traces photons through a committed scene, on the device's threads.
//
// params: NULL for the defaults. progress, user: told how far it is; NULL if not wanted. out:
// receives the map, NULL on failure.
//
// Fails with BK_ERROR_INVALID_ARGUMENT if a field of params is out of its range,
// BK_ERROR_INVALID_STATE if the scene is not committed or has no lights, BK_ERROR_OUT_OF_MEMORY if
// the map would not fit into memory_budget or the memory callback refuses, BK_ERROR_CANCELLED if
// progress says so. Lights without power make an empty map.
BK_API
bk_result bk_photon_map_create(const bk_scene *scene,
                               const bk_photon_params *params,
                               bk_progress_fn progress,
                               void *user,
                               bk_photon_map **out);

// Counts one more reference. NULL is ignored.
BK_API void bk_photon_map_retain(bk_photon_map *map);

// Gives one reference back. NULL is ignored.
BK_API void bk_photon_map_release(bk_photon_map *map);

// Irradiance (W/m2) at points of surfaces, on the side that the normal points to; the calling
// thread does the work.
//
// positions, normals: count times three floats, packed, aligned to 4 bytes; normals of length 1.
// out_irradiance_rgb: receives count times three floats, packed, finite and >= 0, at most 1e30; must
// not overlap the inputs.
//
// The estimate takes the search disc to lie wholly on the surface: less than a radius from an edge it
// falls, to half at the edge, and photons behind a wall that crosses the disc count. Positions and
// normals that are not finite give 0.
BK_API
bk_result bk_photon_map_estimate(const bk_photon_map *map,
                                 const float *positions,
                                 const float *normals,
                                 size_t count,
                                 float *out_irradiance_rgb);

// Sets struct_size and clears the rest.
BK_API void bk_photon_view_init(bk_photon_view *view);

// Shows the stored photons. The first call packs them, 36 bytes each, for as long as the map lives.
//
// out: receives pointers that are valid while the map lives. If no photon was stored, count is 0
// and the pointers must not be read.
//
// Fails with BK_ERROR_OUT_OF_MEMORY if the memory callback refuses the packed copy that the first
// call makes.
BK_API bk_result bk_photon_map_get_photons(const bk_photon_map *map, bk_photon_view *out);

/* ================================================================================================
 * Light maps
 *
 * A light map lays the surfaces of a committed scene out on square pages and, once baked, holds
 * irradiance E (W/m2) per texel: a shader shows albedo / pi * E. Texel (0, 0) is at uv (0, 0);
 * rows follow v.
 *
 * One thread at a time may bake a light map; reads are safe from any threads. A read during a bake,
 * or a second bake, fails with BK_ERROR_INVALID_STATE.
 * ================================================================================================ */

// A light map: a layout and, once baked, light.
typedef struct bk_lightmap bk_lightmap;

// How to lay out a light map.
typedef struct bk_lightmap_desc {
  // Size of this structure in bytes, set by bk_lightmap_desc_init.
  uint32_t struct_size;
  // Texels per scene unit of what is unwrapped, finite and >= 0; 0, the default: so that the scene
  // fills about one page. All pages of a map together hold at most 2^29 texels.
  float texels_per_unit;
  // Width and height of a page in texels, 16 to 16384. Default: 1024.
  uint32_t page_size;
  // Texels around each chart that filtering may read, 1 to 64, at most a quarter of page_size.
  // Default: 2.
  uint32_t padding;
  // Light map texels per texel of the gather map (indirect light), along each axis, 1 to 64.
  // Default: 4.
  uint32_t gather_divisor;
  // Light map texels per texel of the radiance map (what gather rays see), along each axis, 1 to 64.
  // Default: 4.
  uint32_t radiance_divisor;
  // Whether two-sided charts of which both sides are seen from open places get a second place for their
  // backs, which bk_lightmap_mesh_back_uvs tells of. Open places have free space around them; those
  // outside of buildings count where a sun or a sky shines as the light map is created. Without a second
  // place, a chart shows the side that is seen, or the one that the bake chooses. 0: no, any other value:
  // yes. Default: 1.
  uint32_t both_sides;
} bk_lightmap_desc;

// Numbers about a light map's layout.
typedef struct bk_lightmap_info {
  // Size of this structure in bytes, set by bk_lightmap_info_init.
  uint32_t struct_size;
  // Number of pages.
  uint32_t page_count;
  // Width of each page in texels.
  uint32_t width;
  // Height of each page in texels.
  uint32_t height;
  // Charts: pieces of surface that are flat in the light map.
  uint32_t charts;
  // Of those, taken from the caller's coordinates.
  uint32_t given_charts;
  // Of those, made by unwrapping.
  uint32_t unwrapped_charts;
  // Of those, reduced in density to fit a page.
  uint32_t reduced_charts;
  // Of charts, those with a second place for their backs; see both_sides of bk_lightmap_desc.
  uint32_t both_sided_charts;
  // Texels per scene unit in use.
  float texels_per_unit;
  // Texels that a triangle covers: the range of texel_begin and texel_end of a bake.
  uint64_t texels;
  // Texels of the gather map.
  uint64_t gather_texels;
  // Texels of the radiance map.
  uint64_t radiance_texels;
  // Bytes held.
  uint64_t bytes;
  // Triangles whose given coordinates lie outside [0, 1]; they were unwrapped.
  uint64_t uv_out_of_range;
  // Triangles with an area in space whose given coordinates have none; they were unwrapped.
  uint64_t uv_degenerate;
  // Texels whose centre is covered by several triangles of given coordinates.
  uint64_t uv_overlapping_texels;
  // Time of unwrapping, in seconds.
  double unwrap_seconds;
  // Of texels, those of the second places: the last so many.
  uint64_t back_texels;
} bk_lightmap_info;

// Fills in the defaults.
BK_API void bk_lightmap_desc_init(bk_lightmap_desc *desc);

// Lays out a light map of a committed scene: meshes with light map coordinates keep them, the
// others are unwrapped, texels are mapped to triangles. Runs on the device's threads.
//
// scene: kept alive by the light map. desc: NULL for the defaults. progress, user: told how far it
// is; NULL if not wanted. out: receives the light map, NULL on failure.
//
// Logs a warning if the scene lies so far from the origin that rays start more than a quarter of a
// texel above surfaces: 32 rounding steps of its coordinates.
//
// Fails with BK_ERROR_INVALID_ARGUMENT if a field of desc is out of its range or a mesh names a page
// beyond 2^29 texels, BK_ERROR_INVALID_STATE if the scene is not committed, BK_ERROR_OUT_OF_MEMORY
// if there would be more than 2^29 texels, they do not fit, or the memory callback refuses,
// BK_ERROR_CANCELLED if progress says so.
BK_API
bk_result bk_lightmap_create(const bk_scene *scene,
                             const bk_lightmap_desc *desc,
                             bk_progress_fn progress,
                             void *user,
                             bk_lightmap **out);

// Counts one more reference. NULL is ignored.
BK_API void bk_lightmap_retain(bk_lightmap *lightmap);

// Gives one reference back. NULL is ignored.
BK_API void bk_lightmap_release(bk_lightmap *lightmap);

// Sets struct_size and clears the rest.
BK_API void bk_lightmap_info_init(bk_lightmap_info *info);

// Numbers about the layout.
BK_API bk_result bk_lightmap_get_info(const bk_lightmap *lightmap, bk_lightmap_info *out);

// Where the triangles of a mesh lie in the light map.
//
// out_corner_uvs: receives u and v in [0, 1] of each corner, 3 * triangles * 2 floats, aligned to 4
// bytes; NULL if not wanted. out_page_per_triangle: receives triangles page numbers, BK_NONE for
// triangles without texels; NULL if not wanted.
//
// Fails with BK_ERROR_INVALID_ARGUMENT if there is no such mesh, with BK_ERROR_INVALID_STATE while
// the light map is being baked.
BK_API
bk_result bk_lightmap_mesh_uvs(const bk_lightmap *lightmap,
                               uint32_t mesh,
                               float *out_corner_uvs,
                               uint32_t *out_page_per_triangle);

// Where the backs of the triangles of a mesh lie in the light map. A shader that reads
// gl_FrontFacing ? uv : back_uv, and the page accordingly, shows the right light on both sides.
//
// out_corner_uvs, out_page_per_triangle: as of bk_lightmap_mesh_uvs; of triangles whose back has no
// place of its own, the same as there. out_own_place_per_triangle: receives triangles bytes, 1 where
// the back has a place of its own (see both_sides of bk_lightmap_desc), else 0; NULL if not wanted.
//
// Fails as bk_lightmap_mesh_uvs does.
BK_API
bk_result bk_lightmap_mesh_back_uvs(const bk_lightmap *lightmap,
                                    uint32_t mesh,
                                    float *out_corner_uvs,
                                    uint32_t *out_page_per_triangle,
                                    uint8_t *out_own_place_per_triangle);

/* ================================================================================================
 * Baking
 *
 * A bake fills a light map with light: photons, radiance map, gather map (indirect light), direct
 * light, composition, stitching of seams. What the scene does not need is not run.
 * ================================================================================================ */

// Bit of left_out. No indirect light: no photons, radiance map and gather map.
#define BK_LEFT_OUT_INDIRECT 1

// Bit of left_out. No photons and no estimate: no light is reflected more than once.
#define BK_LEFT_OUT_PHOTONS 2

// Bit of left_out. No direct light: nothing shines.
#define BK_LEFT_OUT_DIRECT 4

// Bit of left_out. No sampling of area lights.
#define BK_LEFT_OUT_AREA_LIGHTS 8

// Bit of left_out. No radiance of back sides.
#define BK_LEFT_OUT_BACK_SIDES 16

// Bit of left_out. No blur of the gather map.
#define BK_LEFT_OUT_BLUR 32

// Bit of left_out. No unwrapping: all meshes bring usable coordinates.
#define BK_LEFT_OUT_UNWRAP 64

// Bit of left_out. No interpolation of shading normals.
#define BK_LEFT_OUT_SHADING_NORMALS 128

// Bit of left_out. No look-ups of albedo textures.
#define BK_LEFT_OUT_TEXTURES 256

// Bit of left_out. No tests for holes that textures cut out.
#define BK_LEFT_OUT_CUTOUTS 512

// Bit of left_out. No light through surfaces.
#define BK_LEFT_OUT_TRANSMISSION 1024

// Bit of left_out. No light from a sky.
#define BK_LEFT_OUT_SKY 2048

// Bit of left_out. No directional light with an angular_radius.
#define BK_LEFT_OUT_SUN_DISC 4096

// Bit of left_out. No choice among many lights: at most 64 point and spot lights, each of which gets a
// shadow ray, and at most 64 rect lights and emissive triangles. More of either are sampled, with up to 4
// direct_samples shadow rays for all.
#define BK_LEFT_OUT_MANY_LIGHTS 8192

// Bit of left_out. No stitching of seams.
#define BK_LEFT_OUT_SEAMS 16384

// Bit of left_out. No bright patches of surfaces as lights: gather rays find most of what is bright.
#define BK_LEFT_OUT_BRIGHT_PATCHES 32768

// How to bake.
typedef struct bk_bake_params {
  // Size of this structure in bytes, set by bk_bake_params_init.
  uint32_t struct_size;
  // Most reflections of light before it reaches a texel; 0, the default: Russian roulette alone
  // decides.
  uint32_t max_bounces;
  // Photons to emit, at most 2^32; 0: no light that is reflected more than once. A sixteenth as many, at
  // most 65,536, are traced before to find out where to send them. Default: 1,000,000.
  uint64_t photon_count;
  // Rays per texel of the gather map, at most 65536; 0: no indirect light. With every 64 go up to 16
  // shadow rays to bright patches of surfaces, where there are any (BK_LEFT_OUT_BRIGHT_PATCHES).
  // Texels of the light map that no texel of the gather map around stands for (some 1 to 3 %) trace up to 16
  // rays of their own. Default: 64.
  uint32_t gather_rays;
  // Photon search radius in scene units, finite and at least 1.2e-38; 0, the default: from the number of photons that
  // reach surfaces and the lit area, and at least three quarters of a texel of the radiance map, so that no photon
  // lies between the places where light is estimated. Photons that are not seen from the middle of their disc, as
  // those behind a wall, do not count, and neither does the surface there.
  float radius;
  // Radius of the gather map's blur in its texels, at most 16; 0: none. Default: 2.
  uint32_t blur_radius;
  // Shadow rays per light map texel and area light or disc of a directional light, 1 to 4096 (of
  // more than four area lights, four times as many rays are shared out); four times as many per sky,
  // and for all of many lights (BK_LEFT_OUT_MANY_LIGHTS). They start from 4 points spread over the
  // texel, or from 16 in the penumbra of a disc. Point, spot and parallel lights take one ray each, and
  // 4 to 16 more, spread over the texel, where shadow edges cross it. Default: 16.
  uint32_t direct_samples;
  // Seed of all random numbers. The same seed gives the same bits on any number of threads.
  // Default: 0.
  uint64_t seed;
  // Bytes that the bake may take in addition to scene and light map; 0, the default: no limit.
  uint64_t memory_budget;
  // First covered texel to bake, for spreading a bake over several runs, at most the number of
  // texels that bk_lightmap_info tells. Default: 0.
  uint64_t texel_begin;
  // One behind the last covered texel to bake, above texel_begin and at most the number of texels;
  // 0, the default: all.
  uint64_t texel_end;
  // Whether seams are stitched: where a smooth surface is cut open in the light map, both sides of
  // the edge are made to show the same under bilinear filtering, by moving the texels that the edge
  // shows and no others. Done when all texels are baked. 0: no, any other value: yes. Live updates
  // do not stitch: their finished texels have the bits of a bake with 0. Default: 1.
  uint32_t stitch;
  // Seconds between two writes of the checkpoint, 0 to 1e9. A process that is killed loses at most the
  // work of so long; 0: of the blocks of texels under way. Default: 10.
  float checkpoint_seconds;
  // Name of a file, UTF-8, in which the bake keeps what it has done; NULL, the default: none. A bake with the
  // same scene, lights, light map and parameters that finds the file goes on from it, whatever ended
  // the one before (a cancel, an error, a kill), and gives the bits of a bake without a break, on any
  // number of threads. The file is created if it is not there. It stays when the bake is complete:
  // delete it when the light has been saved. bk_bake fails with BK_ERROR_INVALID_ARGUMENT if the file is of
  // another bake (bk_last_error says in what it differs), with BK_ERROR_IO if it is damaged, is not a checkpoint or
  // cannot be read or created, with BK_ERROR_INVALID_STATE if another bake is using it, and leaves it as it is. If it
  // cannot be written later, as on a full disk, the bake goes on, logs a warning, and what the file
  // holds stays whole.
  const char *checkpoint;
} bk_bake_params;

// What one stage of a bake took.
typedef struct bk_stage_stats {
  // Time, in seconds.
  double seconds;
  // Rays traced.
  uint64_t rays;
  // Bytes of its buffers.
  uint64_t bytes;
} bk_stage_stats;

// What a bake did.
typedef struct bk_bake_stats {
  // Size of this structure in bytes, set by bk_bake_stats_init.
  uint32_t struct_size;
  // BK_LEFT_OUT bits: what the plan found unnecessary.
  uint32_t left_out;
  // Time of the whole bake, in seconds.
  double seconds;
  // The most bytes held at once on the device, scene and light map included.
  uint64_t peak_bytes;
  // Photons emitted.
  uint64_t photons_emitted;
  // Photons stored on surfaces.
  uint64_t photons_stored;
  // Tracing and sorting photons.
  bk_stage_stats photons;
  // The radiance map: outgoing radiance from the photons.
  bk_stage_stats radiance;
  // The gather map: indirect light.
  bk_stage_stats gather;
  // Direct light with shadow rays.
  bk_stage_stats direct;
  // Filtering and composition.
  bk_stage_stats compose;
  // Two-sided charts whose light map shows the back, because the distance that one sees from it
  // times the cube root of its light is more than twice that of the front.
  uint64_t back_charts;
  // Points, half a texel apart at most, along the edges that were stitched.
  uint64_t seam_points;
  // How much the two sides of these edges showed different light under bilinear filtering: root mean
  // square over the edges' lengths, relative to the mean irradiance there. 0 without seams.
  double seam_rms_before;
  // The same after the stitching.
  double seam_rms_after;
  // Finding and stitching seams, in seconds.
  double seam_seconds;
} bk_bake_stats;

// Fills in the defaults.
BK_API void bk_bake_params_init(bk_bake_params *params);

// Sets struct_size and clears the rest.
BK_API void bk_bake_stats_init(bk_bake_stats *stats);

// Computes the light of all texels, or of the given range, on the device's threads. May be called
// again, with other lights or parameters.
//
// params: NULL for the defaults. progress, user: told how far it is; NULL if not wanted. out: what
// was done; NULL if not wanted.
//
// The same scene, lights, light map, parameters and seed give the same bits on any number of threads, in one
// bake or in several of some texels each, and on AVX2 as on AVX-512; portable kernels, which round products and sums
// apart, give others.
//
// All light is finite and >= 0: irradiance is cut off at 1e30 W/m2 per light.
//
// Fails with BK_ERROR_INVALID_ARGUMENT if a field of params is out of its range,
// BK_ERROR_INVALID_STATE if another call is using the light map, BK_ERROR_OUT_OF_MEMORY if
// memory_budget is exceeded or the memory callback refuses, BK_ERROR_CANCELLED if progress says so. A
// bake that fails or is cancelled keeps what was baked before, and can be repeated.
BK_API
bk_result bk_bake(bk_lightmap *lightmap,
                  const bk_bake_params *params,
                  bk_progress_fn progress,
                  void *user,
                  bk_bake_stats *out);

// Describes in words what the last bake ran (before the first: what a bake with default parameters
// would run), and what it left out and why, one line each.
//
// dst: receives as much of the text (UTF-8) as fits, with a NUL; may be NULL if capacity is 0.
// capacity: bytes that dst has room for.
//
// Returns the length of the whole text without its NUL, whatever the capacity; 0 on failure.
BK_API size_t bk_plan_describe(const bk_lightmap *lightmap, char *dst, size_t capacity);

/* ================================================================================================
 * Reading and saving light maps
 * ================================================================================================ */

// Irradiance, direct and indirect, in W/m2. RGB: BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F.
#define BK_LAYER_COMBINED 0

// Irradiance by way of other surfaces, in W/m2. RGB.
#define BK_LAYER_INDIRECT 1

// Irradiance straight from lights, in W/m2. RGB.
#define BK_LAYER_DIRECT 2

// Outgoing radiance as gather rays see it, in W/(m2 sr). RGB.
#define BK_LAYER_RADIANCE 3

// 1 for a texel that a triangle covers; 0.5 for one whose light is filled in from its neighbours, because
// it lies in the padding around a chart or inside a solid; 0 for an empty one. After a bake of some
// texels, those that are not baked yet, and the padding that repeats them, are 0 too; before the first
// bake covered texels are 1. BK_FORMAT_R32F.
#define BK_LAYER_VALIDITY 4

// Position of the texel's sample in the scene; 0 where no triangle covers the texel. RGB.
#define BK_LAYER_POSITION 5

// Unit normal of the texel's sample, on the side whose light it holds (before a bake the front, but for
// backs with texels of their own); 0 where no triangle covers the texel. RGB.
#define BK_LAYER_NORMAL 6

// Number of the triangle that covers the texel, counted through all meshes in their order; BK_NONE
// where there is none. BK_FORMAT_R32U.
#define BK_LAYER_TRIANGLE 7

// Three floats: 12 bytes per texel.
#define BK_FORMAT_RGB32F 1

// Four half floats: 8 bytes per texel. Alpha is 1; values beyond 65504 are clamped to it.
#define BK_FORMAT_RGBA16F 2

// One float: 4 bytes per texel.
#define BK_FORMAT_R32F 3

// One uint32_t: 4 bytes per texel.
#define BK_FORMAT_R32U 4

// Float images of the light layers: PREFIXpageN-LAYER.exr, LAYER one of combined, indirect, direct,
// radiance.
#define BK_FILE_EXR 1

// Tone-mapped 8-bit images of the light layers, to look at: PREFIXpageN-LAYER.png.
#define BK_FILE_PNG 2

// The scene with its light map, for viewers and engines: PREFIXscene.glb (glTF 2.0). The light map is read through
// TEXCOORD_1. Materials without a texture of their own are unlit and have the light map as baseColorTexture, so that
// any viewer shows the light. Others keep their texture as baseColorTexture on TEXCOORD_0 and have the light map as
// occlusionTexture on TEXCOORD_1: viewers with light of their own dim it by that, and importers find it there.
// Each page is an 8-bit sRGB image of irradiance times an exposure, bent above 0.6; the extras of the asset and of
// each material say which texture, the exposure and the curve. Triangles whose back has texels of its own are there
// twice, one-sided.
#define BK_FILE_GLB 3

// Copies one layer of one page.
//
// layer: one of the BK_LAYER values. BK_LAYER_COMBINED, INDIRECT, DIRECT and RADIANCE hold light and need
// a bake; VALIDITY, POSITION, NORMAL and TRIANGLE can be read at any time but during one. In the layers
// of light each texel of the padding repeats the nearest covered texel. format: one of the BK_FORMAT
// values that suits the layer, as stated there. dst: receives height rows, row_stride bytes apart, of
// width texels; needs no alignment. row_stride: at least the bytes of a row of texels; 0: just that many.
//
// Fails with BK_ERROR_INVALID_ARGUMENT if page, layer or format does not exist or row_stride is too
// small, BK_ERROR_INVALID_STATE if the layer holds light and there was no bake, or during a bake,
// BK_ERROR_OUT_OF_MEMORY if a page does not fit.
BK_API
bk_result bk_lightmap_read(const bk_lightmap *lightmap,
                           uint32_t page,
                           uint32_t layer,
                           uint32_t format,
                           void *dst,
                           size_t row_stride);

// Writes a baked light map to files.
//
// path_prefix: UTF-8, put before the file names that the BK_FILE values state, as "out/" for files
// in the folder out, which must exist. file_format: one of the BK_FILE values. progress, user: told how far it is,
// and may cancel; NULL if not wanted.
//
// Each file is written beside the old one of its name (NAME.part), flushed to disk, and renamed: whatever ends the
// call early, a full disk, a cancel or a kill, each old file is there as a whole or replaced as a whole. After a kill
// NAME.part may be left; the next save writes over it.
//
// Fails with BK_ERROR_IO, naming the file, if it cannot be written or another call is writing it, with
// BK_ERROR_INVALID_STATE before a bake or inside a callback, with BK_ERROR_CANCELLED, with BK_ERROR_OUT_OF_MEMORY,
// with BK_ERROR_UNSUPPORTED if the library was built without files or a GLB file would have more than 4 GiB.
BK_API
bk_result bk_lightmap_save(const bk_lightmap *lightmap,
                           const char *path_prefix,
                           uint32_t file_format,
                           bk_progress_fn progress,
                           void *user);

// Writes the light of all texels that have been baked so far to a file, from which bk_lightmap_load_result brings
// it back, in another process or on another machine.
//
// path: UTF-8; the file is replaced as a whole or not at all. progress, user: the progress callback and its
// pointer; progress may be NULL.
//
// Fails with BK_ERROR_INVALID_STATE before a bake, during one, or if bakes that differ in parameters or lights filled
// the texels; with BK_ERROR_IO, naming the file, if it cannot be written; with BK_ERROR_CANCELLED if
// progress says so.
BK_API
bk_result bk_lightmap_save_result(const bk_lightmap *lightmap,
                                  const char *path,
                                  bk_progress_fn progress,
                                  void *user);

// Takes over the light of a file that bk_lightmap_save_result wrote for a light map of the same scene, lights and
// layout. Light of texels that the file does not have stays: so machines can bake some texels each (texel_begin
// and texel_end of bk_bake_params, all else equal) and one of them loads all files, in any order; the light then
// has the bits of one bake, and seams are stitched with the last texels.
//
// path: UTF-8. progress, user: the progress callback and its pointer; progress may be NULL.
//
// Fails with BK_ERROR_INVALID_ARGUMENT if the file is of another scene, light map or version of the library, of other
// lights, or of another instruction set (AVX2 and AVX-512 are the same in this), and bk_last_error says which;
// with BK_ERROR_INVALID_STATE if the file has some texels alone and the light map holds light of a bake with other
// parameters, or another call is using the light map; with BK_ERROR_IO, naming the file, if it cannot be read, is
// damaged, or is no result; with BK_ERROR_OUT_OF_MEMORY if it does not fit; with BK_ERROR_CANCELLED if progress says
// so. A call that fails changes nothing.
BK_API
bk_result bk_lightmap_load_result(bk_lightmap *lightmap,
                                  const char *path,
                                  bk_progress_fn progress,
                                  void *user);

/* ================================================================================================
 * Live updates
 *
 * A live object lights a scene at once, coarsely, and refines it while somebody walks through: call
 * bk_live_update once per frame with the camera and a time budget, fetch the rectangles of texels
 * that changed, and read and upload those. All levels of detail (LODs) are shown in pages of the
 * light map's size and layout; a lower LOD is interpolated.
 *
 * One call at a time may use a live object, from any thread: a second one that comes while it runs
 * fails with BK_ERROR_INVALID_STATE and changes nothing. Reads (bk_live_read, bk_live_cell_lods,
 * bk_live_lod_at) exclude updates only, not each other. Source: Schouls 2017, section 3.3.
 * ================================================================================================ */

// Work on what the camera sees, most where estimated error times visibility is largest.
#define BK_LIVE_VIEW 0

// Work on the grid cells near the camera, visible ones first. A cell shows its next LOD when all its
// texels have it.
#define BK_LIVE_POSITION 1

// Work anywhere, at random: to compare with.
#define BK_LIVE_UNIFORM 2

// Added to the format of bk_live_read: leave direct light out, for applications that shade it
// themselves.
#define BK_FORMAT_INDIRECT_ONLY 256

// A scene's light under refinement.
typedef struct bk_live bk_live;

// How to update.
typedef struct bk_live_params {
  // Size of this structure in bytes, set by bk_live_params_init.
  uint32_t struct_size;
  // One of the BK_LIVE modes. Default: BK_LIVE_VIEW.
  uint32_t mode;
  // Levels of detail, 1 to 4: the lowest computes every 2^(lod_count - 1)-th texel of the gather map
  // along each axis, the highest all. Default: 3.
  uint32_t lod_count;
  // Rounds of 64 rays that each texel of a cell needs before the cell shows its next LOD, 1 to
  // max_rounds. Default: 1.
  uint32_t promote_threshold;
  // Rounds of 64 rays after which a texel is finished, 1 to 1024. Default: 16.
  uint32_t max_rounds;
  // The most rays that an update traces, whatever its budget; 0, the default: no such limit.
  uint32_t rays_per_update;
  // Radius in texels of the gather map of a blur for display, 0 to 16; what is accumulated is not
  // blurred. Default: 2.
  uint32_t blur;
  // Edge of a grid cell in scene units, finite and >= 0; 0, the default: a sixteenth of the scene's
  // longest side. A grid of more than 2^24 cells is refused.
  float cell_size;
  // Seed of all random numbers, as in bk_bake_params. Default: 0.
  uint64_t seed;
  // Photons to emit, as in bk_bake_params. Default: 1,000,000.
  uint64_t photon_count;
  // Most reflections, as in bk_bake_params. Default: 0.
  uint32_t max_bounces;
  // Shadow rays per light map texel and area light, as in bk_bake_params. Default: 16.
  uint32_t direct_samples;
  // Photon search radius, as in bk_bake_params. Default: 0.
  float radius;
  // 1: the device's threads go on working between updates, on what the last one saw. Default: 0.
  uint32_t background;
} bk_live_params;

// Where somebody looks from.
typedef struct bk_camera {
  // Size of this structure in bytes, set by bk_camera_init.
  uint32_t struct_size;
  // Width of the picture in pixels, >= 1: only the aspect matters. Default: 1920.
  uint32_t width;
  // Height of the picture in pixels, >= 1. Default: 1080.
  uint32_t height;
  // Position in the scene. Default: the origin.
  float position[3];
  // Direction of view, of any length > 0. Default: -z.
  float forward[3];
  // Upwards, of any length > 0, not parallel to forward. Default: +y.
  float up[3];
  // Vertical field of view in radians, in (0, pi). Default: 1.
  float fov_y;
} bk_camera;

// What an update may take. Both limits 0: nothing is traced.
typedef struct bk_budget {
  // Size of this structure in bytes, set by bk_budget_init.
  uint32_t struct_size;
  // Time in milliseconds, finite and >= 0; 0: no limit by time. Default: 4.
  float milliseconds;
  // Rays; 0, the default: no limit by rays. A round of 64 that was begun is finished.
  uint64_t rays;
} bk_budget;

// What an update did, and how things stand.
typedef struct bk_live_stats {
  // Size of this structure in bytes, set by bk_live_stats_init.
  uint32_t struct_size;
  // 1 while indirect light is being recomputed because a light has changed, else 0.
  uint32_t light_pending;
  // Time that the update took.
  float milliseconds;
  // Estimated relative error of indirect light where the camera looks.
  float visible_error;
  // Part of the light map that is finished, 0 to 1.
  float finished;
  // Part of what the camera sees that is finished, 0 to 1.
  float visible_finished;
  // Rays traced by the update, and in the background since the one before.
  uint64_t rays;
  // Rays traced since the beginning.
  uint64_t total_rays;
  // Cells that went to a higher LOD (BK_LIVE_POSITION).
  uint32_t cells_promoted;
  // Blocks of 8 x 8 texels of the gather map whose shown light changed.
  uint32_t blocks_changed;
  // Bytes that the live object holds.
  uint64_t bytes;
  // Bytes that it would hold with all LODs worked on everywhere.
  uint64_t bytes_full;
} bk_live_stats;

// Where the cells of the light map grid lie.
typedef struct bk_cell_info {
  // Size of this structure in bytes, set by bk_cell_info_init.
  uint32_t struct_size;
  // Cells along x, y and z.
  uint32_t dimensions[3];
  // Lower corner of the first cell, in the scene.
  float origin[3];
  // Edge of a cell in scene units.
  float cell_size;
} bk_cell_info;

// A rectangle of texels of a page.
typedef struct bk_rect {
  // Number of the page.
  uint32_t page;
  // LOD of what is to be read; of dirty rectangles always the highest: lod_count - 1.
  uint32_t lod;
  // First column.
  uint32_t x;
  // First row.
  uint32_t y;
  // Columns.
  uint32_t width;
  // Rows.
  uint32_t height;
} bk_rect;

// Fills in the defaults.
BK_API void bk_live_params_init(bk_live_params *params);

// Fills in the defaults.
BK_API void bk_camera_init(bk_camera *camera);

// Fills in the defaults.
BK_API void bk_budget_init(bk_budget *budget);

// Sets struct_size and clears the rest.
BK_API void bk_live_stats_init(bk_live_stats *stats);

// Sets struct_size and clears the rest.
BK_API void bk_cell_info_init(bk_cell_info *info);

// Computes photons and the lowest LOD under the lights of now, on the device's threads: a second or
// two for a large scene. All pages are dirty afterwards.
//
// lightmap: its layout is used; it need not be baked, is not changed, and may be released. params:
// NULL for the defaults. progress, user: told how far it is; NULL if not wanted. out: receives the live object,
// NULL on failure.
//
// Fails with BK_ERROR_OUT_OF_MEMORY if memory is not to be had or the memory callback refuses, and with
// BK_ERROR_CANCELLED if progress says so; nothing is left behind then.
BK_API
bk_result bk_live_create(bk_lightmap *lightmap,
                         const bk_live_params *params,
                         bk_progress_fn progress,
                         void *user,
                         bk_live **out);

// Counts one more reference. NULL is ignored.
BK_API void bk_live_retain(bk_live *live);

// Gives one reference back. NULL is ignored.
//
// The last release stops work between updates and the recomputation of indirect light, and waits until both have
// ended: no callback comes from them afterwards. It may be made in a callback, on any thread; only when it is made
// in a memory callback that the recomputation of indirect light calls, that work ends just after the callback has
// returned, and may call the memory callback once more for what it gives back. A thread that makes the last
// release must not hold a lock that a callback takes.
BK_API
void bk_live_release(bk_live *live);

// Refines the light for as long as the budget allows, on the device's threads.
//
// camera: where somebody looks from; it may be inside walls or outside the scene. budget: NULL for
// 4 ms. out: what was done; NULL if not wanted.
//
// A camera with coordinates that are not finite, with no extent or field of view, or whose forward
// and up are parallel, and a budget that is negative or not finite are refused
// (BK_ERROR_INVALID_ARGUMENT). BK_ERROR_OUT_OF_MEMORY if memory is not to be had or the memory callback
// refuses it, for a higher LOD or for indirect light that is being recomputed; what has been computed stays, and the
// next update tries again.
BK_API
bk_result bk_live_update(bk_live *live,
                         const bk_camera *camera,
                         const bk_budget *budget,
                         bk_live_stats *out);

// Fetches rectangles of texels whose shown light has changed since they were last fetched, merged
// where that adds little. Texels around charts (padding) are included.
//
// out: receives at most capacity rectangles; NULL if capacity is 0. count: receives how many. What
// does not fit is kept for the next call: fetch until count < capacity.
BK_API
bk_result bk_live_dirty_rects(bk_live *live,
                              bk_rect *out,
                              size_t capacity,
                              size_t *count);

// Copies irradiance as shown, in W/m2, for a rectangle of a page.
//
// lod: lod_count - 1 for what is shown; less: what would be shown if no texel were above that LOD
// (slow: for comparison). format: BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F, with BK_FORMAT_INDIRECT_ONLY
// added or not. rect: x, y, width and height count, page and lod do not; NULL: the whole page. dst:
// receives the rectangle's rows, row_stride bytes apart; needs no alignment. row_stride: at least
// the bytes of a row; 0: just that many.
BK_API
bk_result bk_live_read(const bk_live *live,
                       uint32_t page,
                       uint32_t lod,
                       uint32_t format,
                       const bk_rect *rect,
                       void *dst,
                       size_t row_stride);

// The light map grid and the LOD that each of its cells shows, to be put into a 3D texture.
//
// info: receives where the cells lie. out: receives one LOD per cell, x fastest, 255 in cells without
// surfaces; NULL if capacity is 0 and only info is wanted. capacity: bytes that out has room for, at
// least the number of cells unless 0.
BK_API
bk_result bk_live_cell_lods(const bk_live *live,
                            bk_cell_info *info,
                            uint8_t *out,
                            size_t capacity);

// The LOD that is shown at a position: three floats. BK_NONE outside the grid, in cells without
// surfaces, and on failure.
BK_API uint32_t bk_live_lod_at(const bk_live *live, const float *position);

// To be called after bk_scene_set_light: direct light follows in the next
// updates, first where the camera looks; photons are traced again on a thread of their own, and
// indirect light follows as they come, the old fading out. Several changes may be followed by one
// call.
//
// light: number of a light that changed.
BK_API bk_result bk_live_light_changed(bk_live *live, uint32_t light);

// Stops work between updates (background), and the recomputation of indirect light, or lets both go
// on with the next update. Updates still do what their budget allows.
//
// paused: 1 or 0.
BK_API bk_result bk_live_pause(bk_live *live, uint32_t paused);

// Writes what has been accumulated to a file, to go on from another time; an existing file is
// replaced once the new one is whole. Light that is older than the last change of a light is left
// out.
//
// path: UTF-8. progress, user: told how far it is; NULL if not wanted.
//
// Fails with BK_ERROR_IO if the file cannot be written, and with BK_ERROR_CANCELLED if progress says so; an
// existing file is as it was then, and the live object too.
BK_API bk_result bk_live_save(bk_live *live, const char *path, bk_progress_fn progress, void *user);

// Goes on from a file that was saved of the same scene, light map, lights and parameters (mode, cell
// size, promotion, blur and limits may differ). All pages are dirty afterwards.
//
// Every number of the file is checked to be one that updates could have arrived at: light is finite and >= 0, counts
// fit the light map. For a moment the call needs memory for the light that is shown twice.
//
// path: UTF-8. progress, user: told how far it is; NULL if not wanted.
//
// Fails with BK_ERROR_IO if the file cannot be read or is damaged, with BK_ERROR_INVALID_ARGUMENT if it is of
// something else, with BK_ERROR_OUT_OF_MEMORY if memory is not to be had or the memory callback refuses, and with
// BK_ERROR_CANCELLED if progress says so; nothing is changed then.
BK_API
bk_result bk_live_restore(bk_live *live,
                          const char *path,
                          bk_progress_fn progress,
                          void *user);

#ifdef __cplusplus
} /* extern "C" */
#endif

#endif /* BAKELITE_H */
