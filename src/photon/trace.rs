//! Photon tracing (thesis 3.2.2): diffuse paths ended by Russian roulette. At a thin sheet that transmits, the
//! roulette also decides which way a path goes on.
//!
//! Photons are traced in blocks of consecutive numbers. A block goes in waves: one ray for each
//! path that is still alive, then all their hits, so that the kernel runs over an array of rays
//! and the cache misses of shading overlap. Everything random is a function of the photon's number
//! and its bounce, and blocks are kept in order, so threads make no difference.

use super::emission::Emission;
use super::guide::{Guide, PilotPhoton};
use super::{PATH_LIMIT, PhotonParams, PhotonStats};
use crate::base::bounds::Bounds;
use crate::base::error::{Error, Result};
use crate::base::memory::{
    MemoryMonitor, Reservation, try_append, try_collect, try_filled, try_par_collect_ok, try_push, try_to_vec,
    try_with_capacity,
};
use crate::base::progress::{Progress, Stage};
use crate::base::sampling::{combine, cosine_around, purpose_seed, sobol_2d, sobol_2d_bits, uniform};
use crate::base::share::Share;
use crate::scene::{Light, NONE, Scene};
use crate::trace::offset::{SurfacePoint, offset_ray_origin};
use crate::trace::{RawHit, Ray};
use bytemuck::{Pod, Zeroable};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::sync::{Arc, Mutex};

/// Number of photons per block: some 5 ms of work, so that cancelling is quick and threads stay busy.
const BLOCK: u64 = 1024;

/// Memory is announced in steps of this many bytes while photons are traced.
const MEMORY_STEP: usize = 16 << 20;

/// Memory is announced in steps of this many bytes within a block, as its photons are stored.
const BLOCK_STEP: usize = 1 << 20;

/// Divisor of the photon count for a round of the pilot, from which guides are made.
const PILOT_PART: u64 = 16;

/// Maximum number of pilot photons of a round.
const MAX_PILOT: u64 = 1 << 16;

/// Number of rounds of the pilot. There is only one if it makes no guide.
const ROUNDS: u64 = 3;

/// Changes the seed for the random numbers of the pilot.
const PILOT_SEED: u64 = u64::from_be_bytes(*b"phopilot");

/// Name of the pilot's photons in error messages.
const PILOT: &str = "pilot photons";

/// A pilot photon and its source.
type Guidable = (usize, PilotPhoton);

/// Assumed maximum number of photons that a path stores: if those of all paths are allowed, no block is traced to
/// estimate their number. (At albedo 0.98 it is 50.)
const MOST_PER_PATH: u64 = 64;

/// Purpose of photon random numbers.
const PURPOSE: u32 = u32::from_be_bytes(*b"phot");
/// Dimensions: the start of a path, its length, then one per surface hit.
const ALLOTMENT: u32 = 0;
const EMIT_POSITION: u32 = 1;
const EMIT_DIRECTION: u32 = 2;
const ROULETTE: u32 = 3;
const BOUNCE: u32 = 4;
/// Dimension of the choice of stored photons, far from those of surfaces.
const STORED: u32 = u32::MAX;

/// A photon on a surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct StoredPhoton {
    pub(super) position: Vec3,
    /// Unit direction of travel.
    pub(super) direction: Vec3,
    /// Power in W per channel.
    pub(super) power: Vec3,
    /// Unit geometric normal on the side that was hit. The estimate compares it with that of its point, to leave out
    /// photons of the other wall in a corner. Three floats rather than a packed octahedral one: the lanes then compare
    /// it without unpacking.
    pub(super) normal: Vec3,
}

/// Stored photons in order of blocks, within a block by bounce and number.
pub(crate) struct Traced {
    pub(super) blocks: Vec<Vec<StoredPhoton>>,
    pub(crate) stats: PhotonStats,
    pub(super) memory: Account,
    /// How the lights were guided, if all photons were stored.
    pub(super) guides: Option<Vec<Option<Arc<Guide>>>>,
}

impl StoredPhoton {
    /// Whether these are numbers that a photon may have.
    pub(super) fn is_possible(&self) -> bool {
        let is_placed = self.position.is_finite() && self.direction.is_finite() && self.normal.is_finite();
        is_placed && self.power.cmpge(Vec3::ZERO).all()
    }
}

