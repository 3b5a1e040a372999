//! Light maps (thesis 3.2.3 to 3.2.6): charts and texels of a scene, and the bake that fills them.
//!
//! A light map has three maps of independent resolution over the same charts: the light map itself,
//! the gather map (indirect irradiance) and the radiance map (what gather rays see). A bake runs
//! photons → radiance map → gather map → blur → upsampling, direct light and composition → stitching of seams.

pub mod atlas;
pub(crate) mod bake;
pub(crate) mod changed;
mod create;
pub(crate) mod direct_blur;
mod follow;
pub mod indirect;
pub(crate) mod moved;
pub mod normal_maps;
pub(crate) mod passes;
pub mod plan;
pub mod quality;
mod readback;
pub(crate) mod saved;
mod seams;
pub(crate) mod stages;
mod surfaces;
pub(crate) mod texel_light;
pub(crate) mod tiles;
mod write;

use crate::base::directional::Directional;
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::Reservation;
use crate::photon::MAX_PHOTONS;
use crate::scene::Scene;
use atlas::Atlas;
use atlas::charts::MAX_PAGE_SIZE;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use indirect::blur;
use indirect::radiance_map::Radiance;
use indirect::sample_set::ROUND;
use plan::Plan;
pub use readback::MeshUvs;
pub use saved::CheckpointParams;
use saved::fingerprint::Origin;
pub use saved::share::{ShareParams, ShareStage};
use std::sync::Arc;

/// A box from which the scene is looked at; a point if its corners are the same.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Region {
    /// Least coordinates, in scene units.
    pub lower: Vec3,
    /// Greatest coordinates.
    pub upper: Vec3,
}

/// Parameters of a light map's layout.
#[derive(Clone, Debug, PartialEq)]
pub struct LightmapDesc {
    /// Density of unwrapped charts in texels per scene unit; 0: chosen so that the scene fills about one page.
    pub texels_per_unit: f32,
    /// Width and height of a page in texels, 16 to 16384.
    pub page_size: u32,
    /// Distance around each chart that filtering may read, in texels, ≥ 1.
    pub padding: u32,
    /// Light map texels per gather map texel, along each axis.
    pub gather_divisor: u32,
    /// Light map texels per radiance map texel, along each axis.
    pub radiance_divisor: u32,
    /// Whether two-sided charts that can be seen from open places on both sides get separate texels for their backs
    /// ([`Lightmap::mesh_back_uvs`]). Open places are points with free space around them; those outside of buildings
    /// count if a directional light or a sky shines when the light map is created. Without separate texels, a chart
    /// shows the side that can be seen, or the one that the bake chooses.
    pub both_sides: bool,
    /// From where the scene is looked at: charts that cannot be seen from there have a single texel each, and sides that
    /// cannot have none. They still reflect light. Charts with the caller's own UVs keep their texels. Empty: from
    /// anywhere.
    pub seen_from: Vec<Region>,
}

/// Maximum number of regions in [`LightmapDesc::seen_from`].
pub const MAX_REGIONS: usize = 4096;

impl Default for LightmapDesc {
    fn default() -> Self {
        LightmapDesc {
            texels_per_unit: 0.0,
            page_size: 1024,
            padding: 2,
            gather_divisor: 4,
            radiance_divisor: 4,
            both_sides: true,
            seen_from: Vec::new(),
        }
    }
}

