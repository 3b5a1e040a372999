//! Albedo of texels: that of a texel's point or, if a texture varies, the average of look-ups spread over the part of its
//! triangle in the texel. (A mip chain would be kept for this alone, and the look-ups take less time than a texel's shadow
//! rays.)

use crate::base::sampling::sobol_2d;
use crate::lightmap::atlas::ids::{Map, TexelId};
use crate::lightmap::texel_light::TexelAreas;
use crate::scene::NONE;
use glam::{Mat2, Vec2, Vec3};

/// Maximum number of look-ups of a texture in one texel.
const MAX_LOOKUPS: u32 = 256;

/// Returns the albedo of a texel of a map.
pub(crate) fn albedo<M: Map>(areas: &TexelAreas<M>, texel: TexelId<M>) -> Vec3 {
    let TexelAreas { scene, charts, map, .. } = *areas;
    let sample = &map[texel];
    let point = || scene.albedo(sample.triangle, sample.u, sample.v);
    let material = scene.material(sample.triangle);
    if !scene.uses().textures || material.albedo_texture == NONE {
        return Vec3::from(material.albedo);
    }
    let (object, triangle) = scene.locate(sample.triangle);
    let mesh = scene.object(object).mesh();
    let uv = |w: Vec2| mesh.texture_coordinates(triangle as usize, w.x, w.y).unwrap_or_default();
    // Weights of corners 1 and 2 as a function of texel coordinates in the map.
    let placement = map.placement_of(charts, texel);
    let place = |u, v| Vec2::from(map.layout.texel_coord(placement, charts.local(sample.triangle, u, v)));
    let origin = place(0.0, 0.0);
    let weights = Mat2::from_cols(place(1.0, 0.0) - origin, place(0.0, 1.0) - origin).inverse();
    let Some(texture) = scene.textures().get(material.albedo_texture as usize) else { return point() };
    let (x, y) = map.position(texel);
    let corner = weights * (Vec2::new(x as f32, y as f32) - origin);
    let size = |edge: Vec2| ((uv(edge) - uv(Vec2::ZERO)) * texture.size()).length();
    let texels = size(weights.x_axis).max(1.0) * size(weights.y_axis).max(1.0);
    if mesh.uvs.is_empty() || !texels.is_finite() {
        return point();
    }
    let count = (4.0 * texels).min(MAX_LOOKUPS as f32) as u32;
    let (mut sum, mut seen) = (Vec3::ZERO, 0);
    let seed = map.seed_in(placement, texel);
    for i in 0..count {
        let w = corner + weights * Vec2::from(sobol_2d(i, seed));
        if w.min_element() >= 0.0 && w.x + w.y <= 1.0 && !scene.is_hole(sample.triangle, w.x, w.y) {
            sum += scene.albedo_at(material, || Some(uv(w)));
            seen += 1;
        }
    }
    if seen > 0 { sum / seen as f32 } else { point() }
}
