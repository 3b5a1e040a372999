//! Scenes
//!
//! A scene is first described (materials, meshes, lights, files) and then committed: the commit
//! builds the acceleration structure. A committed scene can be queried and baked. Only its lights
//! (bk_scene_set_light) and the positions of its vertices (bk_mesh_set_positions, bk_scene_refit)
//! can change.
//!
//! Units: coordinates are right-handed with any up axis, in any unit of length ("scene units"; W/m2
//! then means watts per square scene unit), valid up to a magnitude of 1e12. Front faces are
//! counter-clockwise. Colours are linear RGB. All surfaces are diffuse.
//!
//! Thread safety: one thread at a time may describe, commit, move or refit a scene; a second one
//! fails with BK_ERROR_INVALID_STATE. Queries of a committed scene are safe from any thread, at any
//! time except during bk_scene_refit: then the later call fails with BK_ERROR_INVALID_STATE.
//!
//! Cost: functions that are not described otherwise take less than a microsecond beside copying
//! their input.

use super::args::{OutStruct, init, read_bool, read_struct, sized_struct, write};
use super::device::{bk_device, bk_progress_fn, progress, refuse_in_callback};
use super::error::{bk_result, call, call_or};
use super::handles::{create, hold, object, release, retain};
use super::shared::{Reading, Shared};
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{Reservation, try_push};
use crate::base::progress::Progress;
use crate::bvh::{BuildOptions, BuildQuality};
use crate::device::Device;
use crate::scene::{Scene, SceneData};
use glam::{Affine3A, Vec3};
use std::collections::BTreeMap;
use std::ffi::c_void;
use std::sync::{Arc, Mutex, OnceLock, TryLockError};

/// Handle of a scene, described or committed.
pub struct bk_scene {
    pub(super) device: Arc<Device>,
    /// Set once by the commit.
    committed: OnceLock<Shared<Arc<Scene>>>,
    /// State that changes before and after the commit. Only ever tried, never waited for.
    changes: Mutex<Changes>,
}

struct Changes {
    /// `None` once committed.
    description: Option<Description>,
    /// By mesh, the positions that the next refit gives it.
    moved: BTreeMap<u32, Vec<Vec3>>,
    /// By instance, the transform that the next refit gives it.
    placed: BTreeMap<u32, Affine3A>,
}

#[derive(Default)]
pub(super) struct Description {
    pub(super) data: SceneData,
    build: BuildOptions,
    /// Announced bytes of the arrays in `data`, which grow with the input.
    announced: Vec<Reservation>,
}

impl Description {
    /// Adds all of another scene.
    pub(super) fn append(&mut self, mut other: SceneData, device: &Device) -> Result<()> {
        let mut reservation = device.memory().reserve(other.bytes(), "the scene's description")?;
        device.install(|| other.move_to(device.storage(), &Progress::none()))?;
        reservation.shrink(other.bytes_in_memory());
        self.data.append(other)?;
        try_push(&mut self.announced, reservation, "the scene's description")
    }
}

impl bk_scene {
    /// Changes the description. `what` completes "… after the commit".
    pub(super) fn describe<R>(&self, what: &str, change: impl FnOnce(&mut Description) -> Result<R>) -> Result<R> {
        self.with_description(|description| match description {
            Some(d) => change(d),
            None => Err(Error::InvalidState(format!("the scene is committed: {what} no more"))),
        })
    }

    /// Adds `bytes` of arrays to the description, which are announced before `read` copies them and until the commit,
    /// which announces the whole scene. `read` gives back what it moves to files.
    pub(super) fn describe_large<A, R>(
        &self,
        what: &str,
        bytes: usize,
        read: impl FnOnce(&mut Reservation) -> Result<A>,
        add: impl FnOnce(&mut SceneData, A) -> Result<R>,
    ) -> Result<R> {
        self.describe(what, |description| {
            let mut reservation = self.device.memory().reserve(bytes, "the scene's description")?;
            let added = add(&mut description.data, read(&mut reservation)?)?;
            try_push(&mut description.announced, reservation, "the scene's description")?;
            Ok(added)
        })
    }

