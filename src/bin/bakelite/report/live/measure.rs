//! Measurements of live updates: the error of what is seen against time and rays, how time budgets
//! are kept, what an application has to fetch after each update.

use crate::pictures::PrimaryRays;
use bakelite::lightmap::{BakeParams, Layer, LayerData, Lightmap};
use bakelite::live::{Budget, Live, LiveCamera, LiveParams, LiveStats, Mode, PageRect};
use bakelite::scene::{Camera, NONE};
use bakelite::{Error, Light, Progress, Result, Scene};
use glam::{Quat, Vec3};
use std::f32::consts::TAU;
use std::time::{Duration, Instant};

/// Primary rays whose texels are compared: this many columns, rows by the picture's aspect.
const COLUMNS: usize = 160;

/// Milliseconds per update while errors are followed.
pub const FOLLOW_MS: f32 = 4.0;

/// An error is measured when time has grown by this factor since it was last.
const STEP: f64 = 1.2;

/// After so many updates with nothing to do, nothing more will come: what has not been looked at for
/// some sixty updates is forgotten, and was finished before.
const IDLE_UPDATES: u32 = 100;

/// Updates between two changes of a light on a walk.
pub const CHANGE_INTERVAL: u32 = 500;

/// How far a light is moved, in diagonals of the scene; suns are turned by as much in radians.
pub const MOVE: f32 = 0.05;

/// The modes with their names.
pub const MODES: [(Mode, &str); 3] =
    [(Mode::View, "view-based"), (Mode::Position, "position-based"), (Mode::Uniform, "uniform")];

/// The texels of the light map that primary rays hit. One that n rays hit counts n times: errors are
/// those of the picture.
pub struct Seen {
    /// Page, row and column, in order.
    texels: Vec<[u32; 3]>,
    page_size: u32,
}

impl Seen {
    /// What the camera sees on the side that the light map holds. Wants a baked light map, as a bake
    /// chooses sides.
    pub fn new(lightmap: &Lightmap, camera: &Camera, aspect: f32) -> Result<Seen> {
        let scene = lightmap.scene();
        let rows = ray_count(aspect) / COLUMNS;
        let rays = PrimaryRays::new(camera, COLUMNS, rows);
        let uvs = (0..scene.object_count())
            .map(|o| Ok([lightmap.object_back_uvs(o)?.0, lightmap.object_uvs(o)?]))
            .collect::<Result<Vec<_>>>()?;
        let size = lightmap.info().width;
        let mut texels = Vec::new();
        for ray in (0..COLUMNS * rows).filter_map(|i| rays.of_pixel(i % COLUMNS, i / COLUMNS).next()) {
            let hit = scene.intersect_raw(&ray);
            if hit.is_miss() || !lightmap.shows(hit.triangle, hit.front) {
                continue;
            }
            let (object, triangle) = scene.locate(hit.triangle);
            let (corners, pages) = &uvs[object as usize][usize::from(hit.front)];
            let (corners, page) = (&corners[triangle as usize], pages[triangle as usize]);
            if page == NONE {
                continue;
            }
            let texel = |axis: usize| {
                let [a, b, c] = corners.map(|uv| uv[axis]);
                (((a * (1.0 - hit.u - hit.v) + b * hit.u + c * hit.v) * size as f32) as u32).min(size - 1)
            };
            texels.push([page, texel(1), texel(0)]);
        }
        texels.sort_unstable();
        Ok(Seen { texels, page_size: size })
    }

    /// Rays that hit a texel.
    pub fn count(&self) -> usize {
        self.texels.len()
    }

    /// Light of the visible texels in a bake.
    pub fn of_bake(&self, lightmap: &Lightmap) -> Result<Vec<[f32; 3]>> {
        let mut values = Vec::new();
        let mut page: (u32, Vec<[f32; 3]>) = (NONE, Vec::new());
        for &[number, y, x] in &self.texels {
            if page.0 != number {
                let LayerData::Rgb(pixels) = lightmap.read(number, Layer::Combined)? else {
                    return Err(Error::Internal("combined light is not RGB".into()));
                };
                page = (number, pixels);
            }
            values.push(page.1[y as usize * self.page_size as usize + x as usize]);
        }
        Ok(values)
    }

