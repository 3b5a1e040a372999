//! Counts how often the sides of charts are seen from open places.
//!
//! An open place lies between two surfaces, or before one in scenes under a sun or a sky, with free space around it,
//! and not inside a solid. Random rays from such places hit a side about as often as somebody who walks about in the
//! scene sees it. How bright a lamp is does not matter, since lamps may be switched on later, but from an open place
//! light can be reached: closed boxes of two-sided surfaces, as files describe furniture, steps and walls, would be open
//! inside otherwise, and the dark there would show as rims where they stand on a floor.

use super::chart_map::{ChartMap, receiver_at};
use super::charts::Charts;
use super::ids::{ChartId, PlacementId, RadianceMap, TexelId};
use crate::base::error::Result;
use crate::base::memory::try_collect;
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Stage;
use crate::base::sampling::{combine, cosine_around, uniform, uniform_sphere};
use crate::scene::{Light, Scene};
use crate::trace::{PACKET_SIZE, Packet, RawHit, Ray};
use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

/// Number of places that are tried, per texel of the radiance map, and limits of the total: as many in the mean, since each
/// texel draws how many start there. (In a scene with more or fewer meshes nearly the same places are tried near the others.)
const TRIES_PER_TEXEL: usize = 4;
const LEAST_TRIES: usize = 1 << 10;
const MOST_TRIES: usize = 1 << 14;

/// Number of texels that a thread takes at a time.
const TEXELS: usize = 1 << 10;

/// Number of packets of rays from an open place. The first decides whether the place is open.
const PACKETS: u32 = 4;

/// Number of random walks from a place that look for light, and of their vertices. (With 8 walks Sponza has 35 charts with two
/// sides, where it has none with 4, and three times the time.)
const WALKS: u32 = 4;
const VERTICES: u32 = 8;

/// Free space around an open place: the smaller of this fraction of the scene's diagonal and this many texels of the
/// light map.
pub(in crate::lightmap) const ROOM: f32 = 0.01;
const ROOM_TEXELS: f32 = 4.0;

/// Part of the way to a lamp that must be free: it may lie in a wall or a housing.
pub(super) const NEARLY: f32 = 0.999;

/// Maximum fraction of the hits of rays from an open place that lie on backs of one-sided surfaces.
pub(super) const BACKS: f32 = 0.05;

/// Minimum fraction of the rays from an open place indoors that end on surfaces.
const ENCLOSED: f32 = 0.5;

/// Maximum distance of a place from a surface that faces the open, in outdoor scenes, as a fraction of the diagonal.
const BEFORE: f32 = 0.1;

/// A chart shows a side that is seen at least this many times as often as the other one.
const CLEARLY: u32 = 10;

/// Minimum number of expected rays from which it can be decided whether a side is hidden.
const LEAST_EXPECTED: f64 = 8.0;

/// A side that gets less than this fraction of the expected rays is hidden.
const HIDDEN: f64 = 0.02;

pub(super) const COUNTS: &str = "which sides of charts are seen";

/// Counts of how often the sides of charts are seen.
#[derive(Default)]
pub(crate) struct Seen {
    /// Numbers of rays that hit the front and the back of each chart. Empty if no chart is two-sided.
    pub counts: Vec<[u32; 2]>,
    /// Whether the front and the back of each chart are hidden: hardly any ray hit them.
    pub hidden: Vec<[bool; 2]>,
    /// Charts that cannot be seen from where the scene is looked at ([`look`](super::seen_from::look)); empty if nobody
    /// said from where.
    pub unseen: Vec<bool>,
    pub places: u64,
    pub rays: u64,
}

