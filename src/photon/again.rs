//! Photons of another state of a scene, in which something has moved: those that differ are told apart from all others.
//!
//! Paths draw the same random numbers in both states, and lights keep the guides of the former one. So a path is the same up
//! to where it first passes a box around what moved, before or after, and all of it is if it passes none. Paths are traced in the
//! new state; those that pass a box are traced in the former one, too. The photons that they leave from there on came in the new
//! state, and went in the former one. An estimate of the new state is that of the former one and those of what came, less those
//! of what went, all with the same search radius.
//!
//! The emission guide and the search radius of a map made from nothing would be a little different, and with them all
//! photons: they would differ as with another seed.

use super::cylinder::Cylinder;
use super::estimate::{self, EstimateFn};
use super::grid::Grid;
use super::guide::Guide;
use super::trace::{Account, Meetings, StoredPhoton, Tally, Traced, Tracer};
use super::{PhotonMap, PhotonParams, PhotonStats};
use crate::base::bounds::Bounds;
use crate::base::error::Result;
use crate::base::memory::{Reservation, try_collect, try_par_collect_ok, try_push, try_to_vec, try_with_capacity};
use crate::base::progress::Progress;
use crate::scene::Scene;
use crate::trace::offset::ray_epsilon;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::Arc;
use std::time::Instant;

/// What photon maps of other states of a scene have in common with one.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Guidance {
    /// By source of light.
    guides: Vec<Option<Arc<Guide>>>,
    radius: f32,
}

impl Guidance {
    /// Returns it as words of files: radius, number of sources, and for each of these the side of its guide, 0 if it has none,
    /// and the guide.
    pub(crate) fn words(&self) -> Result<Vec<u32>> {
        let mut words = try_collect([self.radius.to_bits(), self.guides.len() as u32], GUIDANCE)?;
        for guide in &self.guides {
            match guide {
                Some(guide) => guide.append_words(&mut words)?,
                None => try_push(&mut words, 0, GUIDANCE)?,
            }
        }
        Ok(words)
    }

    /// Reads what [`words`](Self::words) returned; `None` if it is damaged.
    pub(crate) fn from_words(words: &[u32]) -> Result<Option<Guidance>> {
        let &[radius, count, ref words @ ..] = words else { return Ok(None) };
        let (radius, mut rest) = (f32::from_bits(radius), words);
        if !(radius.is_normal() && radius > 0.0) || count as usize > rest.len() {
            return Ok(None);
        }
        let mut guides = try_with_capacity(count as usize, GUIDANCE)?;
        for _ in 0..count {
            let Some((&side, after)) = rest.split_first() else { return Ok(None) };
            rest = after;
            let guide = if side == 0 { None } else { Guide::take_words(side, &mut rest)? };
            if side != 0 && guide.is_none() {
                return Ok(None);
            }
            guides.push(guide.map(Arc::new));
        }
        Ok(rest.is_empty().then_some(Guidance { guides, radius }))
    }
}

/// What has changed since the state of a scene that photons were traced in.
pub(crate) struct Change<'a> {
    pub old: &'a Scene,
    /// Boxes that hold all that moved, before and after.
    pub boxes: &'a [Bounds],
    pub guidance: &'a Guidance,
}

/// The photons that came with a change, and those that went.
pub(crate) struct Difference {
    came: Grid,
    went: Grid,
    cylinder: Cylinder,
    kernel: EstimateFn,
    _memory: [Reservation; 2],
}

/// Name of what maps have in common, in error messages.
const GUIDANCE: &str = "the guides of lights";

/// Part of the paths that may meet what moved.
const MOST_MEETINGS: f64 = 0.5;

/// Part of the scene's diagonal by which boxes around what moved are wider: rounding of hits.
const MARGIN: f32 = 1e-5;

/// A block of photons, and those of them that came and went.
type Block = ((Vec<StoredPhoton>, Tally), [Vec<StoredPhoton>; 2]);

impl PhotonMap {
    /// Returns what maps of other states of the scene need; `None` if not all photons were stored, or they came from files.
    pub(crate) fn guidance(&self) -> Result<Option<Guidance>> {
        let Some(guides) = &self.guides else { return Ok(None) };
        Ok(Some(Guidance { guides: try_to_vec(guides, GUIDANCE)?, radius: self.radius() }))
    }

