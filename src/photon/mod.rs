//! The photon map (thesis 3.2.2; Jensen, *Realistic Image Synthesis Using Photon Mapping*, 2001).
//!
//! | file | what is in it |
//! |---|---|
//! | `emission.rs`, `spot.rs` | lights by power, stratified positions and directions |
//! | `trace.rs` | paths with Russian roulette, blocks of photons in parallel |
//! | `share.rs` | photons that several machines trace |
//! | `again.rs` | photons after something has moved, old and new ones told apart |
//! | `radius.rs` | the automatic search radius |
//! | `grid.rs` | photons sorted into a uniform grid, one array per component |
//! | `estimate.rs` | the irradiance estimate, over the lanes of each ISA |
//! | `coverage.rs` | the visible part of the estimate's disc |
//!
//! The same seed and ISA give the same map and the same estimates for any number of threads.

mod again;
pub(crate) mod coverage;
mod cylinder;
mod emission;
mod estimate;
mod grid;
mod guide;
mod noted;
mod radius;
mod share;
mod spot;
pub(crate) mod trace;

pub(crate) use again::{Change, Difference, Guidance};

use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{MemoryMonitor, Reservation, try_vec};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::base::share::Share;
use crate::scene::Scene;
use crate::trace::Ray;
use cylinder::Cylinder;
use estimate::EstimateFn;
use glam::Vec3;
use grid::Grid;
use guide::Guide;
use noted::Noted;
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};
use std::time::Instant;
use trace::Traced;

/// Maximum number of photons that can be emitted: their numbers are 32-bit.
pub const MAX_PHOTONS: u64 = 1 << 32;

/// Parameters of a photon map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotonParams {
    /// Photons emitted, 1 to [`MAX_PHOTONS`]. Up to 3/16 as many, at most 196,608, are traced before to find out where
    /// to send them.
    pub photon_count: u64,
    /// Maximum number of surface interactions per photon (1: direct light only); 0: paths are ended by Russian roulette
    /// alone, and by [`PATH_LIMIT`] as a safeguard.
    pub max_bounces: u32,
    /// Search radius of the estimate in scene units; 0: chosen so that the average disc on the
    /// surfaces that photons reached holds about [`PHOTONS_PER_DISC`].
    pub radius: f32,
    /// Minimum of the automatic radius, in scene units: half the distance between the points where estimates are
    /// needed, so that the discs around them leave no photon out.
    pub least_radius: f32,
    /// Half the height of the search cylinder, as a fraction of the radius; more than 0.
    pub half_height: f32,
    /// Jensen's cone filter constant, ≥ 1; infinity: no filter.
    pub cone_k: f32,
    /// Seed of the random numbers.
    pub seed: u64,
    /// Bytes that the map may take while it is made; 0: no limit.
    pub memory_budget: u64,
    /// Whether photons are stored at their first surface too (direct light).
    pub store_direct: bool,
    /// Approximate maximum number of stored photons; of more, every n-th is stored with n times the power. 0: all.
    pub most_stored: u64,
}

impl Default for PhotonParams {
    fn default() -> Self {
        PhotonParams {
            photon_count: 1_000_000,
            max_bounces: 0,
            radius: 0.0,
            least_radius: 0.0,
            half_height: 0.25,
            cone_k: 1.1,
            seed: 0,
            memory_budget: 0,
            store_direct: true,
            most_stored: 0,
        }
    }
}

impl PhotonParams {
    /// Checks the ranges documented on the fields.
    pub fn validate(&self) -> Result<()> {
        if self.photon_count == 0 || self.photon_count > MAX_PHOTONS {
            return invalid_argument!("photon_count is {}, not 1 to {MAX_PHOTONS}", self.photon_count);
        }
        if !(self.radius >= 0.0 && self.radius.is_finite()) {
            return invalid_argument!("radius is {}, not a finite number ≥ 0 (0: automatic)", self.radius);
        }
        if self.radius > 0.0 && !self.radius.is_normal() {
            return invalid_argument!("radius is {:e}, less than {:e}", self.radius, f32::MIN_POSITIVE);
        }
        if !(self.half_height > 0.0 && self.half_height.is_finite()) {
            return invalid_argument!("half_height is {}, not a finite number > 0", self.half_height);
        }
        if !(self.least_radius >= 0.0 && self.least_radius.is_finite()) {
            return invalid_argument!("least_radius is {}, not a finite number ≥ 0", self.least_radius);
        }
        if self.cone_k.is_nan() || self.cone_k < 1.0 {
            return invalid_argument!("cone_k is {}, not ≥ 1 (infinity: no filter)", self.cone_k);
        }
        Ok(())
    }
}

/// Surface interactions after which a path ends even if `max_bounces` is 0. Light that survives
/// 10,000 reflections carries less than 10⁻⁴ of its power at albedo 0.999.
pub const PATH_LIMIT: u32 = 10_000;

