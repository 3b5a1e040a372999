//! How much surface there is in the disc of an irradiance estimate.
//!
//! The estimate divides the power in a disc by the disc's area. Where part of the disc lies beside the
//! surface – along every edge and in every corner – that is too dark, to half at an edge and to a
//! quarter in the corner of a box. So the same kernel sums, with the same filter and the same tests, the
//! area of the surfaces in the disc: points of the texels as photons whose power is their area. What it
//! finds is the part of the disc that photons could lie on, by which the estimate is to be divided
//! (Jensen 2001, section 7.5, and Hey and Purgathofer, *Advanced Radiance Estimation for Photon Map
//! Global Illumination*, 2002, divide by the area of the surfaces in the same spirit).

use super::PhotonMap;
use super::grid::Grid;
use super::trace::{Account, StoredPhoton, Traced};
use crate::error::Result;
use crate::memory::Reservation;
use crate::progress::Progress;
use glam::Vec3;

/// Estimates are raised by a factor of four at most, as the corner of a box needs: on scraps of surface that
/// hardly any photon hits, more would make single photons shine.
const LEAST: f32 = 0.25;

/// A piece of surface that photons could lie on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Piece {
    pub position: Vec3,
    /// Unit geometric normal.
    pub normal: Vec3,
    pub area: f32,
}

/// The surfaces that photons could lie on.
pub(crate) struct Coverage {
    grid: Grid,
    _memory: Reservation,
}

impl Coverage {
    /// For estimates of `map`. The pieces should be smaller than its radius.
    pub(crate) fn new(map: &PhotonMap, pieces: impl Iterator<Item = Piece>) -> Result<Coverage> {
        let photon = |p: Piece| StoredPhoton {
            position: p.position,
            direction: -p.normal,
            power: Vec3::new(p.area, 0.0, 0.0),
            normal: p.normal,
        };
        let traced = Traced {
            blocks: vec![pieces.map(photon).collect()],
            stats: Default::default(),
            memory: Account::new(map.scene.device().memory().clone(), 0),
        };
        let (grid, memory) = Grid::build(traced, map.cylinder.radius, &Progress::none(), (0.0, 1.0))?;
        Ok(Coverage { grid, _memory: memory })
    }

    /// What the estimate of `map` at a point is to be divided by, in [1/4, 1].
    pub(crate) fn at(&self, map: &PhotonMap, position: Vec3, normal: Vec3) -> f32 {
        let mut out = [[0.0; 3]];
        (map.kernel)(&self.grid, &map.cylinder, &[position.to_array()], &[normal.to_array()], &mut out);
        // More than all: surfaces that bend, or lie on one another where only one of them gets photons.
        out[0][0].clamp(LEAST, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::BuildOptions;
    use crate::device::{Device, DeviceOptions};
    use crate::photon::PhotonParams;
    use crate::scene::shapes::MeshBuilder;
    use crate::scene::{Light, Material, Scene, SceneData};

    #[test]
    fn edges_and_corners_of_a_square_get_their_light_back() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let mut data = SceneData::new();
        let m = data.add_material(Material::default()).unwrap();
        let mut builder = MeshBuilder::new();
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        builder.quad(p(0.0, 0.0), p(1.0, 0.0), p(1.0, 1.0), p(0.0, 1.0), m);
        data.add_mesh(builder.finish()).unwrap();
        data.add_light(Light::Directional { direction: -Vec3::Z, irradiance: [2.0; 3], angular_radius: 0.0 }).unwrap();
        let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
        let params = PhotonParams { photon_count: 1 << 18, radius: 0.1, ..Default::default() };
        let map = PhotonMap::trace(&scene, &params, &Progress::none()).unwrap();
        let n = 100;
        let piece = |i: usize| Piece {
            position: p((i % n) as f32 + 0.5, (i / n) as f32 + 0.5) / n as f32,
            normal: Vec3::Z,
            area: 1.0 / (n * n) as f32,
        };
        let coverage = Coverage::new(&map, (0..n * n).map(piece)).unwrap();
        for (x, y, part) in [(0.5, 0.5, 1.0), (0.0, 0.4, 0.5), (1.0, 0.0, 0.25)] {
            let (found, e) = (coverage.at(&map, p(x, y), Vec3::Z), map.estimate(p(x, y), Vec3::Z)[0]);
            assert!((found / part - 1.0).abs() < 0.05, "{x} {y}: {found}");
            assert!((e / found / 2.0 - 1.0).abs() < 0.05, "{x} {y}: {e} by {found}");
        }
        // Another surface's pieces do not count.
        assert_eq!(coverage.at(&map, p(0.5, 0.5), Vec3::X), LEAST);
    }
}