/// Numbers about a light map's layout.
#[derive(Clone, Copy, Debug, Default)]
pub struct LightmapInfo {
    /// Number of pages.
    pub page_count: u32,
    /// Width of a page in texels.
    pub width: u32,
    /// Height of a page in texels.
    pub height: u32,
    /// Number of charts, pieces of surface with continuous coordinates.
    pub charts: u32,
    /// Number of texels that a triangle covers.
    pub texels: u64,
    /// Number of texels of the gather map.
    pub gather_texels: u64,
    /// Number of texels of the radiance map.
    pub radiance_texels: u64,
    /// Size of the light map in bytes.
    pub bytes: u64,
    /// Duration of unwrapping in seconds.
    pub unwrap_seconds: f64,
    /// Density in use, in texels per scene unit.
    pub texels_per_unit: f32,
    /// Numbers about the caller's coordinates.
    pub uvs: atlas::charts::UvReport,
    /// Number of charts with separate texels for their backs.
    pub both_sided_charts: u32,
    /// Number of separate texels for backs, included in `texels`.
    pub back_texels: u64,
    /// Number of texels that nobody can see (inside solids, below or behind other surfaces), or that lie on narrow ledges behind
    /// walls, included in `texels`. They show the light of the nearest texels that can be seen.
    pub buried_texels: u64,
    /// Number of open places from which rays were traced to find the sides that can be seen. 0 if no material is
    /// two-sided.
    pub open_places: u64,
    /// Number of rays traced from open places, from where the scene is looked at, and to find buried texels.
    pub sight_rays: u64,
    /// Number of charts that cannot be seen from [`LightmapDesc::seen_from`].
    pub unseen_charts: u32,
    /// Number of texels that they would have had, roughly.
    pub spared_texels: u64,
    /// Number of charts of which texels, all or some, were taken over from an earlier light map: see
    /// [`Lightmap::create_from`].
    pub kept_charts: u32,
}

/// Parameters of a bake.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BakeParams {
    /// Number of photons to emit, at most [`MAX_PHOTONS`]; 0: no light that is reflected more than once.
    pub photon_count: u64,
    /// Maximum number of reflections of light before it reaches a texel; 0: Russian roulette alone decides.
    pub max_bounces: u32,
    /// Number of rays per gather map texel; 0: no indirect light. Each 64 rays are accompanied by up to 32 shadow rays
    /// to bright patches of surfaces, where there are any. Light map texels for which none of the gather texels around
    /// is a valid source of interpolation (1 to 3 %), and those beyond `interpolation_error` or `interpolation_contrast`,
    /// trace rays themselves.
    pub gather_rays: u32,
    /// Search radius of photons in scene units, finite; 0: from the photons' density, and at least three quarters of a
    /// texel of the radiance map, so that no photon lies between the discs of the estimates.
    pub radius: f32,
    /// Distance, in texels of the radiance map, up to which the light reflected where a gather ray hits is computed by a
    /// short path instead of looked up: 0 (never) to infinity (always: path tracing, whose error has no floor but that of
    /// the gather map's texels, and for which `photon_count` may be 0). Through transmissive sheets radiance is looked up.
    pub near_hits: f32,
    /// Estimated error of interpolation between gather texels above which texels of the light map trace rays themselves
    /// (`own_rays`): > 0, infinity: never but where there is nothing to interpolate. It is
    /// the width of a gather texel divided by the harmonic mean distance of what it sees, plus 4 √(1 − cos) of the angle
    /// between normals: the split-sphere model (Ward, Rubinstein and Clear 1988), with weights of its own. Outside of gaps
    /// narrower than a gather texel, 3 times the distance, in widths of a gather texel, between the texel and the mean
    /// position of the gather texels that nothing hides from it is added: these may all be on one side. Light that is
    /// gathered because of this distance alone counts only as far as it differs from the interpolated one by more than
    /// noise, unless `interpolation_contrast` is infinite.
    pub interpolation_error: f32,
    /// RMS contrast of the gather texels between which a texel of the light map interpolates, beyond what is noise, above
    /// which it traces rays itself (`own_rays`): > 0, infinity: never. The light that it gathers counts only as far as it
    /// differs from the interpolated one by more than noise. The contrast is the standard deviation of the gather texels'
    /// light, weighted as interpolation weighs it, divided by the mean. Where the gather map has the light map's density there
    /// is nothing to compare.
    pub interpolation_contrast: f32,
    /// Number of rays of texels of the light map that trace rays themselves, at most 64 and at most `gather_rays`; 0: as
    /// many as `gather_rays`, at most 64. Those with few others beside them have twice as many, within the same limits.
    pub own_rays: u32,
    /// Radius of the gather map's blur in gather texels; 0: none, and direct light from skies, area lights and many lights
    /// is not blurred where it is noisy either.
    pub blur_radius: u32,
    /// Number of shadow rays per light map texel and area light or disc of a directional light. More than four area
    /// lights share four times as many rays by their unoccluded light; a sky takes four times as many, and many lights
    /// together do. The rays start from 4 points of the texel, or from 16 in the penumbra of a disc. Point, spot and
    /// parallel lights take one ray each, and 4 to 16 more, spread over the texel, where shadow edges cross it.
    pub direct_samples: u32,
    /// Seed of all random numbers. The same seed gives the same bits on any number of threads.
    pub seed: u64,
    /// Limit in bytes of the memory that the bake takes in addition to scene and light map; 0: no limit.
    pub memory_budget: u64,
    /// First covered texel to bake, in the order of charts, separate texels of backs last.
    pub texel_begin: u64,
    /// The covered texel behind the last one to bake; 0: all.
    pub texel_end: u64,
    /// Whether to stitch seams: where a smooth surface is cut in the light map, the texels along the edge are changed
    /// so that both sides look the same under bilinear filtering, once all texels are baked. Live updates do not
    /// stitch: [`LiveParams::bake`](crate::live::LiveParams::bake) says `false`.
    pub stitch: bool,
    /// Bits of [`directional`]: which light is computed by direction too (SH L1, for normal maps), as [`Layer::L0`] and
    /// the layers after it. 0: none, which takes no time and no memory.
    pub directional: u32,
    /// Number of passes, 1 to 4096: bakes with different random numbers whose mean is the light. n of them take n times
    /// as long and have 1/n of the noise's variance. From two on, [`Layer::Error`] and [`BakeStats::error`] tell the
    /// noise that is left.
    pub passes: u32,
    /// If not 0, there are as many passes as it takes (at least four and [`passes`](Self::passes), at most 4096) until
    /// [`BakeStats::error`] is no larger: finite, ≥ 0. For bakes of all texels only.
    pub target_error: f32,
}

