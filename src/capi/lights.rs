//! Lights
//!
//! Lights are added to a scene before its commit and can change at any time. Emissive materials are
//! lights too, without a number.
//!
//! Thread safety: as for scenes; bk_scene_set_light on a committed scene and the functions that
//! read are safe from any thread, but before the commit fail with BK_ERROR_INVALID_STATE while
//! another thread is changing the scene.
//!
//! Cost: less than a microsecond each; bk_scene_set_light copies all lights while a bake is using
//! them.

use super::args::{OutStruct, SizedStruct, init, read_struct, sized_struct, write_optional};
use super::error::{BK_NONE, bk_result, call, call_or};
use super::handles::object;
use super::scene::bk_scene;
use crate::base::error::{Result, invalid_argument};
use crate::scene::Light;
use glam::Vec3;

/// Point light: radiates from `position` equally in all directions. `color` is radiant intensity in
/// W/sr.
pub const BK_LIGHT_POINT: u32 = 1;
/// Spot light: radiates from `position` in a cone around `direction`, fully up to `cone_inner` from
/// the axis, not at all beyond `cone_outer`, smoothly in between. `color` is radiant intensity on
/// the axis in W/sr.
pub const BK_LIGHT_SPOT: u32 = 2;
/// Directional light: travels along `direction` from infinitely far away, parallel or, with an
/// `angular_radius`, from a disc of uniform radiance (the sun). `color` is irradiance in W/m2 on a
/// plane that faces the middle of the disc, with the whole disc above its horizon. A disc takes
/// bk_bake_params.direct_samples shadow rays per point.
pub const BK_LIGHT_DIRECTIONAL: u32 = 3;
/// Rect light: a parallelogram with a corner at `position` and the edges `edge_u` and `edge_v`,
/// which radiates from the side that `edge_u` x `edge_v` points to. `color` is radiance in W/(m2
/// sr). Rays do not hit it.
pub const BK_LIGHT_RECT: u32 = 4;
/// Sky: radiates from all directions, from infinitely far away. `color` is radiance in W/(m2 sr)
/// or, with an `environment`, the factor of the image. It takes 4 times
/// bk_bake_params.direct_samples shadow rays per point. The sky counts as direct light, as all
/// lights do; gather rays that leave the scene contribute nothing.
pub const BK_LIGHT_SKY: u32 = 5;

/// A light. Fields that its type does not use are ignored.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_light_desc {
    /// Size of this structure in bytes, set by bk_light_desc_init.
    pub struct_size: u32,
    /// One of the BK_LIGHT values. Default: BK_LIGHT_POINT.
    pub r#type: u32,
    /// Point, spot, rect: position, or a corner of the rect, in scene units. Default: 0.
    pub position: [f32; 3],
    /// Spot, directional: direction in which the light travels, a vector of any length but 0.
    /// Default: 0, to be set.
    pub direction: [f32; 3],
    /// Rect: an edge, in scene units. Default: 0, to be set.
    pub edge_u: [f32; 3],
    /// Rect: the other edge, in scene units, not parallel to `edge_u`. Default: 0, to be set.
    pub edge_v: [f32; 3],
    /// Linear RGB, finite and >= 0: W/sr, W/m2 or W/(m2 sr), as the BK_LIGHT values say. Default:
    /// 1.
    pub color: [f32; 3],
    /// Spot: half angle of the cone of full intensity, in radians, in [0, `cone_outer`]. Default:
    /// 0.
    pub cone_inner: f32,
    /// Spot: half angle of the whole cone, in radians, in (0, pi]. Default: pi/4.
    pub cone_outer: f32,
    /// Directional: radius of the disc in radians, in [0, pi/2]; less than 1e-5 counts as 0, a
    /// parallel light. The sun's is 0.00465. Default: 0.
    pub angular_radius: f32,
    /// Sky: number of the environment, or BK_NONE for the same radiance from all directions.
    /// Default: BK_NONE.
    pub environment: u32,
    /// Sky: direction of the environment's zenith, a vector of any length but 0. The front of the
    /// image looks along -z, or along +y if `up` is less than 45 degrees from the z axis, made
    /// perpendicular to `up`. Default: (0, 1, 0).
    pub up: [f32; 3],
    /// Sky: angle in radians by which the environment is turned about `up`, counter-clockwise as
    /// seen from its tip. Default: 0.
    pub rotation: f32,
}

