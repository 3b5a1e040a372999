//! Light maps
//!
//! A light map lays the surfaces of a committed scene out on square pages and, once baked, holds
//! irradiance E (W/m2) per texel: a shader shows albedo / pi * E. Texel (0, 0) is at uv (0, 0);
//! rows follow v. Indirect light is computed in two coarser maps with the same charts: the radiance
//! map, which gather rays look up, and the gather map.
//!
//! Thread safety: one thread at a time may bake a light map; reads are safe from any thread. A read
//! during a bake, and a second bake, fail with BK_ERROR_INVALID_STATE.
//!
//! Cost: see bk_lightmap_create; the other functions copy their results.

use super::args::{OutStruct, SizedStruct, init, read_bool, read_strided, read_struct, sized_struct, slice_mut, write};
use super::device::{bk_progress_fn, call_with_file, progress, refuse_in_callback};
use super::error::{bk_result, call, call_or};
use super::handles::{create, hold, object, release, retain};
use super::scene::bk_scene;
use crate::base::error::{Error, Result, invalid_argument};
use crate::lightmap::{Lightmap, LightmapDesc, LightmapInfo, MAX_REGIONS, MeshUvs};
use std::ffi::{c_char, c_void};
use std::sync::{Arc, RwLock, TryLockError};

/// Handle of a light map: a layout and, once baked, light.
pub struct bk_lightmap {
    /// Only ever tried, never waited for.
    lightmap: RwLock<Lightmap>,
}

impl bk_lightmap {
    pub(super) fn read<R>(&self, f: impl FnOnce(&Lightmap) -> Result<R>) -> Result<R> {
        match self.lightmap.try_read() {
            Ok(lightmap) => f(&lightmap),
            Err(TryLockError::WouldBlock) => Err(Error::InvalidState("the light map is being baked".into())),
            Err(TryLockError::Poisoned(_)) => Err(unusable()),
        }
    }

    pub(super) fn change<R>(&self, f: impl FnOnce(&mut Lightmap) -> Result<R>) -> Result<R> {
        match self.lightmap.try_write() {
            Ok(mut lightmap) => {
                lightmap.scene().device().check_process()?;
                f(&mut lightmap)
            }
            Err(TryLockError::WouldBlock) => {
                Err(Error::InvalidState("another call is using the light map at the same time".into()))
            }
            Err(TryLockError::Poisoned(_)) => Err(unusable()),
        }
    }
}

fn unusable() -> Error {
    Error::InvalidState("an internal error has left the light map unusable".into())
}

/// Parameters of bk_lightmap_create.
///
/// Measured curves of these fields: docs/accuracy.md, "Which knobs have a curve".
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_lightmap_desc {
    /// Size of this structure in bytes, set by bk_lightmap_desc_init.
    pub struct_size: u32,
    /// Density of unwrapped charts in texels per scene unit, finite and >= 0; 0: chosen so that the
    /// scene fills about one page. All pages of a map together hold at most 2^29 texels. Raise it
    /// for sharper shadows and narrow gaps: memory and most of the time grow with its square, and
    /// in the Cornell box the error fell to a quarter when it was doubled from 8 to 16 and to 43 %
    /// from 16 to 32. Default: 0.
    pub texels_per_unit: f32,
    /// Width and height of a page in texels, 16 to 16384. Raise it to the largest page that the
    /// graphics card takes well, if charts are reduced (bk_lightmap_info.reduced_charts) or pages
    /// are many; the error does not depend on it while no charts are reduced. Default: 1024.
    pub page_size: u32,
    /// Distance around each chart that filtering may read, in texels, 1 to 64 and at most a quarter
    /// of `page_size`. Raise it to 2^n for n mip levels, or to the block of a texture compression;
    /// it costs texels between charts. Default: 2.
    pub padding: u32,
    /// Number of light map texels per texel of the gather map, along each axis, 1 to 64. Lower it
    /// to 2 or 1 for contact shadows and narrow places, the first field to change; the time of the
    /// gather map grows with the inverse square. 8 has 7 times the error of 4 in the Cornell box.
    /// Default: 4.
    pub gather_divisor: u32,
    /// Number of light map texels per texel of the radiance map, along each axis, 1 to 64. Lower it
    /// to 2 or 1 near lamps and where the sun comes through small openings; the time of the
    /// radiance map grows with the inverse square. Default: 4.
    pub radiance_divisor: u32,
    /// 1: two-sided charts that can be seen from open places on both sides get separate texels for
    /// their backs, see bk_lightmap_mesh_back_uvs. Open places are points with free space around
    /// them; those outside of buildings count if a directional light or a sky shines when the light
    /// map is created. 0: no separate texels; each two-sided chart shows the side that can be seen,
    /// or the one that the bake chooses (bk_bake_stats.back_charts). Set it to 0 where nobody sees
    /// both sides of a sheet: backs took 6 % of the texels in a living room and 23 % in Sponza.
    /// Default: 1.
    pub both_sides: u32,
    /// Number of boxes in `seen_from`, at most 4096. Default: 0.
    pub seen_from_count: u32,
    /// From where the scene is looked at: boxes of six floats each, the least and the greatest
    /// coordinates, the same for a point; copied by the call. Charts that cannot be seen from there
    /// have a single texel each, and their light costs next to nothing. They still reflect light.
    /// Charts with light map coordinates of the caller keep their texels. Set it where the camera
    /// stays in some rooms or on paths: in closed rooms half of the texels and more are never seen.
    /// bk_lightmap_info.unseen_charts and spared_texels count them. NULL: from anywhere. Default:
    /// NULL.
    pub seen_from: *const f32,
}