    /// Makes the map of a scene after a change, and finds the photons that came and went; `None` if the lights do not shine
    /// as they did, too many photons would be stored, or most paths meet what moved. Reports progress over `[from, to]` of the
    /// bar. To be called on the device's threads.
    pub(crate) fn trace_again(
        scene: &Arc<Scene>,
        params: &PhotonParams,
        change: &Change,
        progress: &Progress,
        (from, to): (f32, f32),
    ) -> Result<Option<(PhotonMap, Difference)>> {
        let start = Instant::now();
        let mut tracers =
            [Tracer::new(scene, &scene.lights(), params)?, Tracer::new(change.old, &change.old.lights(), params)?];
        for tracer in &mut tracers {
            if !tracer.emission.guide_by(&change.guidance.guides)? {
                return Ok(None);
            }
        }
        let [mut tracer, former] = tracers;
        let epsilon = |scene: &Scene| ray_epsilon(Vec3::ZERO, scene).to_bits();
        if !tracer.emission.is_like(&former.emission) || epsilon(scene) != epsilon(change.old) {
            return Ok(None);
        }
        // From a file it may be any number.
        let radii = match params.radius {
            0.0 => params.least_radius.min(scene.diagonal())..=scene.diagonal().max(f32::MIN_POSITIVE),
            given => given..=given,
        };
        tracer.thin_out(params.most_stored)?;
        if tracer.stored_part < 1.0 || !radii.contains(&change.guidance.radius) {
            return Ok(None);
        }
        let boxes = change.boxes.iter().map(|bounds| bounds.grown(MARGIN * scene.diagonal()));
        let boxes = try_collect(boxes, "boxes around what moved")?;
        let split = from + 0.95 * (to - from);
        if !tracer.blocks().is_empty() {
            // Where most paths meet what moved, two of each cost more than all are worth.
            let mut meetings = Meetings::new(&boxes);
            tracer.some(tracer.numbers(0), 0, None, Some(&mut meetings), |_, _, _| ())?;
            if meetings.photons.len() as f64 > MOST_MEETINGS * tracer.numbers(0).count() as f64 {
                return Ok(None);
            }
        }
        let stage = progress.stage("photons", from, split, tracer.blocks().len() as u64);
        let monitor = scene.device().memory();
        let account = || Account::new(monitor.clone(), params.memory_budget);
        let memory = account();
        let traced = tracer.blocks().into_par_iter().map(|block| -> Result<Block> {
            stage.check()?;
            let (block, watch) = (block as u64, Some((&stage, &memory)));
            let [mut after, mut before] = [Meetings::new(&boxes), Meetings::new(&boxes)];
            let numbers = tracer.numbers(block);
            let (stored, mut tally) = tracer.some(numbers, block, watch, Some(&mut after), |_, _, _| ())?;
            if !after.photons.is_empty() {
                let again = after.photons.iter().copied();
                let (photons, of_former) = former.some(again, block, None, Some(&mut before), |_, _, _| ())?;
                tally.rays += of_former.rays;
                memory.grow((photons.len() + after.stored.len() + before.stored.len()) * size_of::<StoredPhoton>())?;
            }
            stage.advance(1)?;
            Ok(((stored, tally), [after.stored, before.stored]))
        });
        let blocks: Vec<Block> = try_par_collect_ok(traced, "blocks of photons")?;
        let rooms = || try_with_capacity(blocks.len(), "blocks of photons");
        let (mut all, [mut came, mut went]) =
            (try_with_capacity(blocks.len(), "blocks of photons")?, [rooms()?, rooms()?]);
        for (block, [after, before]) in blocks {
            all.push(block);
            came.push(after);
            went.push(before);
        }
        let mut all = tracer.traced(all, memory)?;
        all.stats.trace_seconds = start.elapsed().as_secs_f64();
        let radius = change.guidance.radius;
        let grid = |blocks| {
            let traced = Traced { blocks, stats: PhotonStats::default(), memory: account(), guides: None };
            Grid::build(traced, radius, progress, (split, split))
        };
        let ((came, of_came), (went, of_went)) = (grid(came)?, grid(went)?);
        let map = PhotonMap::of(scene, &PhotonParams { radius, ..*params }, all, progress, split, to)?;
        let (cylinder, kernel) = (map.cylinder, estimate::kernel(scene.device().isa()));
        Ok(Some((map, Difference { came, went, cylinder, kernel, _memory: [of_came, of_went] })))
    }
}

impl Difference {
    /// Whether no photon came or went.
    pub(crate) fn is_none(&self) -> bool {
        self.came.photons.view().is_empty() && self.went.photons.view().is_empty()
    }

    /// Search radius of the estimates.
    pub(crate) fn radius(&self) -> f32 {
        self.cylinder.radius
    }

