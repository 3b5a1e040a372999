//! Lights without geometry. (Emissive triangles are lights too; see [`super::Emitter`].)

use super::{NONE, check_energy, check_finite};
use crate::base::error::{Result, invalid_argument};
use glam::Vec3;

/// A light. Directions need not be normalised; they are when the light is added to a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Light {
    /// Radiates equally in all directions.
    Point {
        /// Position in scene units.
        position: Vec3,
        /// Radiant intensity in W/sr.
        intensity: [f32; 3],
    },
    /// Radiates in a cone around `direction`: fully up to `inner`, not at all beyond `outer`, smoothly in between
    /// (Hermite interpolation in the cosine).
    Spot {
        /// Position in scene units.
        position: Vec3,
        /// Axis of the cone.
        direction: Vec3,
        /// Half angle of the cone of full intensity, in radians, at most `outer`.
        inner: f32,
        /// Half angle of the whole cone, in radians, in (0, π].
        outer: f32,
        /// Radiant intensity on the axis in W/sr.
        intensity: [f32; 3],
    },
    /// Light from infinitely far away, parallel or from a disc of uniform radiance (the sun).
    Directional {
        /// Direction in which the light travels.
        direction: Vec3,
        /// Irradiance in W/m² on a plane that faces the middle of the disc, with the whole disc above its horizon.
        irradiance: [f32; 3],
        /// Radius of the disc in radians, in [0, π/2]; less than 1e-5 counts as 0, parallel light. The sun's is
        /// 0.00465.
        angular_radius: f32,
    },
    /// A parallelogram that radiates from the side that `edge_u × edge_v` points to. Rays do not hit it.
    Rect {
        /// A corner, in scene units.
        position: Vec3,
        /// An edge from that corner.
        edge_u: Vec3,
        /// The other edge from that corner.
        edge_v: Vec3,
        /// Radiance in W/(m²·sr).
        radiance: [f32; 3],
    },
    /// Light from all directions, infinitely far away.
    Sky {
        /// Radiance in W/(m²·sr) or, with an environment, the factor of the image.
        radiance: [f32; 3],
        /// Number of the scene's [`Environment`](super::Environment); [`NONE`]: the same radiance from all directions.
        environment: u32,
        /// Direction of the image's zenith. The front of the image, its middle, looks along −z, or along +y if `up` is
        /// less than 45° from the z axis, made perpendicular to `up`.
        up: Vec3,
        /// Angle in radians by which the image is turned about `up`, counter-clockwise as seen from its tip.
        rotation: f32,
    },
}

/// Discs of a smaller radius count as points.
const MIN_ANGULAR_RADIUS: f32 = 1e-5;

impl Light {
    /// Value of the colour field, whatever its unit.
    pub fn color(&self) -> [f32; 3] {
        match *self {
            Light::Point { intensity, .. } | Light::Spot { intensity, .. } => intensity,
            Light::Directional { irradiance, .. } => irradiance,
            Light::Rect { radiance, .. } | Light::Sky { radiance, .. } => radiance,
        }
    }

    /// Falloff of a spot light by the cosine of the angle to its axis, in [0, 1].
    pub fn spot_falloff(cosine: f32, inner: f32, outer: f32) -> f32 {
        let (ci, co) = (inner.cos(), outer.cos());
        if cosine >= ci {
            1.0
        } else if cosine <= co {
            0.0
        } else {
            let x = (cosine - co) / (ci - co);
            x * x * (3.0 - 2.0 * x)
        }
    }

    /// Returns the light with its direction normalised (in f64: extreme lengths do not overflow).
    pub(crate) fn normalized(self) -> Light {
        let unit = |d: Vec3| d.as_dvec3().normalize().as_vec3();
        match self {
            Light::Spot { position, direction, inner, outer, intensity } => {
                Light::Spot { position, direction: unit(direction), inner, outer, intensity }
            }
            Light::Directional { direction, irradiance, angular_radius } => {
                let angular_radius = if angular_radius < MIN_ANGULAR_RADIUS { 0.0 } else { angular_radius };
                Light::Directional { direction: unit(direction), irradiance, angular_radius }
            }
            Light::Sky { radiance, environment, up, rotation } => {
                Light::Sky { radiance, environment, up: unit(up), rotation }
            }
            other => other,
        }
    }

    /// Checks that the environment of a sky, if it has one, exists in the scene.
    pub(crate) fn check_environment(&self, count: usize) -> Result<()> {
        match *self {
            Light::Sky { environment, .. } if environment != NONE && environment as usize >= count => {
                invalid_argument!("environment {environment} does not exist, the scene has {count}")
            }
            _ => Ok(()),
        }
    }

    /// Checks the ranges documented on the variants.
    pub fn validate(&self) -> Result<()> {
        check_energy("the light's color", &self.color())?;
        match *self {
            Light::Point { position, .. } => check_finite("the light's position", &position.to_array()),
            Light::Spot { position, direction, inner, outer, .. } => {
                check_finite("the light's position", &position.to_array())?;
                check_direction(direction)?;
                if !(inner >= 0.0 && inner <= outer && outer <= std::f32::consts::PI) {
                    return invalid_argument!(
                        "the cone angles are inner {inner} and outer {outer}, not 0 ≤ inner ≤ outer ≤ π"
                    );
                }
                if outer == 0.0 {
                    return invalid_argument!("the outer cone angle is 0");
                }
                Ok(())
            }
            Light::Directional { direction, angular_radius, .. } => {
                if !(0.0..=std::f32::consts::FRAC_PI_2).contains(&angular_radius) {
                    return invalid_argument!("the angular radius is {angular_radius}, outside 0 to π/2");
                }
                check_direction(direction)
            }
            Light::Sky { up, rotation, .. } => {
                check_finite("the sky's rotation", &[rotation])?;
                check_finite("the sky's up", &up.to_array())?;
                if up.as_dvec3().length() == 0.0 {
                    return invalid_argument!("the sky's up is zero");
                }
                Ok(())
            }
            Light::Rect { position, edge_u, edge_v, .. } => {
                check_finite("the light's position", &position.to_array())?;
                check_finite("edge_u", &edge_u.to_array())?;
                check_finite("edge_v", &edge_v.to_array())?;
                let area = edge_u.as_dvec3().cross(edge_v.as_dvec3()).length();
                if area == 0.0 {
                    return invalid_argument!("the rect light has no area (edge_u {edge_u}, edge_v {edge_v})");
                }
                Ok(())
            }
        }
    }
}

fn check_direction(d: Vec3) -> Result<()> {
    check_finite("the light's direction", &d.to_array())?;
    if d.as_dvec3().length() == 0.0 {
        return invalid_argument!("the light's direction is zero");
    }
    Ok(())
}
