//! Point, spot and parallel lights, which take one shadow ray.

use super::receiver::Receiver;
use super::shadow_rays::ShadowRays;
use crate::scene::{BRIGHTEST, Light};
use crate::trace::Ray;
use glam::Vec3;

/// Pushes the ray to a light that gets one from every point.
pub(crate) fn push_one(light: &Light, receiver: &Receiver, shadow: &mut ShadowRays) {
    if let Light::Directional { direction, irradiance, .. } = *light {
        let cosine = -direction.dot(receiver.normal);
        let irradiance = Vec3::from(irradiance) * cosine;
        if cosine > 0.0 && receiver.faces(-direction) && irradiance.max_element() > 0.0 {
            shadow.push(Ray::new(receiver.shadow_origin, -direction), irradiance);
        }
    } else if let Some((position, light)) =
        point_light(light, receiver).filter(|&(at, _)| !shadow.near.has(at, receiver))
    {
        shadow.push_point(receiver, position, light);
    }
}

/// Position of a point or spot light, and its unoccluded irradiance; `None` if it cannot shine on the receiver.
pub(crate) fn point_light(light: &Light, receiver: &Receiver) -> Option<(Vec3, Vec3)> {
    let (position, intensity) = match *light {
        Light::Point { position, intensity } => (position, Vec3::from(intensity)),
        Light::Spot { position, direction, inner, outer, intensity } => {
            let way = (receiver.position - position).normalize_or_zero();
            (position, Vec3::from(intensity) * Light::spot_falloff(way.dot(direction), inner, outer))
        }
        _ => return None,
    };
    // The direction is that from the surface itself, not from where rays start: a light may be nearer to it than that.
    let way = position.as_dvec3() - receiver.position.as_dvec3();
    let d2 = way.length_squared();
    let cosine = way.dot(receiver.normal.as_dvec3());
    if cosine <= 0.0 || !receiver.faces(way.as_vec3()) || intensity.max_element() <= 0.0 {
        return None;
    }
    let factor = (cosine / (d2 * d2.sqrt())).min(BRIGHTEST as f64) as f32;
    Some((position, (intensity * factor).min(Vec3::splat(BRIGHTEST))))
}