/// Photons in the average disc of the automatic radius. Jensen (2001, section 7.2) finds 50 to 500
/// useful; the radiance map is seen through the final gather, which averages further, so resolution
/// is worth more than smoothness.
pub const PHOTONS_PER_DISC: f64 = 60.0;

/// Statistics of photon tracing.
///
/// The light that hits surfaces is accounted by expectation at each interaction (reflectance times
/// power), so `absorbed + escaped + truncated = emitted` holds up to the sampling error of Russian
/// roulette.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhotonStats {
    /// Photons emitted: the count asked for, or 0 if no light has any power.
    pub emitted: u64,
    /// Photons stored.
    pub stored: u64,
    /// Rays traced.
    pub rays: u64,
    /// Power of all lights, W per channel. For directional lights: the power that reaches the bounding box; for those
    /// with a disc and for skies: the power that reaches the bounding sphere.
    pub emitted_power: [f64; 3],
    /// Power absorbed by surfaces, including the back sides of one-sided ones, W per channel.
    pub absorbed_power: [f64; 3],
    /// Power that missed every surface, or was not aimed at the scene to begin with, W per channel.
    pub escaped_power: [f64; 3],
    /// Power that would have been reflected where `max_bounces` (or [`PATH_LIMIT`]) ended the path, W per channel.
    pub truncated_power: [f64; 3],
    /// Wall time of emission and tracing.
    pub trace_seconds: f64,
    /// Wall time of sorting into the grid and of choosing the radius.
    pub grid_seconds: f64,
}

