//! The fingerprint of a bake: everything that baked light depends on. Files with another fingerprint are refused, with
//! a sentence that names the differences.

use crate::lightmap::BakeParams;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::Map;
use crate::scene::{Light, MeshMaterials, Scene};
use bytemuck::{Pod, Zeroable};
use std::fmt::Debug;

/// Parameters and lights of a bake. Light depends on these and on scene and layout, which never change in a light map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::lightmap) struct Origin {
    pub params: BakeParams,
    /// Checksum of the lights.
    lights: u32,
}

impl Origin {
    /// Makes the origin of a bake under the present `lights`, whatever texels it bakes.
    pub fn new(params: &BakeParams, lights: &[Light]) -> Origin {
        Origin { params: Self::compared(params), lights: text_sum(lights) }
    }

    /// Returns parameters without those that change no bit of a texel.
    fn compared(params: &BakeParams) -> BakeParams {
        BakeParams { texel_begin: 0, texel_end: 0, memory_budget: 0, ..*params }
    }

    /// Whether the bake had these parameters.
    pub fn has_params(&self, params: &BakeParams) -> bool {
        self.params == Self::compared(params)
    }

    /// Whether another bake had the same lights.
    pub fn has_lights_of(&self, other: &Origin) -> bool {
        self.lights == other.lights
    }
}

/// Fingerprint of a whole bake. Part of the file format.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Fingerprint {
    version: [u8; 16],
    /// Whether the ISA fuses multiplications and additions: all ISAs that do give the same bits, portable kernels give
    /// others.
    is_fused: u32,
    /// Checksum of the geometry, followed by those of materials, lights and layout.
    geometry: u32,
    materials: u32,
    lights: u32,
    layout: u32,
    near_hits: f32,
    photon_count: u64,
    seed: u64,
    /// First texel of the bake of a checkpoint; 0 in results, which may hold any texels.
    texel_begin: u64,
    texel_end: u64,
    max_bounces: u32,
    gather_rays: u32,
    radius: f32,
    blur_radius: u16,
    own_rays: u16,
    direct_samples: u32,
    stitch: u16,
    directional: u16,
    passes: u32,
    target_error: f32,
    interpolation_error: f32,
    interpolation_contrast: f32,
}

/// Returns the library's version, as in files.
pub(super) fn version() -> [u8; 16] {
    let mut version = [0; 16];
    let text = env!("CARGO_PKG_VERSION").as_bytes();
    let length = text.len().min(version.len());
    version[..length].copy_from_slice(&text[..length]);
    version
}

/// Adds a line to `all` if a parameter of a file differs from the one that is needed.
pub(super) fn compare<T: PartialEq + Debug>(all: &mut Vec<String>, name: &str, file: T, needed: T) {
    if file != needed {
        all.push(format!("{name} ({file:?}, here {needed:?})"));
    }
}

impl Fingerprint {
    /// Makes the fingerprint of the bake of a range of texels ((0, 0): any).
    pub fn new(atlas: &Atlas, origin: &Origin, [texel_begin, texel_end]: [u64; 2]) -> Fingerprint {
        // All fields are named, since parameters that are added must be compared here, too.
        let BakeParams {
            photon_count,
            max_bounces,
            gather_rays,
            radius,
            near_hits,
            interpolation_error,
            interpolation_contrast,
            own_rays,
            blur_radius,
            direct_samples,
            seed,
            memory_budget: _,
            texel_begin: _,
            texel_end: _,
            stitch,
            directional,
            passes,
            target_error,
        } = origin.params;
        Fingerprint {
            version: version(),
            is_fused: atlas.scene.device().isa().is_fused().into(),
            geometry: geometry(&atlas.scene),
            materials: materials(&atlas.scene),
            lights: origin.lights,
            layout: layout(atlas),
            photon_count,
            seed,
            texel_begin,
            texel_end,
            max_bounces,
            gather_rays,
            radius,
            near_hits,
            // Checked parameters are far smaller.
            blur_radius: blur_radius as u16,
            own_rays: own_rays as u16,
            direct_samples,
            stitch: stitch.into(),
            // All bits of it are named in `lightmap::directional`, and checked.
            directional: directional as u16,
            passes,
            target_error,
            interpolation_error,
            interpolation_contrast,
        }
    }

    /// Returns the parameters of the bake.
    pub fn params(&self) -> BakeParams {
        BakeParams {
            photon_count: self.photon_count,
            max_bounces: self.max_bounces,
            gather_rays: self.gather_rays,
            radius: self.radius,
            near_hits: self.near_hits,
            interpolation_error: self.interpolation_error,
            interpolation_contrast: self.interpolation_contrast,
            own_rays: self.own_rays.into(),
            blur_radius: self.blur_radius.into(),
            direct_samples: self.direct_samples,
            seed: self.seed,
            memory_budget: 0,
            texel_begin: 0,
            texel_end: 0,
            stitch: self.stitch != 0,
            directional: self.directional.into(),
            passes: self.passes,
            target_error: self.target_error,
        }
    }

    /// Returns parameters and lights of the bake.
    pub fn origin(&self) -> Origin {
        Origin { params: self.params(), lights: self.lights }
    }