/// Traces a share of the photons, whole blocks, reporting over `[from, to]` of the bar. Runs on the current rayon pool.
pub(super) fn trace(
    scene: &Arc<Scene>,
    lights: &[Light],
    params: &PhotonParams,
    share: Share,
    progress: &Progress,
    (from, to): (f32, f32),
) -> Result<Traced> {
    let mut tracer = Tracer::guided(scene, lights, params, progress)?;
    tracer.thin_out(params.most_stored)?;
    let numbers = share.of(tracer.blocks().len());
    let stage = progress.stage("photons", from, to, numbers.len() as u64);
    let memory = Account::new(scene.device().memory().clone(), params.memory_budget);
    let traced = numbers.into_par_iter().map(|block| {
        stage.check()?;
        let result = tracer.block(block as u64, Some((&stage, &memory)), |_, _, _| ())?;
        stage.advance(1)?;
        Ok(result)
    });
    let results: Vec<(Vec<StoredPhoton>, Tally)> = try_par_collect_ok(traced, "blocks of photons")?;

    tracer.traced(results, memory)
}

impl Tracer<'_> {
    /// Puts traced blocks of photons together.
    pub(super) fn traced(&self, results: Vec<(Vec<StoredPhoton>, Tally)>, memory: Account) -> Result<Traced> {
        let mut tally = Tally::default();
        let mut blocks = try_with_capacity(results.len(), "blocks of photons")?;
        for (block, t) in results {
            tally.add(&t);
            blocks.push(block);
        }
        let guides = match self.stored_part == 1.0 {
            true => Some(try_to_vec(self.emission.guides(), "the guides of lights")?),
            false => None,
        };
        let stats = PhotonStats {
            emitted: self.emission.count(),
            stored: blocks.iter().map(|b| b.len() as u64).sum(),
            rays: tally.rays + self.pilot_rays,
            emitted_power: self.emission.power.to_array(),
            absorbed_power: tally.absorbed.to_array(),
            escaped_power: (tally.escaped + self.emission.unaimed).to_array(),
            truncated_power: tally.truncated.to_array(),
            ..Default::default()
        };
        Ok(Traced { blocks, stats, memory, guides })
    }
}

/// Records the rays of all paths.
pub(super) fn record_rays(scene: &Arc<Scene>, lights: &[Light], params: &PhotonParams) -> Result<Vec<Ray>> {
    let tracer = Tracer::guided(scene, lights, params, &Progress::none())?;
    let mut rays = Vec::new();
    for block in 0..tracer.emission.count().div_ceil(BLOCK) {
        tracer.block(block, None, |_, traced, _| rays.extend_from_slice(traced))?;
    }
    Ok(rays)
}

/// Sums over the paths of a block, powers in W per channel.
#[derive(Clone, Copy, Default)]
pub(super) struct Tally {
    pub(super) rays: u64,
    absorbed: DVec3,
    escaped: DVec3,
    truncated: DVec3,
}

impl Tally {
    fn add(&mut self, other: &Tally) {
        self.rays += other.rays;
        self.absorbed += other.absorbed;
        self.escaped += other.escaped;
        self.truncated += other.truncated;
    }
}

/// A path that is still alive.
#[derive(Clone, Copy)]
pub(super) struct Path {
    photon: u32,
    /// Random number of Russian roulette: uniform in (0, 1), given that the path is still alive.
    luck: f32,
    power: Vec3,
    /// Number of reflections so far.
    bounces: u32,
    /// Whether it has [met](Meetings) what moved.
    has_met: bool,
}

/// Paths that pass boxes around what moved between two states of a scene, and the photons that they store from there on.
/// Up to there, and if they pass none, they are the same in both states.
pub(super) struct Meetings<'a> {
    boxes: &'a [Bounds],
    /// Numbers of the paths' photons.
    pub photons: Vec<u32>,
    pub stored: Vec<StoredPhoton>,
}