impl Seen {
    /// Finds open places and traces rays from them. Advances `stage` by [`work`](Self::work). To be called on the
    /// device's threads. `texel` is the width of a texel of the light map.
    pub(crate) fn count(
        scene: &Scene,
        charts: &Charts,
        radiance: &ChartMap<RadianceMap>,
        texel: f32,
        stage: &Stage,
    ) -> Result<Seen> {
        if radiance.layout.back_of.is_empty() {
            return Ok(Seen::default());
        }
        let room = (ROOM * scene.diagonal()).min(ROOM_TEXELS * texel);
        let lights = scene.lights();
        let is_lit = !lights.is_empty() || !scene.emitters().is_empty();
        let look = Look { scene, charts, radiance, room, outdoors: is_outdoors(scene), lights: &lights, is_lit };
        let counters: Vec<[AtomicU32; 2]> = try_collect(charts.charts.iter().map(|_| Default::default()), COUNTS)?;
        let (places, rays) = (AtomicU64::new(0), AtomicU64::new(0));
        let tries = (TRIES_PER_TEXEL * radiance.len()).clamp(LEAST_TRIES, MOST_TRIES);
        let tries_per_texel = tries as f64 / radiance.len() as f64;
        one_by_one((0..Self::work(radiance) as usize).into_par_iter()).try_each(|part| {
            let mut traced = 0;
            for texel in TexelId::range(part * TEXELS..radiance.len().min((part + 1) * TEXELS)) {
                // Places before both sides of a chart are independent.
                let seed = combine(radiance.seed(texel), u32::from(radiance.is_back(texel)));
                let tries = (tries_per_texel + f64::from(uniform(seed, 0, 3))) as u32;
                for number in (0..tries).map(|i| combine(seed, i)) {
                    if let Some((position, first)) = look.open_place(texel, number, &mut traced) {
                        look.around(position, &first, number, &mut traced, |chart, side| {
                            counters[chart.index()][side].fetch_add(1, Relaxed);
                        });
                        places.fetch_add(1, Relaxed);
                    }
                    stage.advance(0)?;
                }
            }
            rays.fetch_add(traced, Relaxed);
            stage.advance(1)
        })?;
        let counts = counters.into_iter().map(|of_chart| of_chart.map(AtomicU32::into_inner));
        let counts: Vec<[u32; 2]> = try_collect(counts, COUNTS)?;
        let total: u64 = counts.iter().flatten().map(|&n| u64::from(n)).sum();
        let per_texel = total as f64 / radiance.len().max(1) as f64;
        let hidden = |(chart, of_chart): (usize, &[u32; 2])| {
            let expected = radiance.texels_of(PlacementId::new(chart)).len() as f64 * per_texel;
            of_chart.map(|n| expected >= LEAST_EXPECTED && f64::from(n) < HIDDEN * expected)
        };
        let hidden = try_collect(counts.iter().enumerate().map(hidden), COUNTS)?;
        Ok(Seen { counts, hidden, unseen: Vec::new(), places: places.into_inner(), rays: rays.into_inner() })
    }

    /// Returns the number of steps by which [`count`](Self::count) advances its stage.
    pub(crate) fn work(radiance: &ChartMap<RadianceMap>) -> u64 {
        match radiance.layout.back_of.len() {
            0 => 0,
            _ => radiance.len().div_ceil(TEXELS) as u64,
        }
    }

    /// Whether a side of a chart can hardly be seen from any open place.
    pub(crate) fn is_hidden(&self, chart: ChartId, front: bool) -> bool {
        self.hidden.get(chart.index()).is_some_and(|hidden| hidden[usize::from(!front)])
    }

    /// Returns `true` if the back of a two-sided chart is seen and its front hardly ever, `false` if it is the other
    /// way round, and `None` otherwise.
    pub(crate) fn shows_back(&self, chart: ChartId) -> Option<bool> {
        let [front, back] = self.counts.get(chart.index()).copied().unwrap_or_default();
        match front.max(back) {
            0 => None,
            most if most >= CLEARLY.saturating_mul(front.min(back)) => Some(back > front),
            _ => None,
        }
    }

    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&self.counts[..]) + size_of_val(&self.hidden[..]) + self.unseen.len()
    }
}

/// Whether a sun or a sky shines.
pub(in crate::lightmap) fn is_outdoors(scene: &Scene) -> bool {
    let lights = scene.lights();
    let shines =
        |light: &Light| matches!(light, Light::Directional { .. } | Light::Sky { .. }) && light.color() != [0.0; 3];
    lights.iter().any(shines)
}

/// Returns the place of a lamp, or its middle; `None`: it is infinitely far away.
pub(super) fn middle_of(light: &Light) -> Option<Vec3> {
    match *light {
        Light::Point { position, .. } | Light::Spot { position, .. } => Some(position),
        Light::Rect { position, edge_u, edge_v, .. } => Some(position + 0.5 * (edge_u + edge_v)),
        Light::Directional { .. } | Light::Sky { .. } => None,
    }
}

/// Returns the places of all lamps, or their middles; `None`: it is infinitely far away.
pub(in crate::lightmap) fn lamps(scene: &Scene) -> Result<Vec<Option<Vec3>>> {
    try_collect(scene.lights().iter().map(middle_of), "the places of lamps")
}

/// Inputs of the search for open places.
struct Look<'a> {
    scene: &'a Scene,
    charts: &'a Charts,
    radiance: &'a ChartMap<RadianceMap>,
    room: f32,
    outdoors: bool,
    lights: &'a [Light],
    /// Whether anything shines or may shine.
    is_lit: bool,
}