/// Bits of [`BakeParams::directional`].
pub mod directional {
    /// Light that was reflected by other surfaces.
    pub const INDIRECT: u32 = 1 << 0;
    /// Light that comes straight from lights.
    pub const DIRECT: u32 = 1 << 1;
}

impl Default for BakeParams {
    fn default() -> Self {
        BakeParams {
            photon_count: 1_000_000,
            max_bounces: 0,
            gather_rays: 128,
            radius: 0.0,
            near_hits: 0.0,
            interpolation_error: 1.5,
            interpolation_contrast: 0.15,
            own_rays: 0,
            blur_radius: 2,
            direct_samples: 16,
            seed: 0,
            memory_budget: 0,
            texel_begin: 0,
            texel_end: 0,
            stitch: true,
            directional: 0,
            passes: 1,
            target_error: 0.0,
        }
    }
}

/// Wall time and work of one stage.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StageStats {
    /// Wall time in seconds.
    pub seconds: f64,
    /// Number of rays traced.
    pub rays: u64,
    /// Size of the stage's buffers in bytes.
    pub bytes: u64,
}

/// Numbers about a bake.
#[derive(Clone, Copy, Debug, Default)]
pub struct BakeStats {
    /// Tracing and sorting of photons.
    pub photons: StageStats,
    /// Number of photons emitted.
    pub photons_emitted: u64,
    /// Number of photons stored on surfaces.
    pub photons_stored: u64,
    /// Radiance map.
    pub radiance: StageStats,
    /// Gather map: indirect light.
    pub gather: StageStats,
    /// Direct light with shadow rays.
    pub direct: StageStats,
    /// Filtering and composition.
    pub compose: StageStats,
    /// Number of two-sided charts whose texels show the back, because the view from it is longer, or more light falls
    /// on it.
    pub back_charts: u64,
    /// Wall time of the whole bake in seconds.
    pub seconds: f64,
    /// Maximum of the memory that the device's objects held at once, in bytes.
    pub peak_bytes: u64,
    /// Bits of [`plan::left_out`]: work that the scene does not need.
    pub left_out: u32,
    /// Number of points along stitched edges, at most half a texel apart.
    pub seam_points: u64,
    /// Difference of light between the two sides of stitched edges, before the stitching: root mean square relative to
    /// the mean irradiance there.
    pub seam_rms_before: f64,
    /// Difference of light between the two sides of stitched edges after the stitching, relative like
    /// `seam_rms_before`.
    pub seam_rms_after: f64,
    /// Duration of finding and stitching seams, in seconds.
    pub seam_seconds: f64,
    /// Number of texels that kept all of their light, in a bake of what [has changed](Lightmap::bake_changed).
    pub kept_texels: u64,
    /// Number of passes.
    pub passes: u32,
    /// Estimated relative error of the mean of several passes, as far as it is noise: the root of the mean over texels
    /// and channels of variance by squared irradiance; texels darker than a tenth of the mean count as if they were so
    /// bright. 0 after a single pass, which does not tell.
    pub error: f64,
}