impl<'a> Meetings<'a> {
    pub fn new(boxes: &'a [Bounds]) -> Meetings<'a> {
        Meetings { boxes, photons: Vec::new(), stored: Vec::new() }
    }

    fn note(&mut self, rays: &[Ray], hits: &[RawHit], paths: &mut [Path]) -> Result<()> {
        for (path, (ray, hit)) in paths.iter_mut().zip(rays.iter().zip(hits)).filter(|(path, _)| !path.has_met) {
            let passes = |moved: &Bounds| moved.is_hit(ray.origin.into(), ray.direction.into(), hit.t);
            if self.boxes.iter().any(passes) {
                path.has_met = true;
                try_push(&mut self.photons, path.photon, "paths that meet what moved")?;
            }
        }
        Ok(())
    }
}

/// The surface that a path hits.
#[derive(Clone, Copy)]
struct Surface {
    corners: [Vec3; 3],
    /// Barycentric weights of vertices 1 and 2.
    weights: [f32; 2],
    front: bool,
    /// Material number; [`NONE`] if nothing was hit.
    material: u32,
    albedo: Vec3,
}

impl Surface {
    const NOTHING: Surface =
        Surface { corners: [Vec3::ZERO; 3], weights: [0.0; 2], front: false, material: NONE, albedo: Vec3::ZERO };
}

pub(super) struct Tracer<'a> {
    scene: &'a Scene,
    pub(super) emission: Emission<'a>,
    seed: u32,
    /// Maximum number of surface interactions per path, passages through sheets not counted.
    limit: u32,
    store_direct: bool,
    /// The part of the photons on surfaces that is stored.
    pub(super) stored_part: f32,
    /// Number of rays traced to find guides and the part of photons to be stored.
    pilot_rays: u64,
}

impl<'a> Tracer<'a> {
    pub(super) fn new(scene: &'a Scene, lights: &[Light], params: &PhotonParams) -> Result<Self> {
        let seed = purpose_seed(params.seed, PURPOSE);
        let emission = Emission::new(scene, lights, params.photon_count, uniform(0, ALLOTMENT, seed))?;
        let limit = if params.max_bounces == 0 { PATH_LIMIT } else { params.max_bounces.min(PATH_LIMIT) };
        let store_direct = params.store_direct;
        Ok(Tracer { scene, emission, seed, limit, store_direct, stored_part: 1.0, pilot_rays: 0 })
    }

    /// Makes a tracer with guides, if there are enough photons to find any.
    fn guided(scene: &'a Scene, lights: &[Light], params: &PhotonParams, progress: &Progress) -> Result<Self> {
        let count = (params.photon_count / PILOT_PART).min(MAX_PILOT);
        let mut tracer = Tracer::new(scene, lights, params)?;
        if count < BLOCK || !tracer.emission.can_be_guided() {
            return Ok(tracer);
        }
        let mut photons: Vec<Guidable> = Vec::new();
        for round in 0..ROUNDS {
            let seed = params.seed ^ PILOT_SEED ^ round << 32;
            let mut pilot = Tracer::new(scene, lights, &PhotonParams { photon_count: count, seed, ..*params })?;
            let is_guided = pilot.emission.guide_by(tracer.emission.guides())?;
            debug_assert!(is_guided, "the lights are the same");
            let blocks = pilot.blocks().into_par_iter().map(|block| {
                progress.check()?;
                pilot.left_by_block(block as u64)
            });
            for (guidable, rays) in try_par_collect_ok(blocks, PILOT)? {
                try_append(&mut photons, &guidable, PILOT)?;
                tracer.pilot_rays += rays;
            }
            tracer.emission.guide(photons.iter().copied())?;
            if tracer.emission.guides().iter().all(Option::is_none) {
                break;
            }
        }
        Ok(tracer)
    }

    /// The numbers of the blocks of photons.
    pub(super) fn blocks(&self) -> std::ops::Range<usize> {
        0..self.emission.count().div_ceil(BLOCK) as usize
    }

    /// Stores only a part of the photons if they would be more than `most` (0: any number) in all, estimated from the
    /// first block.
    pub(super) fn thin_out(&mut self, most: u64) -> Result<()> {
        let count = self.emission.count();
        if most == 0 || count < BLOCK || count.saturating_mul(MOST_PER_PATH) < most {
            return Ok(());
        }
        let (stored, tally) = self.block(0, None, |_, _, _| ())?;
        self.pilot_rays += tally.rays;
        let expected = stored.len() as f64 * count as f64 / BLOCK as f64;
        self.stored_part = (most as f64 / expected).min(1.0) as f32;
        Ok(())
    }

