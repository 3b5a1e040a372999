//! Parameters of live updates, and the numbers that they report.

use super::MAX_LODS;
use super::dirty::LEAST_BYTES;
use crate::base::directional::Directional;
use crate::base::error::{Result, invalid_argument};
use crate::lightmap::indirect::blur::MAX_BLUR_RADIUS;
use crate::lightmap::indirect::gather::Gathered;
use crate::lightmap::indirect::sample_set::ROUND;
use crate::lightmap::{BakeParams, directional};
use glam::Vec3;

/// The choice of blocks that updates work on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Refine the surfaces in view.
    View,
    /// Refine the cells near the camera, visible or not.
    Position,
    /// Refine anywhere, at random, for comparison.
    Uniform,
}

/// Parameters of live updates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveParams {
    /// The choice of blocks that updates work on.
    pub mode: Mode,
    /// Number of levels of detail, 1 to [`MAX_LODS`]. The lowest computes every 2^(lod_count − 1)-th gather texel per
    /// axis.
    pub lod_count: u32,
    /// Rounds of 64 rays that each texel of a cell needs before the cell shows its next LOD, ≥ 1.
    pub promote_threshold: u32,
    /// Rounds of 64 rays after which a texel is finished, at least `promote_threshold`, at most 1024.
    pub max_rounds: u32,
    /// Maximum number of rays per update, whatever its budget; 0: no limit.
    pub rays_per_update: u32,
    /// Radius of a blur for display, in gather texels; accumulated indirect light is not blurred. With 0 noisy direct light
    /// is not blurred either.
    pub blur: u32,
    /// Edge of a grid cell in scene units; 0: a sixteenth of the scene's longest side.
    pub cell_size: f32,
    /// Seed of all random numbers, as in a bake.
    pub seed: u64,
    /// Number of photons to emit, as in a bake.
    pub photon_count: u64,
    /// Maximum number of reflections, as in a bake.
    pub max_bounces: u32,
    /// Shadow rays per light map texel and area light, as in a bake.
    pub direct_samples: u32,
    /// Search radius of photons in scene units, as in a bake.
    pub radius: f32,
    /// Distance up to which hits of gather rays are near, as in a bake.
    pub near_hits: f32,
    /// Estimated error of interpolation above which texels trace rays themselves, as in a bake with an
    /// [`interpolation_contrast`](crate::lightmap::BakeParams::interpolation_contrast) of infinity: the gather map comes after
    /// that choice. Infinity by default: those rays come before the first light.
    pub interpolation_error: f32,
    /// Number of rays of such texels, as in a bake.
    pub own_rays: u32,
    /// Whether the object begins with a first impression of indirect light, which is replaced by that of all photons when
    /// this has been computed between updates.
    pub quick_start: bool,
    /// Whether the device's threads go on working between updates.
    pub background: bool,
    /// Bits of [`directional`]: the light that is computed by direction too, as in a bake.
    pub directional: u32,
}

impl Default for LiveParams {
    fn default() -> Self {
        let bake = BakeParams::default();
        LiveParams {
            mode: Mode::View,
            lod_count: 3,
            promote_threshold: 1,
            max_rounds: 16,
            rays_per_update: 0,
            blur: bake.blur_radius,
            cell_size: 0.0,
            seed: bake.seed,
            photon_count: bake.photon_count,
            max_bounces: bake.max_bounces,
            direct_samples: bake.direct_samples,
            radius: bake.radius,
            near_hits: bake.near_hits,
            interpolation_error: f32::INFINITY,
            // Fewer than in a bake: they come before the first light.
            own_rays: 16,
            quick_start: false,
            background: false,
            directional: bake.directional,
        }
    }
}

/// A perspective camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveCamera {
    /// Position in scene units.
    pub position: Vec3,
    /// Direction of view, of any length.
    pub forward: Vec3,
    /// Upward direction, of any length, not parallel to `forward`.
    pub up: Vec3,
    /// Vertical field of view in radians, in (0, π).
    pub fov_y: f32,
    /// Width of the picture in pixels; only the ratio to `height` matters.
    pub width: u32,
    /// Height of the picture in pixels.
    pub height: u32,
}

/// Limits of an update. If time and rays are 0, nothing is traced.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Budget {
    /// Time limit in milliseconds; 0: none.
    pub milliseconds: f32,
    /// Limit of the number of rays; 0: none.
    pub rays: u64,
    /// Limit of the bytes of texels, 8 per texel, in the rectangles that can be taken after the update, 1,024 at least; 0:
    /// none.
    pub max_dirty_bytes: u64,
}