    /// Names the differences between this fingerprint, from a file, and the one that is needed; `None` if there are
    /// none.
    pub fn difference(&self, needed: &Fingerprint) -> Option<String> {
        let mut all = Vec::new();
        let version = |f: &Fingerprint| String::from_utf8_lossy(&f.version).trim_end_matches('\0').to_owned();
        if self.version != needed.version {
            all.push(format!("the library's version ({}, here {})", version(self), version(needed)));
        }
        if self.is_fused != needed.is_fused {
            let isa = |f: &Fingerprint| if f.is_fused != 0 { "AVX2 or AVX-512" } else { "portable" };
            all.push(format!("the instruction set ({}, here {})", isa(self), isa(needed)));
        }
        let sums = [
            ("the scene's geometry", self.geometry, needed.geometry),
            ("the scene's materials", self.materials, needed.materials),
            ("the lights", self.lights, needed.lights),
            ("the light map's layout", self.layout, needed.layout),
        ];
        all.extend(sums.iter().filter(|s| s.1 != s.2).map(|s| s.0.to_owned()));
        compare(&mut all, "photon_count", self.photon_count, needed.photon_count);
        compare(&mut all, "max_bounces", self.max_bounces, needed.max_bounces);
        compare(&mut all, "gather_rays", self.gather_rays, needed.gather_rays);
        compare(&mut all, "radius", self.radius, needed.radius);
        compare(&mut all, "near_hits", self.near_hits, needed.near_hits);
        compare(&mut all, "interpolation_error", self.interpolation_error, needed.interpolation_error);
        let [file, here] = [self, needed].map(|f| f.interpolation_contrast);
        compare(&mut all, "interpolation_contrast", file, here);
        compare(&mut all, "own_rays", self.own_rays, needed.own_rays);
        compare(&mut all, "blur_radius", self.blur_radius, needed.blur_radius);
        compare(&mut all, "direct_samples", self.direct_samples, needed.direct_samples);
        compare(&mut all, "seed", self.seed, needed.seed);
        compare(&mut all, "stitch", self.stitch, needed.stitch);
        compare(&mut all, "directional", self.directional, needed.directional);
        compare(&mut all, "passes", self.passes, needed.passes);
        compare(&mut all, "target_error", self.target_error, needed.target_error);
        compare(&mut all, "texel_begin", self.texel_begin, needed.texel_begin);
        compare(&mut all, "texel_end", self.texel_end, needed.texel_end);
        (!all.is_empty()).then(|| all.join(", "))
    }
}

/// Computes the checksum of values that are few enough to be written as text.
fn text_sum(values: &(impl Debug + ?Sized)) -> u32 {
    crc32fast::hash(format!("{values:?}").as_bytes())
}

/// Computes the checksum of all meshes but for their light map UVs.
pub(crate) fn geometry(scene: &Scene) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    for mesh in scene.meshes() {
        sum.update(bytemuck::cast_slice(&mesh.positions));
        sum.update(bytemuck::cast_slice(&mesh.indices));
        sum.update(bytemuck::cast_slice(&mesh.normals));
        sum.update(bytemuck::cast_slice(&mesh.uvs));
        match &mesh.materials {
            MeshMaterials::One(material) => sum.update(bytemuck::bytes_of(material)),
            MeshMaterials::PerTriangle(materials) => sum.update(bytemuck::cast_slice(materials)),
        }
    }
    for instance in scene.instances() {
        sum.update(&instance.mesh.to_ne_bytes());
        sum.update(bytemuck::cast_slice(&instance.transform.to_cols_array()));
        if let Some(of) = instance.light_of {
            sum.update(&of.to_ne_bytes());
        }
    }
    sum.finalize()
}

/// Computes the checksum of materials, textures and the images of skies.
pub(super) fn materials(scene: &Scene) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    sum.update(&text_sum(scene.materials()).to_ne_bytes());
    for texture in scene.textures() {
        sum.update(bytemuck::cast_slice(&[texture.width, texture.height]));
        sum.update(bytemuck::cast_slice(&texture.rgba8));
    }
    for environment in scene.environments() {
        let (width, height) = environment.size();
        sum.update(bytemuck::cast_slice(&[width, height]));
        sum.update(bytemuck::cast_slice(environment.rgb()));
    }
    sum.finalize()
}

fn layout(atlas: &Atlas) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    sum.update(&atlas.padding.to_ne_bytes());
    for (sheet, _) in atlas.charts.sheets() {
        sum.update(bytemuck::cast_slice(&sheet.of_triangles));
        sum.update(bytemuck::cast_slice(&sheet.corners));
    }
    for place in &atlas.charts.places {
        sum.update(bytemuck::cast_slice(&[place.sheet, place.factor.to_bits()]));
    }
    of_map(&atlas.map, &mut sum);
    of_map(&atlas.gather, &mut sum);
    of_map(&atlas.radiance, &mut sum);
    sum.finalize()
}

fn of_map<M: Map>(map: &ChartMap<M>, sum: &mut crc32fast::Hasher) {
    let layout = &map.layout;
    sum.update(bytemuck::cast_slice(&[layout.page_size, layout.page_count, layout.given]));
    sum.update(bytemuck::cast_slice(&layout.back_of));
    for p in &layout.placements {
        sum.update(bytemuck::cast_slice(&[p.page, p.swap.into()]));
        sum.update(bytemuck::cast_slice(&[p.x, p.y, p.w, p.h]));
        sum.update(bytemuck::cast_slice(&[p.scale, p.offset]));
    }
    sum.update(bytemuck::cast_slice(&map.texels.samples));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_named_with_both_values() {
        let mut file = Fingerprint { seed: 7, lights: 1, ..Zeroable::zeroed() };
        let mut here = file;
        assert_eq!(file.difference(&here), None);
        (file.seed, here.lights) = (8, 2);
        assert_eq!(file.difference(&here).unwrap(), "the lights, seed (8, here 7)");
        file.version[..5].copy_from_slice(b"0.0.9");
        here.version[..5].copy_from_slice(b"0.1.0");
        assert!(file.difference(&here).unwrap().contains("version (0.0.9, here 0.1.0)"));
    }
}