    /// The photons of a block that can be guided, with the number of photons that each left on surfaces after a
    /// reflection, without the last one; and the number of rays traced.
    fn left_by_block(&self, block: u64) -> Result<(Vec<Guidable>, u64)> {
        let mut left = [0; BLOCK as usize];
        let (_, tally) = self.block(block, None, |step, _, paths| {
            // A path that continues from a surface after the first has left a photon on it.
            if step >= 2 {
                paths.iter().for_each(|p| left[(u64::from(p.photon) - block * BLOCK) as usize] += 1);
            }
        })?;
        let photons = (block * BLOCK..self.emission.count()).zip(left);
        let guidable = photons.filter_map(|(photon, left)| {
            let at = |dimension| sobol_2d(photon as u32, combine(self.seed, dimension));
            let (source, pilot) = self.emission.guidable(photon, at(EMIT_POSITION), at(EMIT_DIRECTION))?;
            Some((source, PilotPhoton { left, ..pilot }))
        });
        Ok((try_collect(guidable, PILOT)?, tally.rays))
    }

    /// Traces one block of photons; `watch` may cancel and counts the memory; `see` receives the number, the rays and
    /// the paths of each wave.
    fn block(
        &self,
        block: u64,
        watch: Option<(&Stage, &Account)>,
        see: impl FnMut(u32, &[Ray], &[Path]),
    ) -> Result<(Vec<StoredPhoton>, Tally)> {
        self.some(self.numbers(block), block, watch, None, see)
    }

    /// The numbers of the photons of a block.
    pub(super) fn numbers(&self, block: u64) -> impl Iterator<Item = u32> + use<> {
        (block * BLOCK..((block + 1) * BLOCK).min(self.emission.count())).map(|number| number as u32)
    }

    /// Does the work of [`block`](Self::block) for some photons of a block. `meetings` notes those that pass where something
    /// has moved.
    pub(super) fn some(
        &self,
        numbers: impl Iterator<Item = u32>,
        block: u64,
        watch: Option<(&Stage, &Account)>,
        mut meetings: Option<&mut Meetings>,
        mut see: impl FnMut(u32, &[Ray], &[Path]),
    ) -> Result<(Vec<StoredPhoton>, Tally)> {
        let what = "a block of photons";
        let mut rays = try_with_capacity(BLOCK as usize, what)?;
        let mut paths = try_with_capacity(BLOCK as usize, what)?;
        for number in numbers {
            let (ray, path) = self.emit(number);
            rays.push(ray);
            paths.push(path);
        }
        let mut hits = try_filled(rays.len(), RawHit::MISS, what)?;
        let mut surfaces = try_filled(rays.len(), Surface::NOTHING, what)?;
        let (mut stored, mut announced) = (Vec::new(), 0);
        // Every n-th photon is stored, beginning with a random one.
        let (mut due, mut kept) = (uniform(block as u32, STORED, self.seed), 0);
        let mut tally = Tally::default();
        for step in 0..PATH_LIMIT {
            if rays.is_empty() {
                break;
            }
            if let Some((stage, memory)) = watch {
                if stage.is_cancelled() {
                    return Err(Error::Cancelled);
                }
                // Between white walls, a block may store ten million photons.
                let bytes = stored.len() * size_of::<StoredPhoton>();
                if bytes - announced >= BLOCK_STEP {
                    memory.grow(bytes - announced)?;
                    announced = bytes;
                }
            }
            see(step, &rays, &paths);
            self.scene.intersect_block(&rays, &mut hits);
            tally.rays += rays.len() as u64;
            if let Some(meetings) = &mut meetings {
                meetings.note(&rays, &hits, &mut paths)?;
            }
            stored.try_reserve(rays.len()).map_err(|e| Error::OutOfMemory(format!("the photons being traced: {e}")))?;
            // Surfaces have a loop of their own, short enough for the processor to overlap the cache misses of several
            // hits: within the next loop, tracing Sponza took a tenth longer.
            for (surface, hit) in surfaces.iter_mut().zip(&hits[..rays.len()]) {
                *surface = self.surface(hit);
            }
            // Survivors move to the front.
            let mut alive = 0;
            for i in 0..rays.len() {
                let before = stored.len();
                let next = self.interact(&rays[i], paths[i], &surfaces[i], step, &mut stored, &mut tally);
                if paths[i].has_met
                    && let Some(meetings) = &mut meetings
                {
                    stored[before..].iter().try_for_each(|&photon| try_push(&mut meetings.stored, photon, what))?;
                }
                if let Some((ray, path)) = next {
                    (rays[alive], paths[alive]) = (ray, path);
                    alive += 1;
                }
            }
            rays.truncate(alive);
            paths.truncate(alive);
            if self.stored_part < 1.0 {
                thin_out(&mut stored, &mut kept, self.stored_part, &mut due);
            }
        }
        stored.shrink_to_fit();
        if let Some((_, memory)) = watch {
            memory.grow(stored.len() * size_of::<StoredPhoton>() - announced)?;
        }
        Ok((stored, tally))
    }

