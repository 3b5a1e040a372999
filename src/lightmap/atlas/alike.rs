//! Objects that are unwrapped alike: instances of one mesh whose transforms differ in rotation, translation and a factor
//! of all lengths alone. One of them is unwrapped, and the others get its sheet (`super::sheets`).
//!
//! Invariant: an isometry changes neither which regions are flat or smooth nor the angles of charts, and charts have the
//! lengths of the surface.

use super::pieces::CHARTS;
use crate::base::error::Result;
use crate::base::geometry::is_valid_triangle;
use crate::base::memory::{try_collect, try_push, try_with_capacity};
use crate::base::progress::Stage;
use crate::scene::Scene;
use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// Which instance's sheet an instance gets, and the factor of its lengths. One that shows the light of another has that one's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::lightmap) struct Source {
    /// Number of the instance, at most that of this one.
    pub instance: u32,
    pub factor: f32,
}

/// Greatest difference of transforms that count as alike, as a fraction of their lengths: charts are stretched by so much.
const SAME: f64 = 1e-5;

/// Number of differently transformed instances of a mesh among which like ones are looked for.
const MOST_COMPARED: usize = 16;

/// Finds the source of each instance: one whose triangles are surfaces where the instance's are, too. (Placing them may
/// round some to a line.)
pub(in crate::lightmap) fn sources(scene: &Scene, stage: &Stage) -> Result<Vec<Source>> {
    find(scene, &|a, b| {
        stage.check()?;
        Ok(have_same_surfaces(scene, a, b))
    })
}

/// Finds the source of each instance by transforms alone, for which no triangle is looked at.
pub(in crate::lightmap) fn sources_by_transform(scene: &Scene) -> Result<Vec<Source>> {
    find(scene, &|_, _| Ok(true))
}

/// Whether the same triangles of two instances of a mesh are valid. (What the build skips is the mesh's, and so the same.)
fn have_same_surfaces(scene: &Scene, a: u32, b: u32) -> bool {
    let [a, b] = [a, b].map(|instance| scene.object(scene.object_of_instance(instance)));
    let triangles = a.mesh().indices.len() as u32;
    let same = |t: u32| is_valid_triangle(a.corners(t)) == is_valid_triangle(b.corners(t));
    scene.device().install(|| (0..triangles).into_par_iter().with_min_len(1 << 12).all(same))
}

/// Finds the source of each instance among those of its mesh with like transforms that `has_same` accepts.
fn find(scene: &Scene, has_same: &dyn Fn(u32, u32) -> Result<bool>) -> Result<Vec<Source>> {
    let mut sources = try_with_capacity(scene.instances().len(), CHARTS)?;
    let mut known: Vec<Vec<(u32, f64, [DVec3; 2])>> = try_collect(scene.meshes().iter().map(|_| Vec::new()), CHARTS)?;
    for (number, instance) in (0..).zip(scene.instances()) {
        if let Some(of) = instance.light_of {
            sources.push(sources[of as usize]);
            continue;
        }
        let (length, shape) = shape(instance.transform.matrix3.into());
        let others = &mut known[instance.mesh as usize];
        let mut source = None;
        for &(other, of_other, its) in others.iter().rev().take(MOST_COMPARED) {
            let is_alike = (0..2).all(|i: usize| (its[i] - shape[i]).abs().max_element() <= SAME);
            if is_alike && has_same(other, number)? {
                source = Some(Source { instance: other, factor: (length / of_other) as f32 });
                break;
            }
        }
        if source.is_none() {
            try_push(others, (number, length, shape), CHARTS)?;
        }
        sources.push(source.unwrap_or(Source { instance: number, factor: 1.0 }));
    }
    Ok(sources)
}