/// Layers of a light map that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Layer {
    /// Irradiance, direct plus indirect (RGB, W/m²).
    Combined = 0,
    /// Irradiance that was reflected by other surfaces (RGB, W/m²).
    Indirect = 1,
    /// Irradiance that comes straight from lights (RGB, W/m²).
    Direct = 2,
    /// Outgoing radiance (RGB, W/(m²·sr)).
    Radiance = 3,
    /// 1 for a covered texel; 0.5 for one whose light is copied from its neighbours (padding, texels inside solids); 0
    /// for an empty one. After a bake of a range of texels those that are not baked yet are 0; before the first bake
    /// covered texels are 1.
    Validity = 4,
    /// Position of the texel's sample in the scene (RGB); 0 for texels that no triangle covers.
    Position = 5,
    /// Unit normal of the texel's sample (RGB); 0 for texels that no triangle covers.
    Normal = 6,
    /// Global triangle number (u32), [`crate::scene::NONE`] where there is none.
    Triangle = 7,
    /// Mean radiance over the sphere, of which the half below the surface is dark, of the light that
    /// [`BakeParams::directional`] asks for: 1 / 4π · ∫ L dω (RGB, W/(m²·sr)).
    L0 = 8,
    /// The same mean of radiance times the x coordinate of its direction, 1 / 4π · ∫ L ω dω, ≥ −L0 and ≤ L0 (RGB,
    /// W/(m²·sr)). Directions are those of the scene.
    L1X = 9,
    /// The same for y.
    L1Y = 10,
    /// The same for z.
    L1Z = 11,
    /// [`L1X`](Self::L1X) / [`L0`](Self::L0), −1 to 1; 0 where there is no light (RGB).
    RatioX = 12,
    /// The same for y.
    RatioY = 13,
    /// The same for z.
    RatioZ = 14,
    /// Dominant direction: L1 / L0 of the sum of the channels, a vector in the scene whose length is 1 if all light comes
    /// from one direction (x, y, z).
    Direction = 15,
    /// Standard error of the combined irradiance of a bake of several [passes](BakeParams::passes), before the stitching
    /// of seams (RGB, W/m²). It is an estimate from as many values as there were passes.
    Error = 16,
    /// Number of the chart whose light a texel holds or, in the padding, repeats; a number of its own for the texels of a
    /// chart's back (u32). [`crate::scene::NONE`] where there is none.
    Chart = 17,
}

/// Half of the passes of a bake: light whose noise is independent of that of the other half.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Half {
    /// The first pass and every second one after it.
    First,
    /// The others.
    Second,
}

impl Layer {
    /// Returns what the layer holds of light by direction; 0 if that is nothing.
    pub(crate) fn of_directional(self, d: &Directional) -> Vec3 {
        let ratio = |l1: Vec3, l0: Vec3| Vec3::select(l0.cmpgt(Vec3::ZERO), l1 / l0, Vec3::ZERO);
        match self {
            Layer::L0 => d.l0,
            Layer::L1X => d.l1[0],
            Layer::L1Y => d.l1[1],
            Layer::L1Z => d.l1[2],
            Layer::RatioX => ratio(d.l1[0], d.l0),
            Layer::RatioY => ratio(d.l1[1], d.l0),
            Layer::RatioZ => ratio(d.l1[2], d.l0),
            Layer::Direction => ratio(d.l1.map(Vec3::element_sum).into(), Vec3::splat(d.l0.element_sum())),
            _ => Vec3::ZERO,
        }
    }

    /// Whether the layer holds light that a bake computes.
    pub fn is_light(self) -> bool {
        !matches!(self, Layer::Validity | Layer::Position | Layer::Normal | Layer::Triangle | Layer::Chart)
    }

    /// Whether the layer holds light by direction.
    pub fn is_directional(self) -> bool {
        self.is_ratio() || matches!(self, Layer::L0 | Layer::L1X | Layer::L1Y | Layer::L1Z)
    }