sized_struct!(bk_lightmap_desc, defaults: {
    let d = LightmapDesc::default();
    bk_lightmap_desc {
        struct_size: size_of::<bk_lightmap_desc>() as u32,
        texels_per_unit: d.texels_per_unit,
        page_size: d.page_size,
        padding: d.padding,
        gather_divisor: d.gather_divisor,
        radiance_divisor: d.radiance_divisor,
        both_sides: d.both_sides as u32,
        seen_from_count: 0,
        seen_from: std::ptr::null(),
    }
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_desc_init(desc: *mut bk_lightmap_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_create(
    scene: *const bk_scene,
    desc: *const bk_lightmap_desc,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut *mut bk_lightmap,
) -> bk_result {
    // SAFETY: desc and out are the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        refuse_in_callback()?;
        // Its geometry as of now: it may be refitted meanwhile.
        let scene = Arc::clone(&*hold(scene, "scene")?.committed()?);
        scene.device().check_process()?;
        let desc = core_desc(desc)?;
        let lightmap = Lightmap::create(&scene, &desc, &self::progress(progress, user))?;
        write(out, create(bk_lightmap { lightmap: RwLock::new(lightmap) }), "out")
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_create_from(
    scene: *const bk_scene,
    desc: *const bk_lightmap_desc,
    earlier: *const bk_lightmap,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut *mut bk_lightmap,
) -> bk_result {
    // SAFETY: desc and out are the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        refuse_in_callback()?;
        let scene = Arc::clone(&*hold(scene, "scene")?.committed()?);
        scene.device().check_process()?;
        let desc = core_desc(desc)?;
        let earlier = hold(earlier, "earlier")?;
        let progress = self::progress(progress, user);
        let lightmap = earlier.read(|earlier| Lightmap::create_from(&scene, &desc, earlier, &progress))?;
        write(out, create(bk_lightmap { lightmap: RwLock::new(lightmap) }), "out")
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_follow(
    lightmap: *mut bk_lightmap,
    scene: *const bk_scene,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: handles, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let lightmap = hold(lightmap, "lightmap")?;
        let scene = Arc::clone(&*hold(scene, "scene")?.committed()?);
        lightmap.change(|l| l.follow(&scene, &self::progress(progress, user)))
    })
}

/// # Safety
/// `desc` is NULL or the caller's structure.
unsafe fn core_desc(desc: *const bk_lightmap_desc) -> Result<LightmapDesc> {
    // SAFETY: by contract.
    let read = || unsafe { read_struct(desc, "desc") };
    let d: bk_lightmap_desc = if desc.is_null() { SizedStruct::defaults() } else { read()? };
    if d.seen_from_count as usize > MAX_REGIONS {
        return invalid_argument!("seen_from_count is {}, more than {MAX_REGIONS}", d.seen_from_count);
    }
    // SAFETY: by contract the boxes are there to be read.
    let seen_from = unsafe { read_strided(d.seen_from, 0, d.seen_from_count as usize, "seen_from") }?;
    Ok(LightmapDesc {
        texels_per_unit: d.texels_per_unit,
        page_size: d.page_size,
        padding: d.padding,
        gather_divisor: d.gather_divisor,
        radiance_divisor: d.radiance_divisor,
        both_sides: read_bool(d.both_sides, "both_sides")?,
        seen_from,
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_save_layout(
    lightmap: *const bk_lightmap,
    path: *const c_char,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: a handle or NULL; path is the caller's, or NULL.
    unsafe {
        call_with_file((lightmap, "lightmap"), (path, "path"), |lightmap, path| {
            lightmap.read(|l| l.save_layout(path.as_ref(), &self::progress(progress, user)))
        })
    }
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_load_layout(
    scene: *const bk_scene,
    desc: *const bk_lightmap_desc,
    path: *const c_char,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut *mut bk_lightmap,
) -> bk_result {
    // SAFETY: desc, path and out are the caller's, or NULL.
    unsafe {
        if let Err(e) = write(out, std::ptr::null_mut(), "out") {
            return call(|| Err(e));
        }
        call_with_file((scene, "scene"), (path, "path"), |scene, path| {
            let scene = Arc::clone(&*scene.committed()?);
            scene.device().check_process()?;
            let desc = core_desc(desc)?;
            let lightmap = Lightmap::load_layout(&scene, &desc, path.as_ref(), &self::progress(progress, user))?;
            write(out, create(bk_lightmap { lightmap: RwLock::new(lightmap) }), "out")
        })
    }
}

/// Adds one reference.
///
/// @param lightmap  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_retain(lightmap: *mut bk_lightmap) {
    // SAFETY: a handle or NULL.
    unsafe { retain(lightmap) }
}

/// Releases one reference.
///
/// @param lightmap  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_release(lightmap: *mut bk_lightmap) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(lightmap);
        Ok(())
    })
}

/// Numbers about the layout of a light map.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_lightmap_info {
    /// Size of this structure in bytes, set by bk_lightmap_info_init.
    pub struct_size: u32,
    /// Number of pages.
    pub page_count: u32,
    /// Width of each page in texels.
    pub width: u32,
    /// Height of each page in texels.
    pub height: u32,
    /// Number of charts: pieces of surface with continuous light map coordinates.
    pub charts: u32,
    /// Number of charts that have the caller's coordinates.
    pub given_charts: u32,
    /// Number of charts that were made by unwrapping.
    pub unwrapped_charts: u32,
    /// Number of charts whose density was reduced so that they fit a page.
    pub reduced_charts: u32,
    /// Number of charts with separate texels for their backs, see bk_lightmap_desc.both_sides.
    pub both_sided_charts: u32,
    /// Density in use, in texels per scene unit.
    pub texels_per_unit: f32,
    /// Number of texels that a triangle covers: the range of texel_begin and texel_end of
    /// bk_bake_params.
    pub texels: u64,
    /// Number of texels of the gather map.
    pub gather_texels: u64,
    /// Number of texels of the radiance map.
    pub radiance_texels: u64,
    /// Size of the light map in bytes.
    pub bytes: u64,
    /// Number of triangles that were unwrapped because their given coordinates lie outside [0, 1].
    pub uv_out_of_range: u64,
    /// Number of triangles that were unwrapped because they have an area in space and none in their
    /// given coordinates.
    pub uv_degenerate: u64,
    /// Number of texels whose centre is covered by several triangles of given coordinates.
    pub uv_overlapping_texels: u64,
    /// Duration of unwrapping in seconds.
    pub unwrap_seconds: f64,
    /// Number of texels that belong to backs: the last ones of `texels`.
    pub back_texels: u64,
    /// Number of charts that cannot be seen from bk_lightmap_desc.seen_from.
    pub unseen_charts: u64,
    /// Number of texels that they would have had, roughly.
    pub spared_texels: u64,
    /// Number of charts whose texels bk_lightmap_create_from took over, all or some.
    pub kept_charts: u64,
}

sized_struct!(bk_lightmap_info, defaults: info(&Default::default()));

fn info(i: &LightmapInfo) -> bk_lightmap_info {
    bk_lightmap_info {
        struct_size: size_of::<bk_lightmap_info>() as u32,
        page_count: i.page_count,
        width: i.width,
        height: i.height,
        charts: i.charts,
        given_charts: i.uvs.given_charts,
        unwrapped_charts: i.uvs.unwrapped_charts,
        reduced_charts: i.uvs.reduced_charts,
        both_sided_charts: i.both_sided_charts,
        texels_per_unit: i.texels_per_unit,
        texels: i.texels,
        gather_texels: i.gather_texels,
        radiance_texels: i.radiance_texels,
        bytes: i.bytes,
        uv_out_of_range: i.uvs.out_of_range,
        uv_degenerate: i.uvs.degenerate,
        uv_overlapping_texels: i.uvs.overlapping_texels,
        unwrap_seconds: i.unwrap_seconds,
        back_texels: i.back_texels,
        unseen_charts: i.unseen_charts.into(),
        spared_texels: i.spared_texels,
        kept_charts: i.kept_charts.into(),
    }
}

/// Sets `struct_size` and clears the other fields.
///
/// @param info  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_info_init(info: *mut bk_lightmap_info) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(info) }
}

/// Gets numbers about the layout of a light map.
///
/// @param lightmap  any light map
/// @param out  receives the numbers
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_get_info(lightmap: *const bk_lightmap, out: *mut bk_lightmap_info) -> bk_result {
    call(|| {
        let lightmap = object!(lightmap);
        // SAFETY: out is the caller's, or NULL.
        let out = unsafe { OutStruct::new(out, "out") }?;
        out.write(info(&lightmap.read(|l| Ok(l.info()))?));
        Ok(())
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_mesh_uvs(
    lightmap: *const bk_lightmap,
    mesh: u32,
    out_corner_uvs: *mut f32,
    out_page_per_triangle: *mut u32,
) -> bk_result {
    // SAFETY: the arrays are the caller's, or NULL.
    call(|| unsafe {
        let uvs = object!(lightmap).read(|l| l.mesh_uvs(mesh))?;
        copy_uvs(&uvs, out_corner_uvs, out_page_per_triangle)
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_mesh_back_uvs(
    lightmap: *const bk_lightmap,
    mesh: u32,
    out_corner_uvs: *mut f32,
    out_page_per_triangle: *mut u32,
    out_separate_per_triangle: *mut u8,
) -> bk_result {
    // SAFETY: the arrays are the caller's, or NULL.
    call(|| unsafe {
        let backs = object!(lightmap).read(|l| l.mesh_back_uvs(mesh))?;
        copy_back_uvs(&backs, out_corner_uvs, out_page_per_triangle, out_separate_per_triangle)
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_instance_uvs(
    lightmap: *const bk_lightmap,
    instance: u32,
    out_corner_uvs: *mut f32,
    out_page_per_triangle: *mut u32,
) -> bk_result {
    // SAFETY: the arrays are the caller's, or NULL.
    call(|| unsafe {
        let uvs = object!(lightmap).read(|l| l.instance_uvs(instance))?;
        copy_uvs(&uvs, out_corner_uvs, out_page_per_triangle)
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_instance_back_uvs(
    lightmap: *const bk_lightmap,
    instance: u32,
    out_corner_uvs: *mut f32,
    out_page_per_triangle: *mut u32,
    out_separate_per_triangle: *mut u8,
) -> bk_result {
    // SAFETY: the arrays are the caller's, or NULL.
    call(|| unsafe {
        let backs = object!(lightmap).read(|l| l.instance_back_uvs(instance))?;
        copy_back_uvs(&backs, out_corner_uvs, out_page_per_triangle, out_separate_per_triangle)
    })
}

/// Copies what is known of backs where it is wanted.
///
/// # Safety
/// Each array is NULL or valid for writing as many elements.
unsafe fn copy_back_uvs(
    (uvs, own): &(MeshUvs, Vec<bool>),
    out_corner_uvs: *mut f32,
    out_pages: *mut u32,
    out_separate: *mut u8,
) -> Result<()> {
    // SAFETY: by contract.
    unsafe {
        copy_uvs(uvs, out_corner_uvs, out_pages)?;
        if !out_separate.is_null() {
            let out = slice_mut(out_separate, own.len(), "out_separate_per_triangle", &[])?;
            out.iter_mut().zip(own).for_each(|(out, &own)| *out = own.into());
        }
    }
    Ok(())
}

/// Copies corner UVs and pages where they are wanted.
///
/// # Safety
/// Each array is NULL or valid for writing as many elements.
unsafe fn copy_uvs((uvs, pages): &MeshUvs, out_corner_uvs: *mut f32, out_pages: *mut u32) -> Result<()> {
    // SAFETY: by contract.
    unsafe {
        if !out_corner_uvs.is_null() {
            slice_mut(out_corner_uvs.cast(), uvs.len(), "out_corner_uvs", &[])?.copy_from_slice(uvs);
        }
        if !out_pages.is_null() {
            slice_mut(out_pages, pages.len(), "out_page_per_triangle", &[])?.copy_from_slice(pages);
        }
    }
    Ok(())
}