/// The factor of lengths, and the squared lengths and products of the images of the axes without it: the same for
/// transforms that differ by a rotation.
fn shape(matrix: glam::Mat3) -> (f64, [DVec3; 2]) {
    let DMat3 { x_axis: x, y_axis: y, z_axis: z } = matrix.as_dmat3();
    let length = x.cross(y).dot(z).abs().cbrt();
    let squares = DVec3::new(x.dot(x), y.dot(y), z.dot(z));
    let products = DVec3::new(x.dot(y), y.dot(z), z.dot(x));
    (length, [squares, products].map(|v| v / (length * length)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::chart_index::ChartIndex;
    use crate::lightmap::atlas::charts::Charts;
    use crate::lightmap::atlas::charts::tests::check;
    use crate::lightmap::atlas::pieces::triangle_area;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::{Instance, Material, SceneData, shapes::MeshBuilder};
    use glam::{Affine3A, Quat, Vec3};

    /// A ball and what stands for a curved part of it, as instances with these transforms.
    fn scene(transforms: &[Affine3A]) -> std::sync::Arc<Scene> {
        described(transforms).committed()
    }

    fn described(transforms: &[Affine3A]) -> SceneData {
        let mut data = SceneData::new();
        let material = data.add_material(Material::default()).unwrap();
        let mut ball = MeshBuilder::new();
        ball.sphere(Vec3::ZERO, 1.0, 3, material);
        let mesh = data.add_mesh(ball.finish()).unwrap();
        for &transform in transforms {
            data.add_instance(Instance::new(mesh, transform)).unwrap();
        }
        data
    }

    fn at(scale: Vec3, turn: f32, x: f32) -> Affine3A {
        let turn = Quat::from_axis_angle(Vec3::new(1.0, 2.0, 2.0) / 3.0, turn);
        Affine3A::from_scale_rotation_translation(scale, turn, Vec3::X * x)
    }

    #[test]
    fn like_instances_share_an_unwrap_and_others_do_not() {
        let (even, flat) = (Vec3::ONE, Vec3::new(1.0, 0.5, 1.0));
        let scene =
            scene(&[at(even, 0.0, 0.0), at(2.0 * even, 1.0, 5.0), at(flat, 0.3, 9.0), at(3.0 * flat, 2.0, 20.0)]);
        let progress = Progress::none();
        let sources = sources(&scene, &progress.stage("unwrap", 0.0, 1.0, 1)).unwrap();
        assert_eq!(sources, sources_by_transform(&scene).unwrap());
        assert_eq!(sources.iter().map(|s| s.instance).collect::<Vec<_>>(), [0, 0, 2, 2]);
        let factors = sources.iter().map(|s| s.factor);
        assert!(factors.zip([1.0, 2.0, 1.0, 3.0]).all(|(a, b)| (a - b).abs() < 1e-5 * b), "{sources:?}");
    }

    #[test]
    fn charts_of_instances_are_whole_and_kept_once() {
        let transforms = [at(Vec3::ONE, 0.0, 0.0), at(Vec3::splat(2.0), 1.0, 5.0), at(Vec3::splat(0.5), 2.5, -4.0)];
        let scene = scene(&transforms);
        let (charts, report) = Charts::of_scene(&scene, 4.0, 256, 2, &Progress::none()).unwrap();
        check(&scene, &charts);
        assert_eq!((charts.shared.len(), charts.places.len(), charts.charts.len() % 3), (1, 3, 0));
        assert_eq!(report.unwrapped_charts as usize, charts.charts.len());
        let one = Charts::of_scene(&self::scene(&transforms[..1]), 4.0, 256, 2, &Progress::none()).unwrap().0;
        assert!(charts.bytes() < one.bytes() + 1000 * charts.places.len(), "{} {}", charts.bytes(), one.bytes());
        // Points are found at their places.
        let index = ChartIndex::new(scene.device(), &charts).unwrap();
        for t in (0..scene.triangle_count()).step_by(7) {
            let local = charts.local(t, 0.3, 0.3);
            let found = index.locate(&charts, charts.chart_of(t), local.into(), t).unwrap();
            assert!(found.triangle == t && (found.u - 0.3).abs() + (found.v - 0.3).abs() < 1e-4, "{t} {found:?}");
        }
    }

    #[test]
    fn an_instance_that_shows_the_light_of_another_has_its_charts() {
        let transforms: Vec<Affine3A> =
            (0..6).map(|i| at(Vec3::splat(1.0 + i as f32), i as f32, 40.0 * i as f32)).collect();
        let mut data = described(&transforms);
        // 4 shows 3's, and so 1's.
        for (instance, of) in [(3, 1), (4, 3), (5, 0)] {
            data.share_light(instance, of).unwrap();
        }
        assert_eq!((0..6).map(|i| data.light_of_instance(i)).collect::<Vec<_>>(), [0, 1, 2, 1, 1, 0]);
        let mut all = described(&transforms);
        all.share_light_of_meshes().unwrap();
        assert!((0..6).all(|i| all.light_of_instance(i) == 0));
        let scene = data.committed();
        let (charts, _) = Charts::of_scene(&scene, 4.0, 256, 2, &Progress::none()).unwrap();
        let (of_three, _) = Charts::of_scene(&self::scene(&transforms[..3]), 4.0, 256, 2, &Progress::none()).unwrap();
        assert_eq!((charts.charts.len(), charts.places.len()), (of_three.charts.len(), 6));
        let index = ChartIndex::new(scene.device(), &charts).unwrap();
        for instance in 0..6 {
            let (own, shown) = (scene.object_of_instance(instance), scene.light_of_instance(instance));
            let [first, shown_first] = [own, scene.object_of_instance(shown)].map(|o| scene.first_triangle(o));
            for t in (0..scene.triangles_of(own).len() as u32).step_by(7) {
                let (triangle, of_shown) = (first + t, shown_first + t);
                let chart = charts.chart_of(triangle);
                assert_eq!((chart, charts.find(triangle)), (of_three.chart_of(of_shown), Some(chart)));
                assert_eq!(charts.corners(triangle), of_three.corners(of_shown));
                assert!(charts.triangles_of(chart).any(|other| other == of_shown), "{instance} {t}");
                let local = charts.local(triangle, 0.3, 0.3);
                assert_eq!(index.locate(&charts, chart, local.into(), of_shown).unwrap().triangle, of_shown);
            }
        }
    }

    #[test]
    fn charts_of_copies_keep_their_area() {
        let scene = scene(&[at(Vec3::ONE, 0.0, 0.0), at(Vec3::splat(2.0), 1.0, 5.0), at(Vec3::splat(0.5), 2.5, -4.0)]);
        let desc = LightmapDesc { texels_per_unit: 8.0, ..Default::default() };
        let map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        let page = map.info().width as f64;
        let mut charts = Vec::new();
        for object in 1..=3 {
            let (uvs, pages) = map.object_uvs(object).unwrap();
            assert!(pages.iter().all(|p| *p == 0));
            let texels = |[a, b, c]: [[f32; 2]; 3]| {
                let [a, b, c] = [a, b, c].map(|p| glam::DVec2::from_array(p.map(f64::from)) * page);
                0.5 * (b - a).perp_dot(c - a).abs()
            };
            let in_map: f64 = uvs.iter().map(|t| texels(*t)).sum();
            let area: f64 = scene.triangles_of(object).map(|t| triangle_area(&scene, t)).sum();
            // Charts are scaled to whole texels.
            assert!((in_map / (64.0 * area) - 1.0).abs() < 0.1, "{in_map} {area}");
            charts.push(uvs);
        }
        // No two instances share texels.
        let lower = |uvs: &[[[f32; 2]; 3]]| uvs[0][0];
        assert!(lower(&charts[0]) != lower(&charts[1]) && lower(&charts[1]) != lower(&charts[2]));
    }
}