/// The stored photons, one array per component, all of the same length, sorted by grid cell.
#[derive(Clone, Copy, Debug)]
pub struct PhotonView<'a> {
    /// x, y and z of the positions, in scene units.
    pub position: [&'a [f32]; 3],
    /// x, y and z of the unit directions of travel.
    pub direction: [&'a [f32]; 3],
    /// Red, green and blue power in W.
    pub power: [&'a [f32]; 3],
    /// x, y and z of the unit geometric normal of the surface, on the side that was hit.
    pub normal: [&'a [f32]; 3],
}

/// The stored photons as packed triples.
pub struct PackedPhotons {
    /// Positions in scene units.
    pub position: Vec<[f32; 3]>,
    /// Unit directions of travel.
    pub direction: Vec<[f32; 3]>,
    /// Power in W per channel.
    pub power: Vec<[f32; 3]>,
    _memory: Reservation,
}

impl PackedPhotons {
    fn new(view: PhotonView, monitor: &Arc<MemoryMonitor>) -> Result<Self> {
        let memory = monitor.reserve(view.len() * 36, "packed photons")?;
        let pack = |columns: [&[f32]; 3]| -> Result<Vec<[f32; 3]>> {
            let mut packed = try_vec(view.len(), "packed photons")?;
            for (i, p) in packed.iter_mut().enumerate() {
                *p = columns.map(|c| c[i]);
            }
            Ok(packed)
        };
        Ok(PackedPhotons {
            position: pack(view.position)?,
            direction: pack(view.direction)?,
            power: pack(view.power)?,
            _memory: memory,
        })
    }
}

impl PhotonView<'_> {
    /// Number of photons.
    pub fn len(&self) -> usize {
        self.position[0].len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Number of points per block in which estimates are handed to threads: some 50 µs of work.
const BLOCK: usize = 128;

/// Photons on the surfaces of a scene, in a uniform grid.
pub struct PhotonMap {
    scene: Arc<Scene>,
    stats: PhotonStats,
    grid: Grid,
    cylinder: Cylinder,
    kernel: EstimateFn,
    /// How the lights were guided, if all photons were stored.
    guides: Option<Vec<Option<Arc<Guide>>>>,
    packed: OnceLock<PackedPhotons>,
    _memory: Reservation,
}

impl PhotonMap {
    /// Emits, traces and sorts photons.
    ///
    /// `InvalidArgument` for parameters out of range, `InvalidState` if the scene has no lights,
    /// `OutOfMemory` if `memory_budget` or the memory monitor refuses. Lights without power make an
    /// empty map.
    pub fn trace(scene: &Arc<Scene>, params: &PhotonParams, progress: &Progress) -> Result<PhotonMap> {
        let trace = || Self::trace_within(scene, params, progress, 0.0, 1.0);
        scene.while_unchanged(|| scene.device().run(progress, trace))
    }

    /// Does the work of `trace` as a part of a longer call: reports progress over `[from, to]` of the bar.
    pub fn trace_within(
        scene: &Arc<Scene>,
        params: &PhotonParams,
        progress: &Progress,
        from: f32,
        to: f32,
    ) -> Result<PhotonMap> {
        // Sorting is about a twentieth of the work.
        let split = from + 0.95 * (to - from);
        let trace = || Traced::trace(scene, params, Share::ALL, progress, (from, split));
        let traced = scene.device().install(trace)?;
        Self::of(scene, params, traced, progress, split, to)
    }

    /// Sorts all photons, which have been traced with the same parameters; reports progress over `[from, to]` of the bar.
    pub(crate) fn of(
        scene: &Arc<Scene>,
        params: &PhotonParams,
        traced: Traced,
        progress: &Progress,
        from: f32,
        to: f32,
    ) -> Result<PhotonMap> {
        scene.device().install(|| {
            let (mut stats, mut traced) = (traced.stats, traced);
            let guides = traced.guides.take();
            let start = Instant::now();
            let radius = if params.radius > 0.0 {
                params.radius
            } else {
                radius::automatic(&traced.blocks, scene.diagonal(), PHOTONS_PER_DISC)?
                    .max(params.least_radius.min(scene.diagonal()))
            };
            let (grid, memory) = Grid::build(traced, radius, progress, (from, to))?;
            stats.grid_seconds = start.elapsed().as_secs_f64();
            Ok(PhotonMap {
                scene: scene.clone(),
                stats,
                grid,
                cylinder: Cylinder::new(radius, params.half_height, params.cone_k),
                kernel: estimate::kernel(scene.device().isa()),
                guides,
                packed: OnceLock::new(),
                _memory: memory,
            })
        })
    }

    /// The scene that the map was made from.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// Statistics of the tracing.
    pub fn stats(&self) -> PhotonStats {
        self.stats
    }

    /// Search radius in use.
    pub fn radius(&self) -> f32 {
        self.cylinder.radius
    }

    /// Bytes held, without the copy that [`photons`](Self::photons) makes.
    pub fn bytes(&self) -> usize {
        self.grid.bytes()
    }

    /// Irradiance (W/m²) at `position` on the side that the unit vector `normal` points to: from the photons in a
    /// cylinder around the normal, whose surfaces face within 60° of it and whose light comes from the front, weighted
    /// by Jensen's cone filter.
    ///
    /// The estimate assumes that the disc lies wholly on the surface: less than a radius from an
    /// edge it falls, to half at the edge itself.
    pub fn estimate(&self, position: Vec3, normal: Vec3) -> [f32; 3] {
        let mut out = [[0.0; 3]];
        self.estimate_block(&[position.to_array()], &[normal.to_array()], &mut out);
        out[0]
    }

    /// [`estimate`](Self::estimate) for many points, in order, on the device's threads.
    /// `InvalidArgument` if the lengths differ; after a cancel, `out` is partly written.
    pub fn estimate_many(
        &self,
        positions: &[[f32; 3]],
        normals: &[[f32; 3]],
        out: &mut [[f32; 3]],
        progress: &Progress,
    ) -> Result<()> {
        if positions.len() != normals.len() || positions.len() != out.len() {
            return invalid_argument!(
                "{} positions, but {} normals and room for {} estimates",
                positions.len(),
                normals.len(),
                out.len()
            );
        }
        let stage = progress.stage("photon estimates", 0.0, 1.0, positions.len() as u64);
        let blocks = positions.par_chunks(BLOCK).zip(normals.par_chunks(BLOCK)).zip(out.par_chunks_mut(BLOCK));
        self.scene.device().run(progress, || {
            blocks.try_each(|((positions, normals), out)| {
                self.estimate_block(positions, normals, out);
                stage.advance(positions.len() as u64)
            })
        })
    }

    /// [`estimate`](Self::estimate) for as many points as all three slices have, on this thread.
    pub fn estimate_block(&self, positions: &[[f32; 3]], normals: &[[f32; 3]], out: &mut [[f32; 3]]) {
        (self.kernel)(&self.grid, &self.cylinder, positions, normals, out, None);
    }

    /// [`estimate`](Self::estimate), with some of the photons that count.
    fn estimate_and_note(&self, position: Vec3, normal: Vec3, noted: &mut Noted) -> [f32; 3] {
        let mut out = [[0.0; 3]];
        let (position, normal) = (&[position.to_array()], &[normal.to_array()]);
        noted.clear();
        (self.kernel)(&self.grid, &self.cylinder, position, normal, &mut out, Some(noted));
        out[0]
    }

    /// The stored photons as the kernels see them, without a copy.
    pub fn columns(&self) -> PhotonView<'_> {
        self.grid.photons.view()
    }

    /// The stored photons as packed triples, in the order of [`columns`](Self::columns). The first
    /// call makes the copy, which the map then keeps; `OutOfMemory` if the monitor refuses it.
    pub fn photons(&self) -> Result<&PackedPhotons> {
        if let Some(packed) = self.packed.get() {
            return Ok(packed);
        }
        let packed = PackedPhotons::new(self.columns(), self.scene.device().memory())?;
        // If two threads make copies at once, one copy is kept.
        Ok(self.packed.get_or_init(|| packed))
    }
}

/// The rays that [`PhotonMap::trace`] would trace, in the order of their photons: for measuring
/// what tracing costs beyond the rays themselves. Nothing is stored.
#[doc(hidden)]
pub fn photon_rays(scene: &Arc<Scene>, params: &PhotonParams) -> Result<Vec<Ray>> {
    params.validate()?;
    trace::record_rays(scene, &scene.lights(), params)
}

#[cfg(test)]
mod tests;