    /// Commits what has been described, with trees of an earlier scene where that has them.
    fn commit(&self, earlier: Option<&Scene>, progress: &Progress) -> Result<()> {
        self.device.check_process()?;
        self.with_description(|slot| {
            let Some(Description { data, build, announced }) = slot.take() else {
                return Err(Error::InvalidState("the scene is committed already".into()));
            };
            // The commit announces the same arrays again.
            drop(announced);
            let committed = match earlier {
                Some(earlier) => Scene::commit_from(&self.device, data, &build, earlier, progress),
                None => Scene::commit(&self.device, data, &build, progress),
            };
            match committed {
                Ok(committed) => {
                    // The description was there, so nothing was committed before.
                    let _ = self.committed.set(Shared::new(committed));
                    Ok(())
                }
                Err((data, e)) => {
                    // They are held anyway, so that a refusal is no reason to lose them.
                    let held = self.device.memory().reserve(data.bytes_in_memory(), "the scene's description");
                    *slot = Some(Description { data, build, announced: held.into_iter().collect() });
                    Err(e)
                }
            }
        })
    }

    /// Becomes the committed scene that `open` makes, if nothing has been described.
    pub(super) fn open(&self, open: impl FnOnce(&Arc<Device>) -> Result<Arc<Scene>>) -> Result<()> {
        self.with_description(|slot| {
            match slot {
                None => return Err(Error::InvalidState("the scene is committed already".into())),
                Some(d) if !d.data.is_empty() => {
                    return Err(Error::InvalidState(
                        "the scene is not empty: a scene file is opened as a whole".into(),
                    ));
                }
                Some(_) => {}
            }
            // Nothing was committed before.
            let _ = self.committed.set(Shared::new(open(&self.device)?));
            *slot = None;
            Ok(())
        })
    }

    fn with_description<R>(&self, f: impl FnOnce(&mut Option<Description>) -> Result<R>) -> Result<R> {
        self.with_changes(|c| f(&mut c.description))
    }

    fn with_changes<R>(&self, f: impl FnOnce(&mut Changes) -> Result<R>) -> Result<R> {
        match self.changes.try_lock() {
            Ok(mut changes) => f(&mut changes),
            Err(TryLockError::WouldBlock) => {
                Err(Error::InvalidState("another call is changing the scene at the same time".into()))
            }
            Err(TryLockError::Poisoned(_)) => {
                Err(Error::InvalidState("an internal error has left the scene unusable".into()))
            }
        }
    }

    pub(super) fn is_committed(&self) -> bool {
        self.committed.get().is_some()
    }

    /// The committed scene, kept from refits meanwhile.
    #[inline]
    pub(super) fn committed(&self) -> Result<Reading<'_, Arc<Scene>>> {
        self.shared()?.read()
    }

    #[inline]
    fn shared(&self) -> Result<&Shared<Arc<Scene>>> {
        self.committed.get().ok_or_else(|| Error::InvalidState("the scene is not committed".into()))
    }

    /// Keeps positions for the next refit.
    pub(super) fn set_positions(&self, mesh: u32, positions: impl FnOnce() -> Result<Vec<Vec3>>) -> Result<()> {
        self.with_changes(|changes| {
            let positions = positions()?;
            self.committed()?.check_positions(mesh, &positions)?;
            changes.moved.insert(mesh, positions);
            Ok(())
        })
    }

    /// Keeps a transform for the next refit.
    pub(super) fn set_transform(&self, instance: u32, transform: Affine3A) -> Result<()> {
        self.with_changes(|changes| {
            self.committed()?.check_transform(instance, transform)?;
            changes.placed.insert(instance, transform);
            Ok(())
        })
    }

    /// Reads something that the scene has in either state.
    pub(super) fn either<R>(
        &self,
        described: impl Fn(&SceneData) -> Result<R>,
        committed: impl Fn(&Scene) -> Result<R>,
    ) -> Result<R> {
        if self.is_committed() {
            return committed(&**self.committed()?);
        }
        self.with_description(|d| match d {
            Some(d) => described(&d.data),
            None => committed(&**self.committed()?),
        })
    }

    /// Counts something that the scene has in either state.
    pub(super) fn count(
        &self,
        described: impl Fn(&SceneData) -> usize,
        committed: impl Fn(&Scene) -> usize,
    ) -> Result<u32> {
        self.either(|d| Ok(described(d) as u32), |s| Ok(committed(s) as u32))
    }
}

/// Creates an empty scene.
///
/// @param device  kept alive by the scene
/// @param out  receives the scene, which the caller releases with bk_scene_release; NULL on failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a pointer is NULL
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_create(device: *mut bk_device, out: *mut *mut bk_scene) -> bk_result {
    // SAFETY: out is the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        let device = object!(device).device().clone();
        let changes =
            Changes { description: Some(Description::default()), moved: BTreeMap::new(), placed: BTreeMap::new() };
        write(out, create(bk_scene { device, committed: OnceLock::new(), changes: Mutex::new(changes) }), "out")
    })
}