    fn emit(&self, photon: u32) -> (Ray, Path) {
        let at = |dimension| sobol_2d(photon, combine(self.seed, dimension));
        let e = self.emission.emit(photon as u64, at(EMIT_POSITION), at(EMIT_DIRECTION));
        // Uses all 32 bits: the longest of 10⁷ paths are decided by the last bits.
        let [luck, _] = sobol_2d_bits(photon, combine(self.seed, ROULETTE));
        let luck = ((luck as f64 + 0.5) / (1u64 << 32) as f64) as f32;
        (Ray::new(e.origin, e.direction), Path { photon, luck, power: e.power, bounces: 0, has_met: false })
    }

    /// The surface of a hit.
    #[inline]
    fn surface(&self, hit: &RawHit) -> Surface {
        if hit.is_miss() {
            return Surface::NOTHING;
        }
        let (object, triangle) = self.scene.locate(hit.triangle);
        let object = self.scene.object(object);
        let mesh = object.mesh();
        let material = mesh.material(triangle as usize);
        let uv = || mesh.texture_coordinates(triangle as usize, hit.u, hit.v);
        Surface {
            corners: object.corners(triangle),
            weights: [hit.u, hit.v],
            front: hit.front,
            material,
            albedo: self.scene.albedo_at(&self.scene.materials()[material as usize], uv),
        }
    }

    /// Continues a path at the end of `ray`, the `step`-th: stores the photon, and returns the next ray if the path
    /// goes on.
    #[inline]
    fn interact(
        &self,
        ray: &Ray,
        path: Path,
        surface: &Surface,
        step: u32,
        stored: &mut Vec<StoredPhoton>,
        tally: &mut Tally,
    ) -> Option<(Ray, Path)> {
        let power = path.power.as_dvec3();
        if surface.material == NONE {
            tally.escaped += power;
            return None;
        }
        let material = &self.scene.materials()[surface.material as usize];
        let is_black = !surface.front && !material.two_sided;
        if is_black && !material.transmits() {
            tally.absorbed += power;
            return None;
        }
        let point = SurfacePoint::new(surface.corners, surface.weights[0], surface.weights[1], self.scene);
        if !point.normal.is_finite() {
            // A triangle that is one in its mesh, but vanishes where an instance places it.
            tally.absorbed += power;
            return None;
        }
        let direction = Vec3::from_array(ray.direction);
        let normal = if surface.front { point.normal } else { -point.normal };
        if !is_black && (path.bounces > 0 || self.store_direct) {
            stored.push(StoredPhoton { position: point.position, direction, power: path.power, normal });
        }

        let mut reflected = if is_black { Vec3::ZERO } else { path.power * surface.albedo };
        let passed = path.power * Vec3::from_array(material.transmission);
        tally.absorbed += power - reflected.as_dvec3() - passed.as_dvec3();
        if path.bounces + 1 == self.limit {
            tally.truncated += reflected.as_dvec3();
            reflected = Vec3::ZERO;
        }
        if step + 1 == PATH_LIMIT {
            tally.truncated += reflected.as_dvec3() + passed.as_dvec3();
            return None;
        }
        // The brightest channel keeps its power through all bounces: photons of similar power make
        // the least noise (Jensen 2001, section 5.2).
        let brightest = path.power.max_element();
        let (reflects, passes) = (reflected.max_element() / brightest, passed.max_element() / brightest);
        // The sum is more than 1 if different channels are reflected and transmitted.
        let all = (reflects + passes).max(1.0);
        let (reflects, passes) = (reflects / all, passes / all);
        // One number decides a whole path: if it is below a probability, it is uniform again when divided by it. Since
        // the numbers of all photons are stratified, so are the lengths of their paths, and the power that reaches
        // surfaces is almost free of noise (albedo 0.999, 2,000 photons: with independent numbers it was off by 2 %).
        // NaN probabilities, of photons too faint for f32, end the path.
        if path.luck < reflects {
            let u = sobol_2d(path.photon, combine(self.seed, BOUNCE + step));
            let origin = offset_ray_origin(point.interior, normal, self.scene);
            let (luck, power) = (path.luck / reflects, reflected / reflects);
            Some((Ray::new(origin, cosine_around(normal, u)), Path { luck, power, bounces: path.bounces + 1, ..path }))
        } else if path.luck < reflects + passes {
            let origin = offset_ray_origin(point.interior, -normal, self.scene);
            let (luck, power) = ((path.luck - reflects) / passes, passed / passes);
            Some((Ray::new(origin, direction), Path { luck, power, ..path }))
        } else {
            None
        }
    }
}

