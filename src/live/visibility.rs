//! Visibility for the camera (thesis 3.3.1): primary rays, denser in the middle of the picture, mark the blocks that
//! they hit. Marks fade over some updates, so that few rays per update suffice.

use super::LiveCamera;
use super::blocks::BlockMap;
use crate::base::memory::{try_vec, try_with_capacity};
use crate::base::sampling::{combine, sobol_2d};
use crate::lightmap::atlas::ids::ChartId;
use crate::trace::{PACKET_SIZE, Packet, RawHit};
use glam::Vec3;

/// Number of packets of primary rays per update. A packet is one column of the picture.
const PACKETS: usize = 16;

/// Factor by which a mark fades per update.
const FADING: f32 = 0.93;

/// A mark below this is dropped: after some sixty updates.
const FORGOTTEN: f32 = 0.01;

/// Visibility marks of blocks.
pub(super) struct Visibility {
    /// Strength of the mark, by block.
    marks: Vec<f32>,
    /// Blocks with a mark.
    pub seen: Vec<u32>,
    updates: u32,
}

impl Visibility {
    pub fn new(blocks: usize) -> crate::base::error::Result<Visibility> {
        // Capacity for all blocks: no update has to allocate.
        let what = "marks of what is visible";
        Ok(Visibility { marks: try_vec(blocks, what)?, seen: try_with_capacity(blocks, what)?, updates: 0 })
    }

    pub fn mark(&self, block: u32) -> f32 {
        self.marks[block as usize]
    }

    /// Traces the primary rays of one update; returns their number.
    pub fn look(&mut self, map: &BlockMap, camera: &LiveCamera) -> u64 {
        let marks = &mut self.marks;
        self.seen.retain(|&b| {
            let mark = &mut marks[b as usize];
            *mark *= FADING;
            if *mark < FORGOTTEN {
                *mark = 0.0;
            }
            *mark > 0.0
        });
        let forward = camera.forward.normalize();
        let right = forward.cross(camera.up).normalize();
        let half = (0.5 * camera.fov_y).tan();
        let down = forward.cross(right) * half;
        let right = right * half * camera.width as f32 / camera.height as f32;
        let mut hits = [RawHit::MISS; PACKET_SIZE];
        for p in 0..PACKETS {
            let mut packet = Packet::default();
            for _ in 0..PACKET_SIZE {
                // Each column has a sequence of its own: every 16th element of one sequence would leave gaps.
                let i = self.updates.wrapping_mul(PACKET_SIZE as u32) + packet.count as u32;
                let [a, b] = sobol_2d(i & 0xffff, combine(0x5eed, p as u32));
                // Position in the packet's column of the picture, in coordinates from −1 to 1.
                let u = denser_in_the_middle(((p as f32 + a) / PACKETS as f32) * 2.0 - 1.0);
                let v = denser_in_the_middle(b * 2.0 - 1.0);
                packet.push((forward + right * u + down * v).normalize());
            }
            map.atlas.scene.gather_packet(camera.position, &packet, 0.0, f32::INFINITY, &mut hits);
            for hit in &hits[..packet.count] {
                let Some(block) = block_of(map, hit) else { continue };
                let mark = &mut self.marks[block as usize];
                if *mark == 0.0 {
                    self.seen.push(block);
                }
                *mark += 1.0;
            }
        }
        self.updates = self.updates.wrapping_add(1);
        (PACKETS * PACKET_SIZE) as u64
    }
}

/// Maps [−1, 1] to itself with twice the density in the middle.
fn denser_in_the_middle(x: f32) -> f32 {
    x * (0.5 + 0.5 * x * x)
}

/// The block that a ray hit.
fn block_of(map: &BlockMap, hit: &RawHit) -> Option<u32> {
    if hit.is_miss() {
        return None;
    }
    let atlas = &map.atlas;
    let chart = atlas.charts.chart_of(hit.triangle);
    if chart == ChartId::NONE {
        return None;
    }
    let placement = atlas.gather.layout.place_of(chart, hit.front);
    if map.of_placement(placement).is_empty() {
        return None;
    }
    let at = atlas.gather.layout.texel_coord(placement, atlas.charts.local(hit.triangle, hit.u, hit.v));
    Some(map.block_at(placement, at[0].floor() as i32, at[1].floor() as i32))
}

impl LiveCamera {
    /// Checks the numbers: finite, with an extent, an aspect ratio and a field of view.
    pub fn validate(&self) -> crate::base::error::Result<()> {
        use crate::base::error::invalid_argument;
        let finite = |v: Vec3| v.is_finite();
        if !(finite(self.position) && finite(self.forward) && finite(self.up)) {
            return invalid_argument!("the camera has a coordinate that is not finite: {self:?}");
        }
        if !(self.fov_y > 0.0 && self.fov_y < std::f32::consts::PI) {
            return invalid_argument!("the camera's fov_y is {}, not in (0, π)", self.fov_y);
        }
        if self.width == 0 || self.height == 0 {
            return invalid_argument!("the camera's picture is {} × {} pixels", self.width, self.height);
        }
        let across = self.forward.normalize_or_zero().cross(self.up.normalize_or_zero());
        if !(across.length() > 1e-4) {
            return invalid_argument!("the camera's forward {} and up {} are zero or parallel", self.forward, self.up);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::ids::PlacementId;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Material, SceneData};
    use crate::trace::Ray;

    #[test]
    fn a_hit_marks_a_block_of_the_side_that_is_seen() {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        let mut builder = MeshBuilder::new();
        builder.quad(p(-1.0, -1.0), p(1.0, -1.0), p(1.0, 1.0), p(-1.0, 1.0), m);
        builder.box_(Vec3::splat(-2.0), Vec3::splat(2.0), true, m);
        data.add_mesh(builder.finish()).unwrap();
        let scene = data.committed();
        for both_sides in [true, false] {
            let desc = LightmapDesc { texels_per_unit: 16.0, both_sides, ..Default::default() };
            let lightmap = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
            let map = BlockMap::new(lightmap.atlas(), 3, 1.0, &Progress::none()).unwrap();
            let chart = lightmap.atlas().charts.chart_of(0);
            let [above, below] = [1.0, -1.0].map(|z| {
                let hit = scene.intersect_raw(&Ray::new(Vec3::new(0.3, 0.4, z), Vec3::Z * -z));
                let tile = &map.tiles[block_of(&map, &hit).unwrap() as usize];
                let near = (tile.centre - Vec3::new(0.3, 0.4, 0.0)).length();
                assert!(near < 1.5, "a block is 2 m wide, and {near} m away");
                tile.placement
            });
            let front = PlacementId::front_of(chart);
            assert_eq!(above, front);
            assert_eq!(Some(below).filter(|&b| b != front), map.atlas.gather.layout.back(chart));
            assert_eq!(above != below, both_sides);
        }
    }
}