/// Adds one reference.
///
/// @param scene  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_retain(scene: *mut bk_scene) {
    // SAFETY: a handle or NULL.
    unsafe { retain(scene) }
}

/// Releases one reference.
///
/// @param scene  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_release(scene: *mut bk_scene) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(scene);
        Ok(())
    })
}

/// Parameters of the acceleration structure.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_build_params {
    /// Size of this structure in bytes, set by bk_build_params_init.
    pub struct_size: u32,
    /// Number of bins per axis of the surface area heuristic, 2 to 256. Default: 64.
    pub bins: u32,
    /// Maximum number of triangles per leaf, 1 to 8. Default: 4, the number that is tested at a
    /// time.
    pub max_leaf: u32,
    /// One of the BK_BUILD_QUALITY values. Default: BK_BUILD_QUALITY_DEFAULT.
    pub quality: u32,
    /// With BK_BUILD_QUALITY_HIGH: maximum number of references that spatial splits may add, as a
    /// fraction of the number of triangles, 0 to 4. Leaves grow by at most as much. Default: 0.25.
    pub split_budget: f32,
    /// Experimental: 1 builds compact trees, which take a fifth of the memory and make rays slower;
    /// 0 builds full ones. The hits are the same, except for rays that graze an edge within
    /// rounding after BK_BUILD_QUALITY_HIGH. Default: 0.
    pub compact: u32,
}

/// Build quality: binned surface area heuristic.
pub const BK_BUILD_QUALITY_DEFAULT: u32 = 0;

/// Build quality: binned surface area heuristic with spatial splits, which may cut triangles. The
/// build takes several times as long and the tree up to a sixth more memory. Closest hits take 10
/// to 20 % less work where large or slanted triangles overlap others, as in most buildings;
/// occlusion rays may take 10 % more, since they reach large triangles later.
pub const BK_BUILD_QUALITY_HIGH: u32 = 1;

sized_struct!(bk_build_params, defaults: {
    let b = BuildOptions::default();
    bk_build_params {
        struct_size: size_of::<bk_build_params>() as u32,
        bins: b.bins,
        max_leaf: b.max_leaf,
        quality: b.quality as u32,
        split_budget: b.split_budget,
        compact: b.compact as u32,
    }
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_build_params_init(params: *mut bk_build_params) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(params) }
}