    /// Light of the visible texels as it is shown now.
    fn of_live(&self, live: &Live) -> Result<Vec<[f32; 3]>> {
        let lod = live.params().lod_count - 1;
        let texel = |&[page, y, x]: &[u32; 3]| {
            let texel = live.read(&PageRect { page, x, y, width: 1, height: 1 }, lod, Layer::Combined)?;
            Ok(texel[0])
        };
        self.texels.iter().map(texel).collect()
    }
}

/// Primary rays for pictures of width by height.
pub fn ray_count(aspect: f32) -> usize {
    COLUMNS * ((COLUMNS as f32 / aspect) as usize).max(1)
}

/// Root of the sum of squared differences by the sum of the reference's squares.
pub fn relative_error(values: &[[f32; 3]], reference: &[[f32; 3]]) -> f64 {
    let square = |c: f32| (c as f64).powi(2);
    let differences = values.iter().flatten().zip(reference.iter().flatten()).map(|(a, b)| square(a - b));
    let squares: f64 = reference.iter().flatten().map(|&c| square(c)).sum();
    (differences.sum::<f64>() / squares).sqrt()
}

/// An error, and what it took to get there.
#[derive(Clone, Copy, Debug)]
pub struct Point {
    pub seconds: f64,
    pub rays: u64,
    pub error: f64,
}

/// Errors of one way to compute light, in the order of time.
pub struct Curve {
    pub name: &'static str,
    pub points: Vec<Point>,
}

impl Curve {
    /// The first point with at most that error.
    pub fn first_within(&self, error: f64) -> Option<&Point> {
        self.points.iter().find(|p| p.error <= error)
    }

    pub fn best(&self) -> f64 {
        self.points.iter().map(|p| p.error).fold(f64::INFINITY, f64::min)
    }
}

/// The error of a whole bake. Rays of photons and radiance map are left out, as they are in
/// [`LiveStats::total_rays`].
pub fn bake(lightmap: &mut Lightmap, params: &BakeParams, seen: &Seen, reference: &[[f32; 3]]) -> Result<Point> {
    let start = Instant::now();
    let stats = lightmap.bake(params, &Progress::none())?;
    let seconds = start.elapsed().as_secs_f64();
    let error = relative_error(&seen.of_bake(lightmap)?, reference);
    Ok(Point { seconds, rays: stats.gather.rays + stats.direct.rays, error })
}

/// The camera for updates.
pub fn live_camera(camera: &Camera, aspect: f32) -> LiveCamera {
    LiveCamera {
        position: camera.position,
        forward: camera.target - camera.position,
        up: camera.up,
        fov_y: camera.fov_y,
        width: (1080.0 * aspect) as u32,
        height: 1080,
    }
}

/// How live updates are followed.
pub struct Watch<'a> {
    pub seen: &'a Seen,
    pub camera: LiveCamera,
    /// Most time, without that of measuring.
    pub seconds: f64,
}

/// What live updates in one mode achieve.
pub struct ModeRun {
    pub from_nothing: Vec<Point>,
    pub after_move: Option<Vec<Point>>,
    /// The statistics of the first and of the last update.
    pub stats: [LiveStats; 2],
}

