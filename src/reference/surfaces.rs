//! How surfaces reflect and pass light: textures, cut-outs and sheets, in f64. The look-ups share nothing with the
//! library's.

use super::geometry::{Geometry, Hit64, Ray64};
use super::proposal::rgb;
use crate::scene::{MAX_ALBEDO, Material, Mesh, NONE, Texture};
use glam::{DVec2, DVec3};
use std::sync::Arc;

/// Hits at distances that differ by less than this part are one if both lie on an edge of a triangle.
const SAME: f64 = 1e-9;

/// Materials by triangle, and where their textures lie.
pub(super) struct Surfaces {
    materials: Vec<Material>,
    textures: Vec<Arc<Texture>>,
    /// Material by global triangle number.
    material_of: Vec<u32>,
    /// Texture coordinates of the corners, likewise; NaN where there are none.
    coordinates: Vec<[DVec2; 3]>,
}

impl Surfaces {
    pub fn new(meshes: &[Mesh], materials: &[Material], textures: &[Arc<Texture>]) -> Self {
        let all = || meshes.iter().flat_map(|m| (0..m.indices.len()).map(move |t| (m, t)));
        let corner = |m: &Mesh, v: u32| m.uvs.get(v as usize).map_or(DVec2::NAN, |uv| uv.as_dvec2());
        Surfaces {
            materials: materials.to_vec(),
            textures: textures.to_vec(),
            material_of: all().map(|(m, t)| m.material(t)).collect(),
            coordinates: all().map(|(m, t)| m.indices[t].map(|v| corner(m, v))).collect(),
        }
    }

    pub fn material(&self, triangle: u32) -> &Material {
        &self.materials[self.material_of[triangle as usize] as usize]
    }

    /// Red, green, blue (linear) and alpha of the material's texture at a hit.
    fn texel(&self, hit: &Hit64) -> Option<[f64; 4]> {
        let id = self.material(hit.triangle).albedo_texture;
        if id == NONE {
            return None;
        }
        let texture = &self.textures[id as usize];
        let [a, b, c] = self.coordinates[hit.triangle as usize];
        let uv = a * (1.0 - hit.u - hit.v) + b * hit.u + c * hit.v;
        if uv.is_nan() {
            return None;
        }
        let (w, h) = (texture.width as i64, texture.height as i64);
        let place = uv * DVec2::new(w as f64, h as f64) - 0.5;
        let low = place.floor();
        let mut sum = [0.0; 4];
        // Each of the four texels by the area of the opposite rectangle.
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let column = (low.x as i64 + dx).rem_euclid(w);
            let row = (low.y as i64 + dy).rem_euclid(h);
            let share = 1.0 - (place - low - DVec2::new(dx as f64, dy as f64)).abs();
            let texel = texture.rgba8[(row * w + column) as usize];
            for c in 0..4 {
                let value = texel[c] as f64 / 255.0;
                let linear = match c {
                    3 => value,
                    _ if value <= 0.04045 => value / 12.92,
                    _ => ((value + 0.055) / 1.055).powf(2.4),
                };
                sum[c] += share.x * share.y * linear;
            }
        }
        Some(sum)
    }

    pub fn albedo(&self, hit: &Hit64) -> DVec3 {
        let material = self.material(hit.triangle);
        let factor = rgb(material.albedo);
        if material.albedo_texture == NONE {
            return factor;
        }
        let color = self.texel(hit).map_or(DVec3::ONE, |[r, g, b, _]| DVec3::new(r, g, b));
        (factor * color).min(DVec3::splat(MAX_ALBEDO as f64))
    }

    /// Whether there is a surface at a hit.
    fn is_there(&self, hit: &Hit64) -> bool {
        let cutoff = self.material(hit.triangle).alpha_cutoff as f64;
        cutoff == 0.0 || self.texel(hit).is_none_or(|t| t[3] >= cutoff)
    }

    /// The closest hit that is not a hole.
    pub fn closest(&self, geometry: &Geometry, ray: &Ray64) -> Option<Hit64> {
        geometry.closest_of(ray, |hit| self.is_there(hit))
    }

    /// The part of the light that gets along a ray.
    pub fn transmittance(&self, geometry: &Geometry, ray: &Ray64) -> DVec3 {
        let mut met: Vec<Hit64> = Vec::new();
        let opaque = geometry.closest_of(ray, |hit| {
            if !self.is_there(hit) {
                return false;
            }
            let transmits = rgb(self.material(hit.triangle).transmission) != DVec3::ZERO;
            if transmits {
                met.push(*hit);
            }
            !transmits
        });
        if opaque.is_some() {
            return DVec3::ZERO;
        }
        let on_edge = |h: &Hit64| h.u.min(h.v).min(1.0 - h.u - h.v) < SAME;
        let mut part = DVec3::ONE;
        for (i, hit) in met.iter().enumerate() {
            let again = |other: &Hit64| {
                on_edge(other)
                    && (other.t - hit.t).abs() <= SAME * hit.t.abs()
                    && self.material_of[other.triangle as usize] == self.material_of[hit.triangle as usize]
            };
            if !(on_edge(hit) && met[..i].iter().any(again)) {
                part *= rgb(self.material(hit.triangle).transmission);
            }
        }
        part
    }
}