/// Numbers about an update, and the state after it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LiveStats {
    /// Whether indirect light is being recomputed because a light has changed, or after a quick start.
    pub light_pending: bool,
    /// Duration of the update in milliseconds.
    pub milliseconds: f32,
    /// Estimated relative error (RMS) of the indirect light that the camera sees.
    pub visible_error: f32,
    /// Fraction of all blocks that is finished.
    pub finished: f32,
    /// Fraction of the blocks in view that is finished.
    pub visible_finished: f32,
    /// Number of rays traced by the update, and in the background since the update before.
    pub rays: u64,
    /// Number of rays traced since the beginning.
    pub total_rays: u64,
    /// Number of cells that were promoted to a higher LOD.
    pub cells_promoted: u32,
    /// Number of blocks whose shown light changed.
    pub blocks_changed: u32,
    /// Bytes of the texels, 8 per texel, in the rectangles that can be taken now.
    pub dirty_bytes: u64,
    /// Bytes of the changed texels that are kept for later updates.
    pub dirty_bytes_left: u64,
    /// Size of the live object in bytes.
    pub bytes: u64,
    /// Size in bytes with all LODs in use everywhere.
    pub bytes_full: u64,
}

/// A rectangle of texels of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PageRect {
    /// Number of the page.
    pub page: u32,
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Number of columns.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
}

impl LiveParams {
    /// Checks the ranges documented on the fields.
    pub fn validate(&self) -> Result<()> {
        if !(1..=MAX_LODS as u32).contains(&self.lod_count) {
            return invalid_argument!("lod_count is {}, outside 1 to {MAX_LODS}", self.lod_count);
        }
        if !(1..=1024).contains(&self.max_rounds) {
            return invalid_argument!("max_rounds is {}, outside 1 to 1024", self.max_rounds);
        }
        if !(1..=self.max_rounds).contains(&self.promote_threshold) {
            let (t, m) = (self.promote_threshold, self.max_rounds);
            return invalid_argument!("promote_threshold is {t}, outside 1 to max_rounds ({m})");
        }
        if self.blur > MAX_BLUR_RADIUS {
            return invalid_argument!("blur is {}, more than {MAX_BLUR_RADIUS}", self.blur);
        }
        self.bake().validate()
    }

    /// Parameters of the bake that the updates converge to.
    pub fn bake(&self) -> BakeParams {
        BakeParams {
            photon_count: self.photon_count,
            max_bounces: self.max_bounces,
            gather_rays: self.max_rounds * ROUND as u32,
            radius: self.radius,
            near_hits: self.near_hits,
            interpolation_error: self.interpolation_error,
            interpolation_contrast: f32::INFINITY,
            own_rays: self.own_rays,
            blur_radius: self.blur,
            direct_samples: self.direct_samples,
            seed: self.seed,
            directional: self.directional,
            // Shown light changes block by block, and each block is shown as it is.
            stitch: false,
            ..Default::default()
        }
    }
}

impl LiveParams {
    /// Bytes of a gather texel's sums.
    pub(super) fn gathered_bytes(&self) -> usize {
        size_of::<Gathered>() + self.by_direction(directional::INDIRECT)
    }

    /// Bytes of a gather texel's light of before a change.
    pub(super) fn shown_bytes(&self) -> usize {
        size_of::<Vec3>() + self.by_direction(directional::INDIRECT)
    }

    /// Bytes of a light map texel's direct light.
    pub(super) fn direct_bytes(&self) -> usize {
        size_of::<Vec3>() + self.by_direction(directional::DIRECT)
    }

    fn by_direction(&self, bit: u32) -> usize {
        if self.directional & bit != 0 { size_of::<Directional>() } else { 0 }
    }
}

impl Budget {
    pub(super) fn is_nothing(&self) -> bool {
        self.milliseconds == 0.0 && self.rays == 0
    }

    pub(super) fn validate(&self) -> Result<()> {
        if !(self.milliseconds >= 0.0 && self.milliseconds.is_finite()) {
            return invalid_argument!("the budget is {} milliseconds, not a finite number ≥ 0", self.milliseconds);
        }
        if self.max_dirty_bytes != 0 && self.max_dirty_bytes < LEAST_BYTES {
            let bytes = self.max_dirty_bytes;
            return invalid_argument!("max_dirty_bytes is {bytes}, neither 0 nor at least {LEAST_BYTES}");
        }
        Ok(())
    }
}