impl Watch<'_> {
    /// From nothing to `before`, then, if there is a moved light 0, on to `after` under that light.
    /// The scene has its light back in the end.
    pub fn run(
        &self,
        lightmap: &Lightmap,
        params: &LiveParams,
        before: &[[f32; 3]],
        after: Option<(Light, &[[f32; 3]])>,
    ) -> Result<ModeRun> {
        let start = Instant::now();
        let mut live = Live::new(lightmap, params, &Progress::none())?;
        let first = live.update(&self.camera, &Budget { milliseconds: 0.0, rays: 0, max_dirty_bytes: 0 })?;
        let (from_nothing, mut last) = self.follow(&mut live, first, start, 0, before)?;
        let mut after_move = None;
        if let Some((moved, reference)) = after {
            let scene = lightmap.scene();
            let original = scene.lights()[0];
            scene.set_light(0, moved)?;
            let start = Instant::now();
            live.light_changed(0)?;
            let rays = last.total_rays;
            last.light_pending = true;
            let followed = self.follow(&mut live, last, start, rays, reference);
            scene.set_light(0, original)?;
            let (points, stats) = followed?;
            last = stats;
            after_move = Some(points);
        }
        Ok(ModeRun { from_nothing, after_move, stats: [first, last] })
    }

    /// Updates until nothing is left to do or time is up, measuring errors at times in geometric
    /// progression. Time is counted from `start`, rays from `rays`.
    fn follow(
        &self,
        live: &mut Live,
        mut stats: LiveStats,
        start: Instant,
        rays: u64,
        reference: &[[f32; 3]],
    ) -> Result<(Vec<Point>, LiveStats)> {
        let (mut points, mut measuring, mut next, mut idle) = (Vec::new(), Duration::ZERO, 0.0, 0);
        loop {
            let seconds = (start.elapsed() - measuring).as_secs_f64();
            let is_over = seconds >= self.seconds || idle == IDLE_UPDATES;
            if seconds >= next || is_over {
                let begin = Instant::now();
                let error = relative_error(&self.seen.of_live(live)?, reference);
                points.push(Point { seconds, rays: stats.total_rays - rays, error });
                next = seconds * STEP;
                let taken = begin.elapsed();
                if stats.light_pending {
                    // Indirect light goes on being recomputed meanwhile, so the clock must go on too;
                    // then measuring may not take more than a small part of the time.
                    next = next.max(seconds + 9.0 * taken.as_secs_f64());
                } else {
                    measuring += taken;
                }
            }
            if is_over {
                return Ok((points, stats));
            }
            stats = live.update(&self.camera, &Budget { milliseconds: FOLLOW_MS, rays: 0, max_dirty_bytes: 0 })?;
            let is_idle = stats.visible_finished == 1.0 && stats.blocks_changed == 0 && !stats.light_pending;
            idle = if is_idle { idle + 1 } else { 0 };
        }
    }
}

/// What is done to light 0: the light, and in words. `None` if the scene has none.
pub fn moved_light(scene: &Scene, up: Vec3) -> Option<(Light, String)> {
    let mut light = *scene.lights().first()?;
    let (lower, upper) = scene.bounds();
    let words = match &mut light {
        Light::Point { position, .. } | Light::Spot { position, .. } | Light::Rect { position, .. } => {
            // Towards the middle, so that it stays inside.
            let inwards = (0.5 * (lower + upper) - *position).reject_from(up);
            let distance = MOVE * scene.diagonal();
            *position += inwards.normalize_or(up.any_orthonormal_vector()) * distance;
            format!("moves horizontally by {distance:.3} units, {:.0}% of the scene's diagonal", 100.0 * MOVE)
        }
        Light::Directional { direction, .. } => {
            let across = direction.cross(up).normalize_or(up.any_orthonormal_vector());
            *direction = direction.normalize() + MOVE * across;
            format!("turns by {:.1} degrees, as it has no place to move from", MOVE.to_degrees())
        }
        Light::Sky { rotation, .. } => {
            *rotation += MOVE;
            format!("turns by {:.1} degrees", MOVE.to_degrees())
        }
    };
    Some((light, words))
}

/// One update of a walk.
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    /// Wall time of the call.
    pub used_ms: f64,
    /// Indirect light was being recomputed beside it.
    pub relighting: bool,
    /// Something that the camera sees was left to do.
    pub has_work: bool,
    /// What changed, as an application would fetch it.
    pub rects: usize,
    pub texels: u64,
    pub read_ms: f64,
    /// It follows a change of light, or the start.
    pub is_new: bool,
}

