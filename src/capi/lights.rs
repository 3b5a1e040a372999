//! Lights
//!
//! Added to a scene before its commit, changed at any time. Emissive materials make lights too.

use super::args::{OutStruct, SizedStruct, init, read_struct, sized_struct, write_optional};
use super::error::{BK_NONE, bk_result, call, call_or};
use super::handles::object;
use super::scene::bk_scene;
use crate::error::{Result, invalid_argument};
use crate::scene::Light;
use glam::Vec3;

/// Radiates from a position equally in all directions. color: radiant intensity in W/sr.
pub const BK_LIGHT_POINT: u32 = 1;
/// Radiates from a position in a cone around direction: fully up to cone_inner radians from it, not
/// at all beyond cone_outer, smoothly in between. color: radiant intensity on the axis in W/sr.
pub const BK_LIGHT_SPOT: u32 = 2;
/// Light from infinitely far away that travels along direction: parallel or, with an angular_radius,
/// from a disc of uniform radiance (the sun). color: irradiance on a plane that faces the middle of the
/// disc, with all of it above its horizon, in W/m2. A disc takes direct_samples shadow rays per point.
pub const BK_LIGHT_DIRECTIONAL: u32 = 3;
/// A parallelogram with a corner at position and the edges edge_u and edge_v, which radiates from
/// the side that edge_u x edge_v points to. color: radiance in W/(m2 sr). Rays do not hit it.
pub const BK_LIGHT_RECT: u32 = 4;
/// Light from all directions, infinitely far away: color is its radiance in W/(m2 sr) or, with an
/// environment, the factor of the image. Takes 4 direct_samples shadow rays per point. Gather rays that
/// leave the scene bring nothing: the sky is part of the direct light, as all lights are.
pub const BK_LIGHT_SKY: u32 = 5;

/// A light. Fields that its type does not use are ignored.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_light_desc {
    /// Size of this structure in bytes, set by bk_light_desc_init.
    pub struct_size: u32,
    /// One of the BK_LIGHT values. Default: BK_LIGHT_POINT.
    pub r#type: u32,
    /// Point, spot, and a corner of rect. Default: 0.
    pub position: [f32; 3],
    /// Spot and directional: where the light travels, of any length but 0. Default: 0, to be set.
    pub direction: [f32; 3],
    /// Rect: an edge. Default: 0, to be set.
    pub edge_u: [f32; 3],
    /// Rect: the other edge, not parallel to edge_u. Default: 0, to be set.
    pub edge_v: [f32; 3],
    /// Linear RGB, >= 0, in the unit of the type. Default: 1.
    pub color: [f32; 3],
    /// Spot: half angle of the cone of full intensity, in radians, in [0, cone_outer]. Default: 0.
    pub cone_inner: f32,
    /// Spot: half angle of the whole cone, in radians, in (0, pi]. Default: pi/4.
    pub cone_outer: f32,
    /// Directional: radius of the disc in radians, in [0, pi/2]; less than 1e-5: parallel. The sun's is
    /// 0.00465. Default: 0.
    pub angular_radius: f32,
    /// Sky: number of its image, see bk_scene_add_environment; BK_NONE: none, the same radiance from all
    /// directions. Default: BK_NONE.
    pub environment: u32,
    /// Sky: where the zenith of the image is, of any length but 0. The front of the image then looks along
    /// -z, or along +y if up is less than 45 degrees from the z axis, made perpendicular to up. Default:
    /// (0, 1, 0).
    pub up: [f32; 3],
    /// Sky: turns the image about up, counter-clockwise as seen from its tip, in radians. Default: 0.
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

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_light_desc_init(desc: *mut bk_light_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Adds a light.
///
/// out_id: receives its number; NULL if not wanted. Numbers count up from 0 in the order of
/// addition.
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

/// Replaces light `id`, before or after the commit; its type may change. A light is taken away by
/// giving it no colour. What is being baked keeps the lights that it started with; a live object is
/// told by bk_live_light_changed.
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

/// Fetches a light, committed or not.
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

/// The number of lights (emissive materials not counted), committed or not; 0 on failure.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_light_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.lights().len(), |s| s.lights().len()))
}