/// Keeps one in 1/`part` of the photons from `kept` on, systematically, with the power of all. `due`: fraction of a
/// photon carried over from before.
fn thin_out(stored: &mut Vec<StoredPhoton>, kept: &mut usize, part: f32, due: &mut f32) {
    let begin = *kept;
    for i in begin..stored.len() {
        *due += part;
        if *due >= 1.0 {
            *due -= 1.0;
            stored[*kept] = StoredPhoton { power: stored[i].power / part, ..stored[i] };
            *kept += 1;
        }
    }
    stored.truncate(*kept);
}

/// Memory announced while photons are stored, checked against the budget of one call.
pub(super) struct Account {
    monitor: Arc<MemoryMonitor>,
    budget: u64,
    state: Mutex<AccountState>,
}

#[derive(Default)]
struct AccountState {
    used: usize,
    reserved: usize,
    reservations: Vec<Reservation>,
}

impl Account {
    pub(super) fn new(monitor: Arc<MemoryMonitor>, budget: u64) -> Self {
        Account { monitor, budget, state: Mutex::default() }
    }

    /// Counts `bytes` more, announcing them in large steps.
    pub(super) fn grow(&self, bytes: usize) -> Result<()> {
        let mut state = self.state.lock().unwrap_or_else(|e| e.into_inner());
        state.used += bytes;
        self.check(state.used)?;
        if state.used > state.reserved {
            let step = MEMORY_STEP.max(state.used - state.reserved);
            let reservation = self.monitor.reserve(step, "the photons being traced")?;
            state.reserved += step;
            state.reservations.push(reservation);
        }
        Ok(())
    }

    /// Announces `bytes` beside those held already, for `what`.
    pub(super) fn reserve(&self, bytes: usize, what: &str) -> Result<Reservation> {
        let used = self.state.lock().unwrap_or_else(|e| e.into_inner()).used;
        self.check(used + bytes)?;
        self.monitor.reserve(bytes, what)
    }