    /// Whether the values are ratios, −1 to 1.
    pub fn is_ratio(self) -> bool {
        matches!(self, Layer::RatioX | Layer::RatioY | Layer::RatioZ | Layer::Direction)
    }
}

/// Packs a value of a [layer of ratios](Layer::is_ratio) into a byte: 255 times 0.5 plus half of it.
pub fn packed_ratio(ratio: f32) -> u8 {
    (127.5 + 127.5 * ratio).round().clamp(0.0, 255.0) as u8
}

/// The content of one layer of one page, row-major, row 0 at v = 0.
#[derive(Clone, Debug)]
pub enum LayerData {
    /// Colours or vectors.
    Rgb(Vec<[f32; 3]>),
    /// Single numbers.
    Scalar(Vec<f32>),
    /// Indices.
    Integer(Vec<u32>),
}

/// State of a texel after bakes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
enum TexelState {
    /// The texel is not part of any bake yet.
    #[default]
    Unbaked,
    /// Nobody can see the texel; it shows the light of the nearest one that can be seen.
    Hidden,
    Visible,
}

impl TexelState {
    /// Returns the number of the state in files.
    fn to_byte(self) -> u8 {
        match self {
            TexelState::Unbaked => 0,
            TexelState::Hidden => 1,
            TexelState::Visible => 2,
        }
    }

    fn from_byte(byte: u8) -> Option<TexelState> {
        [TexelState::Unbaked, TexelState::Hidden, TexelState::Visible].into_iter().find(|s| s.to_byte() == byte)
    }
}

/// What several passes tell of the light of a texel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Spread {
    /// Standard error of the sum of direct and indirect light.
    error: Vec3,
    /// Direct and indirect light of every second pass, from the first one on, less that of the others.
    difference: [Vec3; 2],
}

/// Light of the texels after a bake, by sample of the light map.
struct Light {
    direct: Vec<Vec3>,
    indirect: Vec<Vec3>,
    /// The light by direction that the bake was asked for; empty if none was.
    directional: Vec<Directional>,
    /// What several passes tell of the light; empty after a single one.
    spread: Vec<Spread>,
    state: Vec<TexelState>,
    /// Reflected radiance, by sample of the radiance map. Empty if the bake left it out.
    radiance: Radiance,
    /// Whether a chart without separate texels for its back shows the back, by chart. Empty if none is two-sided.
    backs: Vec<bool>,
    /// Stitched texels with their light before stitching, since every bake of some texels stitches anew.
    stitch: Option<seams::Stitch>,
    /// Parameters and lights of the bake; `None` if bakes that differ in them filled parts of the texels.
    origin: Option<Origin>,
    /// Plan of the bake, without the stitching of seams.
    plan: Plan,
    _memory: Reservation,
}

impl Light {
    /// Returns the size of the buffers.
    fn bytes(&self) -> usize {
        size_of_val(&self.direct[..])
            + size_of_val(&self.indirect[..])
            + size_of_val(&self.directional[..])
            + size_of_val(&self.spread[..])
            + size_of_val(&self.state[..])
            + size_of_val(&self.radiance.values[..])
            + self.backs.len()
    }
}

/// Light maps of a scene: layout, texels and, after [`bake`](Lightmap::bake), light.
pub struct Lightmap {
    pub(in crate::lightmap) atlas: Arc<Atlas>,
    plan: Plan,
    light: Option<Light>,
    /// The atlas that the light was baked for, if the scene has moved since.
    before: Option<Arc<Atlas>>,
}

impl LightmapDesc {
    /// Checks the ranges documented on the fields.
    pub fn validate(&self) -> Result<()> {
        if !(self.texels_per_unit >= 0.0 && self.texels_per_unit.is_finite()) {
            return invalid_argument!("texels_per_unit is {}, not a finite number ≥ 0", self.texels_per_unit);
        }
        if !(16..=MAX_PAGE_SIZE).contains(&self.page_size) {
            return invalid_argument!("page_size is {}, outside 16 to {}", self.page_size, MAX_PAGE_SIZE);
        }
        if !(1..=64).contains(&self.padding) || 4 * self.padding > self.page_size {
            return invalid_argument!("padding is {}, outside 1 to 64 or over a quarter of a page", self.padding);
        }
        for (name, d) in [("gather_divisor", self.gather_divisor), ("radiance_divisor", self.radiance_divisor)] {
            if !(1..=64).contains(&d) {
                return invalid_argument!("{name} is {d}, outside 1 to 64");
            }
        }
        if self.seen_from.len() > MAX_REGIONS {
            return invalid_argument!("seen_from has {} regions, more than {MAX_REGIONS}", self.seen_from.len());
        }
        for (i, Region { lower, upper }) in self.seen_from.iter().enumerate() {
            if !(lower.is_finite() && upper.is_finite() && lower.cmple(*upper).all()) {
                return invalid_argument!("region {i} of seen_from is {lower} to {upper}, not finite and ascending");
            }
        }
        Ok(())
    }
}