/// Sets the parameters with which bk_scene_commit builds the acceleration structure.
///
/// @param scene  scene that is not committed
/// @param params  copied
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_set_build(scene: *mut bk_scene, params: *const bk_build_params) -> bk_result {
    call(|| {
        let scene = object!(scene);
        // SAFETY: params is the caller's, or NULL.
        let params = unsafe { read_struct(params, "params") }?;
        let quality = match params.quality {
            BK_BUILD_QUALITY_DEFAULT => BuildQuality::Default,
            BK_BUILD_QUALITY_HIGH => BuildQuality::High,
            q => return invalid_argument!("quality is {q}, not one of BK_BUILD_QUALITY_*"),
        };
        let build = BuildOptions {
            bins: params.bins,
            max_leaf: params.max_leaf,
            quality,
            split_budget: params.split_budget,
            compact: read_bool(params.compact, "compact")?,
        };
        build.validate()?;
        scene.describe("the build can be chosen", |d| {
            d.build = build;
            Ok(())
        })
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_commit(
    scene: *mut bk_scene,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    call(|| {
        refuse_in_callback()?;
        // SAFETY: a handle or NULL.
        let scene = unsafe { hold(scene, "scene") }?;
        scene.commit(None, &self::progress(progress, user))
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_commit_from(
    scene: *mut bk_scene,
    earlier: *const bk_scene,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    call(|| {
        refuse_in_callback()?;
        // SAFETY: handles or NULL.
        let (scene, earlier) = unsafe { (hold(scene, "scene")?, hold(earlier.cast_mut(), "earlier")?) };
        let earlier = earlier.committed()?.clone();
        scene.commit(Some(&earlier), &self::progress(progress, user))
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_refit(scene: *mut bk_scene) -> bk_result {
    call(|| {
        refuse_in_callback()?;
        // SAFETY: a handle or NULL.
        let scene = unsafe { hold(scene, "scene") }?;
        scene.device.check_process()?;
        let shared = scene.shared()?;
        scene.with_changes(|changes| {
            if changes.moved.is_empty() && changes.placed.is_empty() {
                return Ok(());
            }
            let moved: Vec<(u32, &[Vec3])> = changes.moved.iter().map(|(mesh, p)| (*mesh, &p[..])).collect();
            let placed: Vec<(u32, Affine3A)> = changes.placed.iter().map(|(&i, &t)| (i, t)).collect();
            shared.write(|scene| Scene::refit_with(scene, &moved, &placed))??;
            (changes.moved, changes.placed) = (BTreeMap::new(), BTreeMap::new());
            Ok(())
        })
    })
}

/// Numbers about a committed scene.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_scene_stats {
    /// Size of this structure in bytes, set by bk_scene_stats_init.
    pub struct_size: u32,
    /// Surface area heuristic cost of the binary tree of the meshes without instances after the
    /// commit, a relative number: 1 per traversal step and per intersection.
    pub sah_cost: f32,
    /// Number of triangles, those of every instance counted.
    pub triangles: u64,
    /// Number of triangles that are degenerate or not finite, at the commit or since
    /// bk_scene_refit, and are not hit; those of a mesh with instances count once.
    pub skipped_degenerate: u64,
    /// Number of 8-wide nodes of the acceleration structure.
    pub nodes: u64,
    /// Size of the acceleration structure in bytes.
    pub bvh_bytes: u64,
    /// Size of the whole committed scene in bytes.
    pub bytes: u64,
    /// Duration of the build, or of opening the file, in seconds.
    pub build_seconds: f64,
    /// Surface area heuristic cost of the 8-wide tree of the same meshes in its present shape, a
    /// relative number: 1 for each node and each triangle that a random ray is expected to visit.
    /// Compare it with its value after the commit.
    pub wide_sah_cost: f32,
    /// Number of calls of bk_scene_refit that moved something.
    pub refits: u32,
    /// Duration of the last of these calls in seconds; 0 if there was none.
    pub refit_seconds: f64,
    /// Number of `bytes` that are in a mapped scene file (bk_scene_open), or in files of
    /// bk_device_desc.scratch_folder, instead of in memory, as far as the system does not keep them
    /// there because it has room.
    pub mapped_bytes: u64,
    /// Number of triangles, those of a mesh with instances counted once, whose trees
    /// bk_scene_commit_from took over.
    pub kept_triangles: u64,
}

sized_struct!(bk_scene_stats, defaults: stats(&Default::default()));

fn stats(s: &crate::scene::SceneStats) -> bk_scene_stats {
    bk_scene_stats {
        struct_size: size_of::<bk_scene_stats>() as u32,
        sah_cost: s.sah_cost,
        triangles: s.triangles,
        skipped_degenerate: s.skipped_degenerate,
        nodes: s.nodes,
        bvh_bytes: s.bvh_bytes,
        bytes: s.bytes,
        build_seconds: s.build_seconds,
        wide_sah_cost: s.wide_sah_cost,
        refits: s.refits,
        refit_seconds: s.refit_seconds,
        mapped_bytes: s.mapped_bytes,
        kept_triangles: s.kept_triangles,
    }
}

/// Sets `struct_size` and clears the other fields.
///
/// @param stats  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_stats_init(stats: *mut bk_scene_stats) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(stats) }
}

/// Gets numbers about a committed scene.
///
/// @param scene  committed scene
/// @param out  receives the numbers
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_get_stats(scene: *const bk_scene, out: *mut bk_scene_stats) -> bk_result {
    call(|| {
        let scene = object!(scene);
        let committed = scene.committed()?;
        // SAFETY: out is the caller's, or NULL.
        unsafe { OutStruct::new(out, "out") }?.write(stats(committed.stats()));
        Ok(())
    })
}

/// cbindgen:ptrs-as-arrays=[[lower; 3], [upper; 3]]
/// Gets the bounding box of all valid triangles of a committed scene.
///
/// @param scene  committed scene
/// @param lower  receives the smallest x, y and z, in scene units
/// @param upper  receives the largest x, y and z, in scene units
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_bounds(scene: *const bk_scene, lower: *mut f32, upper: *mut f32) -> bk_result {
    call(|| {
        let bounds = object!(scene).committed()?.bounds();
        // SAFETY: lower and upper are the caller's, or NULL.
        unsafe {
            write(lower.cast::<[f32; 3]>(), bounds.0.to_array(), "lower")?;
            write(upper.cast::<[f32; 3]>(), bounds.1.to_array(), "upper")
        }
    })
}