    fn check(&self, bytes: usize) -> Result<()> {
        if self.budget != 0 && bytes as u64 > self.budget {
            return Err(Error::OutOfMemory(format!(
                "the photon map needs at least {bytes} bytes, more than memory_budget, {}",
                self.budget
            )));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Material, SceneData};

    /// A hall on a field, with a hole in its roof, under `lights`.
    fn hall(lights: &[Light]) -> Arc<Scene> {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.7; 3], two_sided: true, ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        let p = Vec3::new;
        builder.quad(p(-10.0, 0.0, -10.0), p(-10.0, 0.0, 10.0), p(10.0, 0.0, 10.0), p(10.0, 0.0, -10.0), m);
        let corners = [p(-4.0, 0.0, -4.0), p(4.0, 0.0, -4.0), p(4.0, 0.0, 4.0), p(-4.0, 0.0, 4.0)];
        for (i, &a) in corners.iter().enumerate() {
            let b = corners[(i + 1) % 4];
            builder.quad(a, b, b + Vec3::Y * 3.0, a + Vec3::Y * 3.0, m);
        }
        for [x0, z0, x1, z1] in
            [[-4.0, -4.0, 4.0, 0.0], [-4.0, 1.0, 4.0, 4.0], [-4.0, 0.0, 0.0, 1.0], [1.0, 0.0, 4.0, 1.0]]
        {
            builder.quad(p(x0, 3.0, z0), p(x0, 3.0, z1), p(x1, 3.0, z1), p(x1, 3.0, z0), m);
        }
        data.add_mesh(builder.finish()).unwrap();
        lights.iter().for_each(|&light| _ = data.add_light(light).unwrap());
        data.committed()
    }

    #[test]
    fn guided_photons_bring_the_same_light_to_the_same_places_in_larger_number() {
        let position = Vec3::new(3.0, 60.0, 2.0);
        let direction = Vec3::new(-0.1, -1.0, 0.05).normalize();
        let (color, up) = ([3.0, 2.0, 1.0], Vec3::Y);
        let lights = [
            Light::Point { position, intensity: color },
            Light::Spot { position, direction: -Vec3::Y, inner: 0.1, outer: 0.3, intensity: color },
            Light::Directional { direction, irradiance: color, angular_radius: 0.0 },
            Light::Directional { direction, irradiance: color, angular_radius: 0.05 },
            Light::Sky { radiance: color, environment: NONE, up, rotation: 0.0 },
        ];
        // Together, and a hundred lamps of powers over two decades.
        let lamp = |i: u32| Light::Point {
            position: Vec3::new(3.0 - (i % 10) as f32, 50.0, (i / 10) as f32 - 3.0),
            intensity: [0.01 * (i + 1) as f32; 3],
        };
        let many: Vec<Light> = (0..100).map(lamp).collect();
        let alone = lights.iter().map(std::slice::from_ref);
        for lights in alone.chain([&lights[..], &many]) {
            let scene = hall(lights);
            let params = PhotonParams { photon_count: 1 << 19, ..Default::default() };
            // Photons in the hall; red power there, and on all.
            let sums = |tracer: Tracer| {
                let (mut inside, mut red, mut all, mut emitted) = (0, 0.0, 0.0, 0.0);
                for block in 0..tracer.emission.count().div_ceil(BLOCK) {
                    let (stored, tally) = tracer.block(block, None, |_, _, _| ()).unwrap();
                    emitted += (tally.absorbed + tally.escaped + tally.truncated).x;
                    for p in stored {
                        all += f64::from(p.power.x);
                        // On the floor: walls and roof have an outside.
                        if p.position.y < 0.1 && p.position.x.abs().max(p.position.z.abs()) < 3.9 {
                            inside += 1;
                            red += f64::from(p.power.x);
                        }
                    }
                }
                (inside, red, all, emitted)
            };
            let plain = sums(Tracer::new(&scene, lights, &params).unwrap());
            let guided = sums(Tracer::guided(&scene, lights, &params, &Progress::none()).unwrap());
            // A hundredth of the pilot photons makes coarse guides. The plain 1,316 photons have 3 % noise.
            let (more, tolerance) = if lights.len() < 100 { (2.0, 0.03) } else { (1.5, 0.06) };
            assert!(guided.0 as f64 > more * plain.0 as f64, "{lights:?}: {} {}", guided.0, plain.0);
            assert!((guided.1 / plain.1 - 1.0).abs() < tolerance, "{lights:?}: {} {}", guided.1, plain.1);
            assert!((guided.2 / plain.2 - 1.0).abs() < 0.005, "{lights:?}: {} {}", guided.2, plain.2);
            assert!((guided.3 / plain.3 - 1.0).abs() < 1e-3, "{lights:?}: {} {}", guided.3, plain.3);
        }
    }
}