sized_struct!(bk_light_desc, defaults: bk_light_desc {
    struct_size: size_of::<bk_light_desc>() as u32,
    r#type: BK_LIGHT_POINT,
    position: [0.0; 3],
    direction: [0.0; 3],
    edge_u: [0.0; 3],
    edge_v: [0.0; 3],
    color: [1.0; 3],
    cone_inner: 0.0,
    cone_outer: std::f32::consts::FRAC_PI_4,
    angular_radius: 0.0,
    environment: BK_NONE,
    up: [0.0, 1.0, 0.0],
    rotation: 0.0,
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_light_desc_init(desc: *mut bk_light_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Adds a light.
///
/// @param scene  scene that is not committed
/// @param desc  copied
/// @param out_id  receives the number of the light; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `desc` is out of its range or names no environment
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_add_light(
    scene: *mut bk_scene,
    desc: *const bk_light_desc,
    out_id: *mut u32,
) -> bk_result {
    // SAFETY: desc and out_id are the caller's, or NULL.
    call(|| unsafe {
        let scene = object!(scene);
        let light = light(&read_struct(desc, "desc")?)?;
        let id = scene.describe("lights can be added", |d| d.data.add_light(light))?;
        write_optional(out_id, id)
    })
}

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
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_set_light(scene: *mut bk_scene, id: u32, desc: *const bk_light_desc) -> bk_result {
    call(|| {
        let scene = object!(scene);
        // SAFETY: desc is the caller's, or NULL.
        let light = light(&unsafe { read_struct(desc, "desc") }?)?;
        if scene.is_committed() {
            return scene.committed()?.set_light(id, light);
        }
        scene.describe("the description can change", |d| d.data.set_light(id, light))
    })
}

fn light(d: &bk_light_desc) -> Result<Light> {
    let position = Vec3::from_array(d.position);
    let direction = Vec3::from_array(d.direction);
    match d.r#type {
        BK_LIGHT_POINT => Ok(Light::Point { position, intensity: d.color }),
        BK_LIGHT_SPOT => {
            Ok(Light::Spot { position, direction, inner: d.cone_inner, outer: d.cone_outer, intensity: d.color })
        }
        BK_LIGHT_DIRECTIONAL => {
            Ok(Light::Directional { direction, irradiance: d.color, angular_radius: d.angular_radius })
        }
        BK_LIGHT_RECT => Ok(Light::Rect {
            position,
            edge_u: Vec3::from_array(d.edge_u),
            edge_v: Vec3::from_array(d.edge_v),
            radiance: d.color,
        }),
        BK_LIGHT_SKY => Ok(Light::Sky {
            radiance: d.color,
            environment: d.environment,
            up: Vec3::from_array(d.up),
            rotation: d.rotation,
        }),
        other => invalid_argument!("type is {other}, not one of the BK_LIGHT values"),
    }
}

/// Gets a light of a scene, committed or not.
///
/// @param scene  any scene
/// @param id  number of the light
/// @param out  receives a copy of the light: its directions have length 1, fields that its type
///   does not use their defaults
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such light
/// @retval BK_ERROR_INVALID_STATE  the scene is being refitted, or is not committed and another
///   thread is changing it
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_get_light(scene: *const bk_scene, id: u32, out: *mut bk_light_desc) -> bk_result {
    call(|| {
        let scene = object!(scene);
        // SAFETY: out is the caller's, or NULL.
        let out = unsafe { OutStruct::new(out, "out") }?;
        out.write(light_desc(&scene.either(|d| find(d.lights(), id), |s| find(&s.lights(), id))?));
        Ok(())
    })
}

fn find(lights: &[Light], id: u32) -> Result<Light> {
    match lights.get(id as usize) {
        Some(light) => Ok(*light),
        None => invalid_argument!("light {id} does not exist, the scene has {}", lights.len()),
    }
}

fn light_desc(light: &Light) -> bk_light_desc {
    let d = bk_light_desc { color: light.color(), ..SizedStruct::defaults() };
    match *light {
        Light::Point { position, .. } => bk_light_desc { r#type: BK_LIGHT_POINT, position: position.to_array(), ..d },
        Light::Spot { position, direction, inner, outer, .. } => bk_light_desc {
            r#type: BK_LIGHT_SPOT,
            position: position.to_array(),
            direction: direction.to_array(),
            cone_inner: inner,
            cone_outer: outer,
            ..d
        },
        Light::Directional { direction, angular_radius, .. } => {
            bk_light_desc { r#type: BK_LIGHT_DIRECTIONAL, direction: direction.to_array(), angular_radius, ..d }
        }
        Light::Rect { position, edge_u, edge_v, .. } => bk_light_desc {
            r#type: BK_LIGHT_RECT,
            position: position.to_array(),
            edge_u: edge_u.to_array(),
            edge_v: edge_v.to_array(),
            ..d
        },
        Light::Sky { environment, up, rotation, .. } => {
            bk_light_desc { r#type: BK_LIGHT_SKY, environment, up: up.to_array(), rotation, ..d }
        }
    }
}

/// Returns the number of lights of a scene, committed or not; emissive materials are not counted.
///
/// @param scene  any scene
/// @return  number of lights; 0 on failure
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_light_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.lights().len(), |s| s.lights().len()))
}
