//! Which places lie inside solids, where light does not get. A ray that leaves a surface there meets the backs of
//! one-sided surfaces: those of the solid, from within.

use super::Ray;
use crate::sampling::orthonormal_basis;
use crate::scene::Scene;
use glam::Vec3;

/// Whether a surface lies inside a solid: straight above it and to all sides are backs. (Straight above alone may be that
/// of a single sheet, such as a table top, below which there is light.) Counts the rays in `rays`: none if the scene has
/// no one-sided surfaces, one at most places.
pub(crate) fn is_buried(scene: &Scene, origin: Vec3, normal: Vec3, rays: &mut u64) -> bool {
    if !scene.uses().solids {
        return false;
    }
    let (x, y) = orthonormal_basis(normal);
    [Vec3::ZERO, x, -x, y, -y].into_iter().all(|aside| sees_a_back(scene, origin, normal + aside, rays))
}

fn sees_a_back(scene: &Scene, origin: Vec3, direction: Vec3, rays: &mut u64) -> bool {
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
    use crate::scene::shapes::MeshBuilder;
    use crate::scene::{Material, SceneData};
    use std::sync::Arc;

    /// A floor at z = 0 and what `add` puts on it, of a material with one side or two.
    fn scene(two_sided: bool, add: impl Fn(&mut MeshBuilder, u32)) -> Arc<Scene> {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided, ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        builder.quad(p(-9.0, -9.0), p(9.0, -9.0), p(9.0, 9.0), p(-9.0, 9.0), m);
        add(&mut builder, m);
        data.add_mesh(builder.finish()).unwrap();
        data.committed()
    }

    fn asked(scene: &Scene, x: f32) -> (bool, u64) {
        let mut rays = 0;
        (is_buried(scene, Vec3::new(x, 0.1, 1e-4), Vec3::Z, &mut rays), rays)
    }

    #[test]
    fn the_floor_below_a_box_is_buried_and_that_below_a_sheet_is_not() {
        let solid = scene(false, |b, m| b.box_(Vec3::splat(-1.0), Vec3::ONE, false, m));
        assert_eq!(asked(&solid, 0.0), (true, 5));
        assert_eq!(asked(&solid, 2.0), (false, 1));
        let sheet = scene(false, |b, m| {
            let p = |x: f32, y: f32| Vec3::new(x, y, 1.0);
            b.quad(p(-1.0, -1.0), p(1.0, -1.0), p(1.0, 1.0), p(-1.0, 1.0), m);
        });
        assert_eq!(asked(&sheet, 0.5), (false, 2));
        // Nothing is asked for in a scene without one-sided surfaces.
        let shells = scene(true, |b, m| b.box_(Vec3::splat(-1.0), Vec3::ONE, false, m));
        assert_eq!(asked(&shells, 0.0), (false, 0));
    }
}