/// Updates with one time budget and one limit of bytes.
pub struct Walk {
    pub threads: usize,
    pub budget_ms: f32,
    pub dirty_kb: u32,
    /// Creating the live object: stages with their seconds.
    pub create: Vec<(String, f64)>,
    pub frames: Vec<Frame>,
    /// The longest call of `light_changed`.
    pub change_ms: f64,
}

/// The camera on a small circle, turning to and fro.
fn walked(camera: &LiveCamera, radius: f32, i: u32) -> LiveCamera {
    let up = camera.up.normalize();
    let right = camera.forward.cross(up).normalize();
    // At 60 updates per second: once round in 10 s, 35 degrees to each side in 30 s.
    let (round, turn) = (TAU * (i % 600) as f32 / 600.0, TAU * (i % 1800) as f32 / 1800.0);
    let ahead = up.cross(right);
    LiveCamera {
        position: camera.position + radius * (round.cos() * right + round.sin() * ahead),
        forward: Quat::from_axis_angle(up, 0.6 * turn.sin()) * camera.forward,
        ..*camera
    }
}

/// Creates a live object; returns it with the stages of that and their seconds.
fn create(lightmap: &Lightmap, params: &LiveParams) -> Result<(Live, Vec<(String, f64)>)> {
    let mut stages: Vec<(String, Instant)> = Vec::new();
    let note = |_: f32, name: &str| {
        if stages.last().is_none_or(|s| s.0 != name) {
            stages.push((name.to_owned(), Instant::now()));
        }
        true
    };
    let live = Live::new(lightmap, params, &Progress::new(note))?;
    let ends = stages.iter().skip(1).map(|s| s.1).chain([Instant::now()]).collect::<Vec<_>>();
    let seconds = |(s, end): (&(String, Instant), Instant)| (s.0.clone(), (end - s.1).as_secs_f64());
    Ok((live, stages.iter().zip(ends).map(seconds).collect()))
}