impl BakeParams {
    /// Checks the ranges documented on the fields.
    pub fn validate(&self) -> Result<()> {
        if !(self.radius >= 0.0 && self.radius.is_finite()) {
            return invalid_argument!("radius is {}, not a finite number ≥ 0 (0: automatic)", self.radius);
        }
        if self.radius > 0.0 && !self.radius.is_normal() {
            return invalid_argument!("radius is {:e}, less than {:e}", self.radius, f32::MIN_POSITIVE);
        }
        if self.photon_count > MAX_PHOTONS {
            return invalid_argument!("photon_count is {}, more than {MAX_PHOTONS}", self.photon_count);
        }
        if self.gather_rays > 1 << 16 {
            return invalid_argument!("gather_rays is {}, more than 65536", self.gather_rays);
        }
        if !(self.near_hits >= 0.0) {
            return invalid_argument!("near_hits is {}, not a number ≥ 0", self.near_hits);
        }
        if self.own_rays > ROUND as u32 {
            return invalid_argument!("own_rays is {}, more than {ROUND}", self.own_rays);
        }
        if !(self.interpolation_error > 0.0) {
            return invalid_argument!("interpolation_error is {}, not a number > 0", self.interpolation_error);
        }
        if !(self.interpolation_contrast > 0.0) {
            return invalid_argument!("interpolation_contrast is {}, not a number > 0", self.interpolation_contrast);
        }
        if self.blur_radius > blur::MAX_BLUR_RADIUS {
            return invalid_argument!("blur_radius is {}, more than {}", self.blur_radius, blur::MAX_BLUR_RADIUS);
        }
        if !(1..=4096).contains(&self.direct_samples) {
            return invalid_argument!("direct_samples is {}, outside 1 to 4096", self.direct_samples);
        }
        if self.texel_end != 0 && self.texel_end <= self.texel_begin {
            return invalid_argument!("the texels {} to {} are none", self.texel_begin, self.texel_end);
        }
        if self.directional & !(directional::INDIRECT | directional::DIRECT) != 0 {
            return invalid_argument!("directional is {:#x}, which has unknown bits", self.directional);
        }
        if !(1..=passes::MAX_PASSES).contains(&self.passes) {
            return invalid_argument!("passes is {}, outside 1 to {}", self.passes, passes::MAX_PASSES);
        }
        if !(self.target_error >= 0.0 && self.target_error.is_finite()) {
            return invalid_argument!("target_error is {}, not a finite number ≥ 0", self.target_error);
        }
        Ok(())
    }
}

impl Lightmap {
    /// Returns the scene that is lit.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.atlas.scene
    }

    /// Returns charts and texels of the three maps.
    pub(crate) fn atlas(&self) -> &Arc<Atlas> {
        &self.atlas
    }

    /// Returns the light, unless it is of the scene before it moved.
    fn current_light(&self) -> Option<&Light> {
        self.light.as_ref().filter(|_| self.before.is_none())
    }

    /// Returns numbers about layout and texels.
    pub fn info(&self) -> LightmapInfo {
        self.atlas.info
    }

    /// Whether a bake was asked for light by direction.
    pub fn has_directional(&self) -> bool {
        self.light.as_ref().is_some_and(|l| !l.directional.is_empty())
    }

    /// Whether a bake had several passes, which tell the error of the light.
    pub fn has_error(&self) -> bool {
        self.light.as_ref().is_some_and(|l| !l.spread.is_empty())
    }

    /// Describes the plan of the last bake (before the first: of a bake with default parameters): what runs, and what
    /// is left out and why, one line each.
    pub fn plan_text(&self) -> String {
        self.plan.text()
    }
}
