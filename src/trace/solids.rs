//! Which places lie inside solids, where light does not get. A ray that leaves a surface there meets the backs of
//! one-sided surfaces: those of the solid, from within.

use super::Ray;
use crate::scene::Scene;
use glam::Vec3;

/// Whether what lies along a ray is the back of a one-sided surface. Counts the ray in `rays`, unless the scene has
/// no such surfaces.
pub(crate) fn sees_a_back(scene: &Scene, origin: Vec3, direction: Vec3, rays: &mut u64) -> bool {
    if !scene.uses().solids {
        return false;
    }
    *rays += 1;
    let hit = scene.intersect_raw(&Ray::new(origin, direction));
    if hit.is_miss() || hit.front {
        return false;
    }
    let material = scene.material(hit.triangle);
    !material.two_sided && !material.transmits()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::BuildOptions;
    use crate::device::{Device, DeviceOptions};
    use crate::progress::Progress;
    use crate::scene::shapes::MeshBuilder;
    use crate::scene::{Material, SceneData};
    use std::sync::Arc;

    /// A floor at z = 0 and what `add` puts on it, of a material with one side or two.
    fn scene(two_sided: bool, add: impl Fn(&mut MeshBuilder, u32)) -> Arc<Scene> {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided, ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        builder.quad(p(-9.0, -9.0), p(9.0, -9.0), p(9.0, 9.0), p(-9.0, 9.0), m);
        add(&mut builder, m);
        data.add_mesh(builder.finish()).unwrap();
        Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
    }

    fn asked(scene: &Scene, x: f32) -> (bool, u64) {
        let mut rays = 0;
        (sees_a_back(scene, Vec3::new(x, 0.1, 1e-4), Vec3::Z, &mut rays), rays)
    }

    #[test]
    fn below_a_box_its_back_is_seen() {
        let solid = scene(false, |b, m| b.box_(Vec3::splat(-1.0), Vec3::ONE, false, m));
        assert_eq!(asked(&solid, 0.0), (true, 1));
        assert_eq!(asked(&solid, 2.0), (false, 1));
        // Nothing is asked for in a scene without one-sided surfaces.
        let shells = scene(true, |b, m| b.box_(Vec3::splat(-1.0), Vec3::ONE, false, m));
        assert_eq!(asked(&shells, 0.0), (false, 0));
    }
}