impl Look<'_> {
    /// Returns a random place between a texel and another surface, if it is open, and the hits of a first packet of rays from
    /// there.
    fn open_place(
        &self,
        texel: TexelId<RadianceMap>,
        number: u32,
        rays: &mut u64,
    ) -> Option<(Vec3, [RawHit; PACKET_SIZE])> {
        let (_, from) = self.radiance.receiver(self.scene, texel, self.radiance.is_back(texel));
        let random = |dimension| uniform(number, dimension, 0);
        let direction = cosine_around(from.geometric, [random(0), random(1)]);
        let hit = self.scene.intersect_raw(&Ray::new(from.origin, direction));
        *rays += 1;
        let away = match hit.is_miss() {
            true if !self.outdoors => return None,
            true => random(2) * BEFORE * self.scene.diagonal(),
            false => (0.25 + 0.5 * random(2)) * hit.t,
        };
        if away < self.room {
            return None;
        }
        let position = from.origin + away * direction;
        let hits = self.packet(position, number, 0, rays);
        let (mut met, mut backs) = (0.0, 0.0);
        for hit in hits.iter().filter(|hit| !hit.is_miss()) {
            if hit.t < self.room {
                return None;
            }
            met += 1.0;
            backs += f32::from(u8::from(!hit.front && !self.scene.material(hit.triangle).two_sided));
        }
        let is_enclosed = self.outdoors || met >= ENCLOSED * PACKET_SIZE as f32;
        let is_open =
            is_enclosed && backs <= BACKS * met && (!self.is_lit || self.reaches_light(position, number, rays));
        is_open.then_some((position, hits))
    }

    /// Whether a random walk from a place finds light: a lamp, which may be switched off, the sun or the sky, or a surface
    /// that emits.
    fn reaches_light(&self, place: Vec3, number: u32, rays: &mut u64) -> bool {
        (0..WALKS).any(|walk| {
            let random = |vertex: u32, dimension| uniform(WALKS * vertex + walk, dimension, combine(number, 2));
            let mut at = place;
            let mut direction = uniform_sphere([random(0, 0), random(0, 1)]);
            for vertex in 1..=VERTICES {
                if self.sees_light(at, random(vertex, 2), rays) {
                    return true;
                }
                let ray = Ray::new(at, direction);
                let hit = self.scene.intersect_raw(&ray);
                *rays += 1;
                if hit.is_miss() {
                    return self.outdoors;
                }
                let material = self.scene.material(hit.triangle);
                if material.is_emissive() {
                    return true;
                }
                let passes = material.transmits() && random(vertex, 3) < 0.5;
                let (_, receiver) = receiver_at(self.scene, hit.triangle, [hit.u, hit.v], hit.front == passes);
                at = receiver.origin;
                direction = cosine_around(receiver.geometric, [random(vertex, 0), random(vertex, 1)]);
            }
            false
        })
    }

    /// Whether nothing lies between a point and a random light.
    fn sees_light(&self, at: Vec3, random: f32, rays: &mut u64) -> bool {
        let to = |lamp: Vec3| Ray::new(at, lamp - at).within(0.0, NEARLY);
        let Some(light) = self.lights.get((random * self.lights.len() as f32) as usize) else { return false };
        let ray = match (light, middle_of(light)) {
            (_, Some(lamp)) => to(lamp),
            (&Light::Directional { direction, .. }, _) => Ray::new(at, -direction),
            // Walks find the sky where they leave the scene.
            _ => return false,
        };
        *rays += 1;
        !self.scene.occluded(&ray)
    }

    /// Traces packet `k` of rays from a place in all directions.
    fn packet(&self, position: Vec3, number: u32, k: u32, rays: &mut u64) -> [RawHit; PACKET_SIZE] {
        let (mut packet, mut hits) = (Packet::default(), [RawHit::MISS; PACKET_SIZE]);
        for i in 0..PACKET_SIZE as u32 {
            let index = k * PACKET_SIZE as u32 + i;
            packet.push(uniform_sphere([0, 1].map(|d| uniform(index, d, combine(number, 1)))));
        }
        self.scene.gather_packet(position, &packet, 0.0, f32::INFINITY, &mut hits);
        *rays += PACKET_SIZE as u64;
        hits
    }

    /// Calls `see` with each chart that a ray from a place hits, and 0 for its front or 1 for its back.
    fn around(
        &self,
        position: Vec3,
        first: &[RawHit; PACKET_SIZE],
        number: u32,
        rays: &mut u64,
        mut see: impl FnMut(ChartId, usize),
    ) {
        let mut see_all = |hits: &[RawHit; PACKET_SIZE]| {
            for hit in hits.iter().filter(|hit| !hit.is_miss()) {
                let chart = self.charts.chart_of(hit.triangle);
                if chart != ChartId::NONE {
                    see(chart, usize::from(!hit.front));
                }
            }
        };
        see_all(first);
        for k in 1..PACKETS {
            see_all(&self.packet(position, number, k, rays));
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::base::progress::Progress;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};
    use glam::Vec3;

    /// Rays that saw the fronts and the backs of a mesh, and whether some fronts and some backs are hidden.
    type SeenOfMesh = ([u32; 2], [bool; 2]);

    /// What is seen of a room of sheets, of a wardrobe in it, and of a hollow wall of 4 cm.
    fn room() -> ([SeenOfMesh; 3], Lightmap) {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let p = Vec3::new;
        for [lower, upper] in [
            [p(0.0, 0.0, 0.0), p(4.0, 3.0, 4.0)],
            [p(0.5, 0.8, 0.5), p(1.5, 2.0, 1.5)],
            [p(2.4, 0.3, 0.3), p(2.44, 2.7, 2.0)],
        ] {
            let mut b = MeshBuilder::new();
            b.box_(lower, upper, false, m);
            data.add_mesh(b.finish()).unwrap();
        }
        let desc = LightmapDesc { texels_per_unit: 20.0, ..Default::default() };
        let lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let atlas = lightmap.atlas();
        let of_mesh = |mesh: u32| {
            let (mut counts, mut hidden) = ([0; 2], [false; 2]);
            let first = atlas.scene.first_triangle(mesh);
            for chart in (first..first + 12).map(|t| atlas.charts.chart_of(t)) {
                for side in [0, 1] {
                    counts[side] += atlas.seen.counts[chart.index()][side];
                    hidden[side] |= atlas.seen.is_hidden(chart, side == 0);
                }
            }
            (counts, hidden)
        };
        ([0, 1, 2].map(of_mesh), lightmap)
    }

    #[test]
    fn rooms_are_seen_from_inside_and_solid_things_from_outside() {
        let ([room, wardrobe, wall], lightmap) = room();
        assert!(room.0[1] > 1000 && room.0[0] == 0 && !room.1[1], "{room:?}");
        // There is room for somebody in the wardrobe.
        assert!(wardrobe.0[0] > 500 && wardrobe.0[1] > 100 && wardrobe.1 == [false; 2], "{wardrobe:?}");
        // Nobody fits into the wall.
        assert!(wall.0[0] > 500 && wall.0[1] == 0 && wall.1 == [false, true], "{wall:?}");
        let (atlas, info) = (lightmap.atlas(), lightmap.info());
        let first = atlas.scene.first_triangle(1);
        let both = atlas
            .map
            .layout
            .back_of
            .iter()
            .all(|&c| (first..first + 12).contains(&atlas.charts.triangles_of(c).next().unwrap()));
        assert!(both && info.both_sided_charts > 0, "the wardrobe alone has two places");
    }

    /// Two closed boxes in a room of sheets, all lamps switched off.
    #[test]
    fn closed_boxes_without_a_lamp_are_not_open() {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let p = Vec3::new;
        for [lower, upper] in [
            [p(0.0, 0.0, 0.0), p(4.0, 3.0, 4.0)],
            [p(0.5, 0.0, 0.5), p(1.5, 0.8, 1.5)],
            [p(2.5, 0.0, 2.5), p(3.5, 2.0, 3.5)],
        ] {
            let mut b = MeshBuilder::new();
            b.box_(lower, upper, false, m);
            data.add_mesh(b.finish()).unwrap();
        }
        for position in [p(0.5, 2.5, 3.5), p(3.0, 1.8, 3.0)] {
            data.add_light(Light::Point { position, intensity: [0.0; 3] }).unwrap();
        }
        let desc = LightmapDesc { texels_per_unit: 20.0, ..Default::default() };
        let lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let atlas = lightmap.atlas();
        let inside = |mesh: u32| {
            let first = atlas.scene.first_triangle(mesh);
            let charts = (first..first + 12).map(|t| atlas.charts.chart_of(t));
            charts.map(|chart| atlas.seen.counts[chart.index()][1]).sum::<u32>()
        };
        let [room, box_, with_a_lamp] = [0, 1, 2].map(inside);
        assert!(room > 1000 && box_ == 0 && with_a_lamp > 100, "{room}, {box_}, {with_a_lamp}");
    }
}
