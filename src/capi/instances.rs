//! Instances
//!
//! A mesh that stands in the scene many times is added once, with an instance for each place. It then stands where its
//! instances say, and nowhere else. Vertices and acceleration structure exist once; each instance has light of its
//! own, at coordinates of its own in the light map, unless it is to [share](bk_instance_share_light) that of another.
//!
//! A transform is 12 floats: the images of the x, y and z axis, then the translation (a 3 by 4 matrix by columns; the
//! rows of a row-major 4 by 3 matrix that row vectors are multiplied with). It must not mirror: add a mirrored mesh
//! instead.
//!
//! Thread safety: as for meshes.
//!
//! Cost: an instance takes about 200 bytes. Rays through instances of large meshes take between a
//! third of the time through copies and twice as long, through meshes of some 1,000 triangles up to
//! four times as long: see the manual, docs/performance.md.

use super::args::{read_strided, write, write_optional};
use super::error::{bk_result, call, call_or};
use super::handles::object;
use super::scene::bk_scene;
use crate::base::error::{Result, invalid_argument};
use crate::scene::Instance;
use glam::Affine3A;

/// # Safety
/// `transform` is NULL or 12 floats.
unsafe fn read_transform(transform: *const f32) -> Result<Affine3A> {
    // SAFETY: by contract.
    let columns = unsafe { read_strided::<[f32; 12]>(transform, 0, 1, "transform") }?;
    Ok(Affine3A::from_cols_array(&columns[0]))
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_add_instance(
    scene: *mut bk_scene,
    mesh: u32,
    transform: *const f32,
    out_id: *mut u32,
) -> bk_result {
    // SAFETY: transform and out_id are the caller's, or NULL.
    call(|| unsafe {
        let transform = read_transform(transform)?;
        let id = object!(scene)
            .describe("instances can be added", |d| d.data.add_instance(Instance::new(mesh, transform)))?;
        write_optional(out_id, id)
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_instance_share_light(scene: *mut bk_scene, instance: u32, of: u32) -> bk_result {
    call(|| object!(scene).describe("instances can share light", |d| d.data.share_light(instance, of)))
}

/// Gets the instance whose texels and light an instance shows, of a scene that is committed or not:
/// itself, unless bk_instance_share_light or a scene file said otherwise.
///
/// @param scene  any scene
/// @param instance  number of the instance
/// @param out_instance  receives the number
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance, or out_instance is NULL
/// @retval BK_ERROR_INVALID_STATE  the scene is being refitted, or another thread is changing it
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_instance_light_of(
    scene: *const bk_scene,
    instance: u32,
    out_instance: *mut u32,
) -> bk_result {
    // SAFETY: the place is the caller's, or NULL.
    call(|| unsafe {
        let find = |count: usize, shown: &dyn Fn() -> u32| match (instance as usize) < count {
            true => Ok(shown()),
            false => invalid_argument!("instance {instance} does not exist, the scene has {count}"),
        };
        let shown = object!(scene).either(
            |d| find(d.instances().len(), &|| d.light_of_instance(instance)),
            |s| find(s.instances().len(), &|| s.light_of_instance(instance)),
        )?;
        write(out_instance, shown, "out_instance")
    })
}

/// Sets a new transform for an instance of a committed scene. Nothing changes before bk_scene_refit,
/// which applies the last transform that was set for each instance.
///
/// @param scene  committed scene
/// @param instance  number of the instance
/// @param transform  12 floats: where the mesh's axes and origin lie in the scene, in scene units
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance; or the transform is not finite,
///   mirrors or cannot be inverted
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or another thread is changing it
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_instance_set_transform(
    scene: *mut bk_scene,
    instance: u32,
    transform: *const f32,
) -> bk_result {
    // SAFETY: transform is the caller's, or NULL.
    call(|| unsafe { object!(scene).set_transform(instance, read_transform(transform)?) })
}

/// Returns the number of instances of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of instances; 0 on failure
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_instance_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.instances().len(), |s| s.instances().len()))
}

/// Gets the mesh and the transform of an instance, of a scene that is committed or not.
///
/// @param scene  any scene
/// @param instance  number of the instance
/// @param out_mesh  receives the number of its mesh; may be NULL
/// @param out_transform  receives its 12 floats, in scene units; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such instance
/// @retval BK_ERROR_INVALID_STATE  the scene is being refitted, or another thread is changing it
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_get_instance(
    scene: *const bk_scene,
    instance: u32,
    out_mesh: *mut u32,
    out_transform: *mut f32,
) -> bk_result {
    // SAFETY: the places are the caller's, or NULL.
    call(|| unsafe {
        let find = |all: &[Instance]| match all.get(instance as usize) {
            Some(found) => Ok(*found),
            None => invalid_argument!("instance {instance} does not exist, the scene has {}", all.len()),
        };
        let found = object!(scene).either(|d| find(d.instances()), |s| find(s.instances()))?;
        write_optional(out_mesh, found.mesh)?;
        write_optional(out_transform.cast(), found.transform.to_cols_array())
    })
}