/// Walks through the scene with one budget, of milliseconds and of KB to be read (0: no limit), in frames of `frame_ms`.
/// `params` should ask for
/// so many rounds that work remains; lights that change see to that too.
pub fn walk(
    lightmap: &Lightmap,
    params: &LiveParams,
    camera: &LiveCamera,
    (budget_ms, dirty_kb): (f32, u32),
    updates: u32,
    frame_ms: f64,
) -> Result<Walk> {
    let scene = lightmap.scene();
    let radius = 0.01 * scene.diagonal();
    let (mut live, create) = create(lightmap, params)?;
    let threads = scene.device().num_threads();
    let mut walk = Walk { threads, budget_ms, dirty_kb, create, frames: Vec::new(), change_ms: 0.0 };
    let mut next_frame = Instant::now();
    for i in 0..updates {
        std::thread::sleep(next_frame.saturating_duration_since(Instant::now()));
        next_frame = Instant::now() + Duration::from_secs_f64(1e-3 * frame_ms);
        let mut is_new = i == 0;
        if i % CHANGE_INTERVAL == CHANGE_INTERVAL - 1 && !scene.lights().is_empty() {
            let start = Instant::now();
            is_new = true;
            live.light_changed(0)?;
            walk.change_ms = walk.change_ms.max(start.elapsed().as_secs_f64() * 1e3);
        }
        let camera = walked(camera, radius, i);
        let budget = Budget { milliseconds: budget_ms, rays: 0, max_dirty_bytes: 1000 * dirty_kb as u64 };
        let start = Instant::now();
        let stats = live.update(&camera, &budget)?;
        let used_ms = start.elapsed().as_secs_f64() * 1e3;
        let start = Instant::now();
        let dirty = live.take_dirty(usize::MAX)?;
        for rect in &dirty {
            std::hint::black_box(live.read(rect, live.params().lod_count - 1, Layer::Combined)?);
        }
        walk.frames.push(Frame {
            used_ms,
            relighting: stats.light_pending,
            has_work: stats.visible_finished < 1.0,
            rects: dirty.len(),
            texels: dirty.iter().map(|r| r.width as u64 * r.height as u64).sum(),
            read_ms: start.elapsed().as_secs_f64() * 1e3,
            is_new,
        });
    }
    Ok(walk)
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::bvh::BuildOptions;
    use bakelite::lightmap::LightmapDesc;
    use bakelite::scene::{builtin, builtin_camera};
    use bakelite::{Device, DeviceOptions};

    fn unbaked(name: &str) -> Lightmap {
        let device = Device::new(DeviceOptions { num_threads: 2, ..Default::default() }).unwrap();
        let data = builtin(name).unwrap();
        let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).unwrap();
        let desc = LightmapDesc { texels_per_unit: 8.0, page_size: 100, ..Default::default() };
        Lightmap::create(&scene, &desc, &Progress::none()).unwrap()
    }

    #[test]
    fn error_is_relative_to_the_reference() {
        let reference = [[3.0, 0.0, 0.0], [0.0, 4.0, 0.0]];
        assert_eq!(relative_error(&reference, &reference), 0.0);
        assert_eq!(relative_error(&[[0.0; 3]; 2], &reference), 1.0);
        assert!((relative_error(&[[3.0, 0.0, 0.0], [0.0, 4.0, 0.5]], &reference) - 0.1).abs() < 1e-12);
    }

    #[test]
    fn live_updates_end_with_the_error_of_a_bake_with_as_many_rays() {
        let mut lightmap = unbaked("cornell");
        let params = LiveParams { max_rounds: 2, photon_count: 20_000, direct_samples: 2, ..Default::default() };
        let longer = BakeParams { gather_rays: 512, ..params.bake() };
        lightmap.bake(&longer, &Progress::none()).unwrap();
        let camera = builtin_camera("cornell").unwrap();
        let seen = Seen::new(&lightmap, &camera, 16.0 / 9.0).unwrap();
        assert!(seen.count() > 2000, "{}", seen.count());
        let before = seen.of_bake(&lightmap).unwrap();

        let scene = lightmap.scene().clone();
        let (original, (moved, _)) = (scene.lights()[0], moved_light(&scene, Vec3::Y).unwrap());
        let expected = bake(&mut lightmap, &params.bake(), &seen, &before).unwrap();
        scene.set_light(0, moved).unwrap();
        lightmap.bake(&longer, &Progress::none()).unwrap();
        let after = seen.of_bake(&lightmap).unwrap();
        let expected_after = bake(&mut lightmap, &params.bake(), &seen, &after).unwrap();
        scene.set_light(0, original).unwrap();

        let camera = live_camera(&camera, 16.0 / 9.0);
        let watch = Watch { seen: &seen, camera, seconds: 60.0 };
        let params = LiveParams { mode: Mode::Position, ..params };
        let run = watch.run(&lightmap, &params, &before, Some((moved, &after))).unwrap();
        assert_eq!(scene.lights()[0], original);
        assert_eq!(run.from_nothing.last().unwrap().error, expected.error);
        let after_move = run.after_move.unwrap();
        assert_eq!(after_move.last().unwrap().error, expected_after.error);
        assert!(after_move[0].error > 2.0 * expected_after.error, "the move is seen");
    }

    #[test]
    fn a_walk_returns_to_where_it_began_and_never_goes_far() {
        let camera = live_camera(&builtin_camera("atrium").unwrap(), 2.0);
        let place = |i| walked(&camera, 0.5, i);
        assert_eq!(place(0), place(1800));
        for i in 0..1800 {
            assert!((place(i).position - camera.position).length() < 0.501);
            assert!((place(i).position - place(i + 1).position).length() < 0.01);
            assert!(place(i).forward.angle_between(camera.forward) < 0.61);
        }
    }
}