    /// By how much irradiance (W/m²) has changed at points on the sides that unit vectors point to, for as many as all three
    /// slices have; `room` is as long.
    pub(crate) fn irradiance(
        &self,
        positions: &[[f32; 3]],
        normals: &[[f32; 3]],
        room: &mut [[f32; 3]],
        out: &mut [[f32; 3]],
    ) {
        (self.kernel)(&self.came, &self.cylinder, positions, normals, out, None);
        (self.kernel)(&self.went, &self.cylinder, positions, normals, room, None);
        for (out, went) in out.iter_mut().zip(room) {
            *out = (Vec3::from(*out) - Vec3::from(*went)).to_array();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::{uniform, uniform_triangle};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};

    /// A room whose roof has a hole, with a block and a sheet that transmits light, under `lights`.
    fn room(lights: &[Light]) -> Arc<Scene> {
        let mut data = SceneData::new();
        let white = data.add_material(Material { albedo: [0.7; 3], two_sided: true, ..Default::default() }).unwrap();
        let cloth = Material { albedo: [0.3; 3], transmission: [0.4; 3], two_sided: true, ..Default::default() };
        let cloth = data.add_material(cloth).unwrap();
        let p = Vec3::new;
        let mut walls = MeshBuilder::new();
        walls.box_(Vec3::ZERO, p(8.0, 6.0, 3.0), true, white);
        let hole = walls.finish();
        let mut walls = MeshBuilder::new();
        walls.box_(p(2.0, 2.0, 3.0), p(3.5, 4.0, 3.0), true, cloth);
        data.add_mesh(hole).unwrap();
        data.add_mesh(walls.finish()).unwrap();
        let mut block = MeshBuilder::new();
        block.box_(p(1.0, 1.0, 0.0), p(1.6, 1.6, 1.2), false, white);
        data.add_mesh(block.finish()).unwrap();
        lights.iter().for_each(|&light| _ = data.add_light(light).unwrap());
        data.committed()
    }

    #[test]
    fn estimates_are_those_of_before_and_of_what_came_less_what_went() {
        let inside = Light::Point { position: Vec3::new(4.0, 3.0, 2.5), intensity: [5.0, 3.0, 1.0] };
        let outside = Light::Point { position: Vec3::new(3.0, 20.0, 1.0), intensity: [5.0, 3.0, 1.0] };
        for lights in [&[inside][..], &[inside, outside]] {
            let mut scene = room(lights);
            let params = PhotonParams { photon_count: 50_000, store_direct: false, ..Default::default() };
            let old_scene = scene.clone();
            let old = PhotonMap::trace(&scene, &params, &Progress::none()).unwrap();
            let guidance = old.guidance().unwrap().unwrap();
            let words = guidance.words().unwrap();
            assert_eq!(Guidance::from_words(&words).unwrap(), Some(guidance.clone()));
            assert!((0..words.len()).all(|end| Guidance::from_words(&words[..end]).unwrap().is_none()));
            let before: Vec<Vec3> = scene.meshes()[2].positions.to_vec();
            let after: Vec<Vec3> = before.iter().map(|&p| p + Vec3::new(0.9, 0.7, 0.0)).collect();
            Scene::refit(&mut scene, &[(2, &after)]).unwrap();
            let mut boxes = [Bounds::EMPTY; 2];
            before.iter().for_each(|&p| boxes[0].add(p));
            after.iter().for_each(|&p| boxes[1].add(p));
            let change = Change { old: &old_scene, boxes: &boxes, guidance: &guidance };
            let again = |scene: &Arc<Scene>, change: &Change| {
                let trace = || PhotonMap::trace_again(scene, &params, change, &Progress::none(), (0.0, 1.0));
                scene.device().install(trace).unwrap()
            };
            let (new, difference) = again(&scene, &change).unwrap();
            assert_eq!(new.radius(), old.radius());
            let part = difference.came.photons.view().len() as f64 / new.stats().stored as f64;
            assert!((0.01..0.6).contains(&part), "{part} of the photons came");
            let (mut changed, mut sum, mut worst) = (0, 0.0, 0.0f32);
            for i in 0..3000 {
                let at = |d| uniform(i, d, 5);
                let triangle = (at(0) * scene.triangle_count() as f32) as u32;
                let [u, v] = uniform_triangle([at(1), at(2)]);
                let [a, b, c] = scene.corners(triangle);
                let position = [(a * (1.0 - u - v) + b * u + c * v).to_array()];
                let normal = [(scene.normal(triangle) * if at(3) < 0.5 { 1.0 } else { -1.0 }).to_array()];
                let [mut room, mut by] = [[[0.0; 3]]; 2];
                difference.irradiance(&position, &normal, &mut room, &mut by);
                let [e_old, e_new] =
                    [&old, &new].map(|map| Vec3::from(map.estimate(position[0].into(), normal[0].into())));
                changed += u32::from(by[0] != [0.0; 3]);
                sum += e_new.element_sum();
                worst = worst.max((e_old + Vec3::from(by[0]) - e_new).abs().element_sum());
            }
            let mean = sum / 3000.0;
            assert!(worst < 1e-4 * mean, "{worst} of {mean}");
            assert!((300..2900).contains(&changed), "{changed} changed");
            // Nothing moved: nothing came or went.
            let (_, none) = again(&old_scene, &Change { boxes: &[], ..change }).unwrap();
            assert!(none.is_none());
            // Where a lamp shines otherwise, all may be new.
            let other = room(&[outside, inside]);
            assert!(again(&other, &Change { old: &old_scene, boxes: &boxes, guidance: &guidance }).is_none());
        }
    }
}
