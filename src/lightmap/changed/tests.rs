use super::*;
use crate::base::error::Error;
use crate::lightmap::{Lightmap, LightmapDesc, directional};
use crate::scene::demo::shapes::MeshBuilder;
use crate::scene::{Light as Lamp, Material, Mesh, MeshMaterials, Scene, SceneData};
use glam::Vec3;
use std::sync::Arc;

/// Two rooms of 4 × 4 × 3 m with a door between them, a lamp in each, and a block in the first one: mesh 1.
fn rooms() -> (Arc<Scene>, Lightmap) {
    rooms_with(|x| Lamp::Point { position: Vec3::new(x, 1.9, 2.7), intensity: [5.0; 3] })
}

fn rooms_with(lamp: impl Fn(f32) -> Lamp) -> (Arc<Scene>, Lightmap) {
    let mut data = SceneData::new();
    let white = data.add_material(Material { albedo: [0.7; 3], ..Default::default() }).unwrap();
    let mut walls = MeshBuilder::new();
    walls.box_(Vec3::ZERO, Vec3::new(8.0, 4.0, 3.0), true, white);
    walls.box_(Vec3::new(3.9, 0.0, 0.0), Vec3::new(4.1, 2.8, 3.0), false, white);
    data.add_mesh(walls.finish()).unwrap();
    let mut block = MeshBuilder::new();
    block.box_(Vec3::new(0.6, 0.6, 0.0), Vec3::new(1.0, 1.0, 0.5), false, white);
    data.add_mesh(block.finish()).unwrap();
    for x in [2.0, 6.0] {
        data.add_light(lamp(x)).unwrap();
    }
    let scene = data.committed();
    let desc = LightmapDesc { texels_per_unit: 24.0, page_size: 512, ..Default::default() };
    let map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
    (scene, map)
}

/// With all that chooses texels by the light around them, which what is made anew must read, too.
fn params() -> BakeParams {
    let (photon_count, interpolation_contrast) = (20_000, 0.15);
    BakeParams { photon_count, interpolation_contrast, gather_rays: 16, stitch: false, seed: 4, ..Default::default() }
}

fn move_block(scene: &mut Arc<Scene>, by: Vec3) {
    let moved: Vec<Vec3> = scene.meshes()[1].positions.iter().map(|&p| p + by).collect();
    Scene::refit(scene, &[(1, &moved)]).unwrap();
}

/// Bakes what has changed with a radiance map that is made anew, so that all new light has the bits of a bake from nothing.
fn bake_exactly(map: &mut Lightmap, params: &BakeParams, keep_error: f32) -> BakeStats {
    let keep = Keep { keep_error, keeps_radiance: false, earlier: None };
    map.bake_all(params, None, None, Some(keep), &Progress::none()).unwrap()
}

fn light(map: &Lightmap) -> [Vec<Vec3>; 2] {
    let light = map.light.as_ref().unwrap();
    [light.direct.clone(), light.indirect.clone()]
}

#[test]
fn texels_keep_their_light_or_get_that_of_a_bake_from_nothing() {
    let none = Progress::none();
    let both = directional::INDIRECT | directional::DIRECT;
    for (stitch, directional, passes, is_area) in [
        (false, 0, 1, false),
        (false, both, 2, false),
        (true, 0, 1, false),
        (false, 0, 1, true),
        (false, both, 1, true),
    ] {
        let params = BakeParams { stitch, directional, passes, ..params() };
        // The direct light of areas is blurred.
        let area = |x| Lamp::Rect {
            position: Vec3::new(x, 1.5, 2.9),
            edge_u: Vec3::new(0.0, 1.0, 0.0),
            edge_v: Vec3::new(1.0, 0.0, 0.0),
            radiance: [5.0; 3],
        };
        let (mut scene, mut map) = if is_area { rooms_with(area) } else { rooms() };
        map.bake(&params, &none).unwrap();
        let old = light(&map);
        move_block(&mut scene, Vec3::new(0.6, 0.4, 0.0));
        map.follow(&scene, &none).unwrap();
        assert!(light(&map) == old, "light stays until the next bake");
        let stats = bake_exactly(&mut map, &params, 0.05);
        let changed = light(&map);
        map.bake(&params, &none).unwrap();
        let new = light(&map);
        let n = new[0].len();
        let part = stats.kept_texels as f32 / n as f32;
        assert!((0.3..0.97).contains(&part), "{part} kept");
        assert!(stitch || map.plan_text().lines().all(|line| !line.contains("has changed by less")));
        if stitch {
            // Texels at seams take light of their neighbours, kept or not.
            continue;
        }
        for (kind, what) in ["direct", "indirect"].iter().enumerate() {
            let differs = |i: usize, from: &[Vec<Vec3>; 2]| changed[kind][i] != from[kind][i];
            let neither = (0..n).filter(|&i| differs(i, &old) && differs(i, &new)).count();
            assert_eq!(neither, 0, "{what} light that is neither old nor new, {passes} passes, areas: {is_area}");
            // What is kept is much like what would be new; all of what was shadowed or lit is new.
            let mean = new[kind].iter().map(|l| l.element_sum()).sum::<f32>() / n as f32;
            let wrong = |i: &usize| (changed[kind][*i] - new[kind][*i]).abs().element_sum() / mean;
            let worst = (0..n).map(|i| wrong(&i)).fold(0.0, f32::max);
            assert!(worst < 0.25, "{what} light is wrong by {worst} of the mean");
            let old_worst =
                (0..n).map(|i| (old[kind][i] - new[kind][i]).abs().element_sum() / mean).fold(0.0, f32::max);
            assert!(old_worst > 2.0 * worst.max(0.05), "{what} light changed by {old_worst} only");
        }
    }
}

/// The light of gather texels beside what is made anew decides which texels gather for themselves. With a contrast of next to
/// nothing, noise tips it.
#[test]
fn texels_chosen_by_contrast_get_the_light_of_a_bake_from_nothing() {
    let none = Progress::none();
    for (seed, blur_radius) in [(4, 2), (5, 2), (6, 1), (7, 4)] {
        let params = BakeParams { seed, blur_radius, gather_rays: 64, interpolation_contrast: 1e-3, ..params() };
        let (mut scene, mut map) = rooms();
        map.bake(&params, &none).unwrap();
        let old = light(&map);
        move_block(&mut scene, Vec3::new(0.3, 0.2, 0.0));
        map.follow(&scene, &none).unwrap();
        bake_exactly(&mut map, &params, 0.05);
        let changed = light(&map);
        map.bake(&params, &none).unwrap();
        let new = light(&map);
        let indirect = changed[1].iter().zip(old[1].iter().zip(&new[1]));
        let neither = indirect.clone().filter(|(changed, (old, new))| changed != old && changed != new).count();
        let renewed = indirect.filter(|(changed, (old, new))| changed != old && changed == new).count();
        assert!(neither == 0 && renewed > 1000, "{neither} of {renewed} are neither old nor new");
    }
}

/// Where a lamp and photons reach texels of the radiance map as before, these keep their bits; the light is as right as with a
/// radiance map from nothing.
#[test]
fn the_radiance_map_is_kept_where_nothing_changes_it() {
    let none = Progress::none();
    let params = BakeParams { photon_count: 100_000, ..params() };
    let by = Vec3::new(0.6, 0.4, 0.0);
    let radiance = |map: &Lightmap| map.light.as_ref().unwrap().radiance.values.clone();
    let path = std::env::temp_dir().join(format!("bakelite-kept-radiance-{}", std::process::id()));
    let (mut scene, mut map) = rooms();
    map.bake(&params, &none).unwrap();
    map.save_result(&path, &none).unwrap();
    let (old, old_light) = (radiance(&map), light(&map));
    move_block(&mut scene, by);
    map.follow(&scene, &none).unwrap();
    let stats = map.bake_changed(&params, 0.05, &none).unwrap();
    let (changed, kept_light) = (radiance(&map), light(&map));
    let kept = changed.iter().zip(&old).filter(|(a, b)| a == b).count() as f64 / old.len() as f64;
    assert!((0.5..0.99).contains(&kept), "{kept} kept");
    assert!(map.plan_text().contains("texels of the radiance map (lamps and photons reach them as before)"));
    assert!(stats.kept_texels > 0 && kept_light != old_light);
    // Against the mean of many bakes: no further away than one from nothing.
    map.bake(&params, &none).unwrap();
    let (anew, new_light) = (radiance(&map), light(&map));
    map.bake(&BakeParams { seed: 99, passes: 16, ..params }, &none).unwrap();
    let right = light(&map);
    let error = |light: &[Vec<Vec3>]| {
        let squares = light[1].iter().zip(&right[1]).map(|(a, b)| f64::from((*a - *b).length_squared()));
        (squares.sum::<f64>() / right[1].len() as f64).sqrt()
    };
    let [of_kept, of_new, of_old] = [&kept_light[..], &new_light, &old_light].map(error);
    println!("{kept} kept, error {of_kept}, from nothing {of_new}, old light {of_old}");
    assert!(anew != changed && of_kept < 1.05 * of_new && of_old > 1.2 * of_new, "{of_kept} {of_new} {of_old}");
    // What was loaded knows as much as what was baked.
    let (mut scene, mut loaded) = rooms();
    loaded.load_result(&path, &none).unwrap();
    std::fs::remove_file(&path).unwrap();
    move_block(&mut scene, by);
    loaded.follow(&scene, &none).unwrap();
    loaded.bake_changed(&params, 0.05, &none).unwrap();
    assert!(radiance(&loaded) == changed);
    // Without any difference to let stand, all has the bits of a bake from nothing.
    let (mut scene, mut map) = rooms();
    map.bake(&params, &none).unwrap();
    move_block(&mut scene, by);
    map.follow(&scene, &none).unwrap();
    map.bake_changed(&params, 0.0, &none).unwrap();
    assert!(radiance(&map) == anew);
}

#[test]
fn nothing_changed_keeps_all_and_back_again_gives_the_same_light() {
    let none = Progress::none();
    let (mut scene, mut map) = rooms();
    let params = params();
    let first = map.bake_changed(&params, 0.1, &none).unwrap();
    assert_eq!(first.kept_texels, 0, "there was no light");
    let old = light(&map);
    let again = map.bake_changed(&params, 0.0, &none).unwrap();
    assert_eq!(again.kept_texels as usize, old[0].len());
    assert!(light(&map) == old);
    // With a difference of 0, all that changes is new: the way there and back ends where it began.
    let there = Vec3::new(0.2, 0.1, 0.0);
    for by in [there, -there] {
        move_block(&mut scene, by);
        map.follow(&scene, &none).unwrap();
        map.bake_changed(&params, 0.0, &none).unwrap();
    }
    let (fresh_scene, mut fresh) = rooms();
    drop(fresh_scene);
    let moved_back = scene.meshes()[1].positions[0] - Vec3::new(0.6, 0.6, 0.0);
    assert!(moved_back.length() < 1e-6);
    fresh.bake(&params, &none).unwrap();
    let (here, fresh) = (light(&map), light(&fresh));
    let mean = fresh[1].iter().map(|l| l.element_sum()).sum::<f32>() / fresh[1].len() as f32;
    let worst = here[1].iter().zip(&fresh[1]).map(|(a, b)| (*a - *b).abs().element_sum() / mean).fold(0.0, f32::max);
    assert!(worst < 0.05, "{worst}");
}

#[test]
fn a_light_that_is_set_is_seen_where_it_shines() {
    let none = Progress::none();
    let (scene, mut map) = rooms();
    let params = params();
    map.bake(&params, &none).unwrap();
    let old = light(&map);
    scene.set_light(0, Lamp::Point { position: Vec3::new(2.0, 1.9, 2.7), intensity: [10.0; 3] }).unwrap();
    let stats = map.bake_changed(&params, 0.05, &none).unwrap();
    let changed = light(&map);
    assert_eq!(stats.kept_texels, 0, "direct light is always new");
    map.bake(&params, &none).unwrap();
    let new = light(&map);
    assert!(changed[0] == new[0]);
    let kept = (0..old[1].len()).filter(|&i| changed[1][i] == old[1][i]).count();
    let renewed = (0..old[1].len()).filter(|&i| changed[1][i] == new[1][i]).count();
    assert!(kept + renewed >= old[1].len() && renewed > old[1].len() / 3, "{kept} kept, {renewed} new");
}

#[test]
fn what_moved_uncovers_texels() {
    let none = Progress::none();
    let (mut scene, mut map) = rooms();
    let buried = |map: &Lightmap| map.info().buried_texels;
    // Below the block and below the wall between the rooms.
    let before = buried(&map);
    move_block(&mut scene, Vec3::new(0.0, 0.0, 1.0));
    map.follow(&scene, &none).unwrap();
    let in_the_air = buried(&map);
    assert!(in_the_air + 50 < before && in_the_air > 0, "{in_the_air} after {before}");
    move_block(&mut scene, Vec3::new(0.5, 0.0, -1.0));
    map.follow(&scene, &none).unwrap();
    let after = buried(&map);
    assert!(after > in_the_air + 50, "{after} after {in_the_air}");
    // As if made in this state.
    let desc = map.atlas.desc.clone();
    let fresh = Lightmap::create(&scene, &desc, &none).unwrap();
    assert_eq!(fresh.info().buried_texels, after);
    let samples = |map: &Lightmap| map.atlas.map.texels.samples.clone();
    assert!(samples(&fresh) == samples(&map));
}

#[test]
fn a_surface_that_is_gone_cannot_be_followed() {
    let none = Progress::none();
    for gone in [Vec3::splat(f32::NAN), Vec3::splat(1e13), Vec3::new(1.0, 1.0, 0.0)] {
        let (mut scene, mut map) = rooms();
        map.bake(&params(), &none).unwrap();
        let before = light(&map);
        // One vertex, or all in one place.
        let moved: Vec<Vec3> = scene.meshes()[1]
            .positions
            .iter()
            .enumerate()
            .map(|(i, &p)| if i == 0 || gone.is_finite() { gone } else { p })
            .collect();
        Scene::refit(&mut scene, &[(1, &moved)]).unwrap();
        let refused = map.follow(&scene, &none);
        assert!(matches!(&refused, Err(Error::InvalidState(e)) if e.contains("mesh 1")), "{gone}: {refused:?}");
        assert!(map.before.is_none() && light(&map) == before);
        map.bake_changed(&params(), 0.1, &none).unwrap();
        assert!(light(&map) == before);
    }
}

#[test]
fn wrong_use_is_refused_and_shards_after_a_move_begin_anew() {
    let none = Progress::none();
    let (mut scene, mut map) = rooms();
    let (other, _) = rooms();
    assert!(map.follow(&other, &none).is_err());
    let params = params();
    map.bake(&params, &none).unwrap();
    for (bad, keep_error) in [
        (params, f32::NAN),
        (params, -0.1),
        (BakeParams { target_error: 0.1, ..params }, 0.1),
        (BakeParams { texel_begin: 1, ..params }, 0.1),
    ] {
        assert!(map.bake_changed(&bad, keep_error, &none).is_err());
    }
    let with_others = BakeParams { gather_rays: 8, ..params };
    assert_eq!(map.bake_changed(&with_others, 1.0, &none).unwrap().kept_texels, 0);
    move_block(&mut scene, Vec3::new(0.2, 0.0, 0.0));
    map.follow(&scene, &none).unwrap();
    let path = std::env::temp_dir().join(format!("bakelite-changed-{}", std::process::id()));
    assert!(map.save_result(&path, &none).is_err(), "the light is of before the move");
    let n = map.info().texels;
    let cancelled = map.bake_changed(&with_others, 0.1, &Progress::new(|fraction, _| fraction < 0.25));
    assert!(cancelled.is_err() && map.before.is_some());
    map.bake(&BakeParams { texel_end: n / 2, ..params }, &none).unwrap();
    let unbaked = map.light.as_ref().unwrap().state.iter().filter(|&&s| s == TexelState::Unbaked).count();
    assert_eq!(unbaked as u64, n - n / 2);
    map.bake(&BakeParams { texel_begin: n / 2, ..params }, &none).unwrap();
    let shards = light(&map);
    map.bake(&params, &none).unwrap();
    assert!(light(&map) == shards);
}

/// The rooms with the meshes that `keep` names and, last, `more` boxes; `lamp` is the power of the first lamp.
fn revised(keep: [bool; 2], more: &[Vec3], lamp: f32) -> (Arc<Scene>, Lightmap) {
    let mut data = SceneData::new();
    let white = data.add_material(Material { albedo: [0.7; 3], ..Default::default() }).unwrap();
    if keep[0] {
        let mut walls = MeshBuilder::new();
        walls.box_(Vec3::ZERO, Vec3::new(8.0, 4.0, 3.0), true, white);
        walls.box_(Vec3::new(3.9, 0.0, 0.0), Vec3::new(4.1, 2.8, 3.0), false, white);
        data.add_mesh(walls.finish()).unwrap();
    }
    if keep[1] {
        let mut block = MeshBuilder::new();
        block.box_(Vec3::new(0.6, 0.6, 0.0), Vec3::new(1.0, 1.0, 0.5), false, white);
        data.add_mesh(block.finish()).unwrap();
    }
    for &at in more {
        let mut added = MeshBuilder::new();
        added.box_(at, at + Vec3::new(0.4, 0.4, 0.6), false, white);
        data.add_mesh(added.finish()).unwrap();
    }
    for (x, intensity) in [(2.0, lamp), (6.0, 5.0)] {
        data.add_light(Lamp::Point { position: Vec3::new(x, 1.9, 2.7), intensity: [intensity; 3] }).unwrap();
    }
    let scene = data.committed();
    let desc = LightmapDesc { texels_per_unit: 24.0, page_size: 512, ..Default::default() };
    let map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
    (scene, map)
}

/// Bakes `map` with what it can keep of `earlier`, and from nothing; returns the kept part of its texels, and the worst
/// differences of direct and indirect light, relative to their means.
fn revise(earlier: &Lightmap, map: &mut Lightmap, params: &BakeParams, keep_error: f32) -> (f32, [f32; 2]) {
    let none = Progress::none();
    let stats = map.bake_changed_from(earlier, params, keep_error, &none).unwrap();
    let kept = light(map);
    map.bake(params, &none).unwrap();
    let new = light(map);
    let n = new[0].len() as f32;
    let worst = [0, 1].map(|kind| {
        let mean = new[kind].iter().map(|l| l.element_sum()).sum::<f32>() / n;
        let difference = |(a, b): (&Vec3, &Vec3)| (*a - *b).abs().element_sum() / mean;
        kept[kind].iter().zip(&new[kind]).map(difference).fold(0.0, f32::max)
    });
    (stats.kept_texels as f32 / n, worst)
}

#[test]
fn a_new_light_map_keeps_light_where_meshes_were_added_and_removed() {
    let none = Progress::none();
    let params = params();
    let (_, mut first) = revised([true, true], &[], 5.0);
    first.bake(&params, &none).unwrap();
    // The same scene once more: nothing is new.
    let (_, mut same) = revised([true, true], &[], 5.0);
    let (kept, worst) = revise(&first, &mut same, &params, 0.0);
    assert_eq!((kept, worst), (1.0, [0.0; 2]));
    // A box more in the first room: the second one keeps its light.
    let (_, mut more) = revised([true, true], &[Vec3::new(2.4, 2.0, 0.0)], 5.0);
    let (kept, worst) = revise(&first, &mut more, &params, 0.05);
    assert!((0.3..0.95).contains(&kept), "{kept} kept");
    // Charts lie elsewhere on their pages, and points of texels differ by rounding.
    assert!(worst[0] < 1e-6, "direct light is wrong by {}", worst[0]);
    assert!(worst[1] < 0.25, "indirect light is wrong by {}", worst[1]);
    // Without it again: where it stood, light is back.
    let (_, mut less) = revised([true, true], &[], 5.0);
    let (kept, worst) = revise(&more, &mut less, &params, 0.05);
    assert!((0.3..0.95).contains(&kept), "{kept} kept");
    assert!(worst[0] < 1e-6 && worst[1] < 0.25, "{worst:?}");
    // A mesh that others follow has gone: they have other numbers of triangles, charts and texels.
    let at = Vec3::new(6.0, 2.0, 0.0);
    let (_, mut three) = revised([true, true], &[at], 5.0);
    three.bake(&params, &none).unwrap();
    let (_, mut two) = revised([true, false], &[at], 5.0);
    two.bake_changed_from(&three, &params, 0.05, &none)
        .map(|stats| {
            let kept = stats.kept_texels as f32 / two.info().texels as f32;
            assert!((0.3..0.95).contains(&kept), "{kept} kept");
        })
        .unwrap();
    let of_change = light(&two);
    let [of_nothing, of_seed] = [params.seed, params.seed + 1].map(|seed| {
        two.bake(&BakeParams { seed, ..params }, &none).unwrap();
        light(&two)
    });
    // Light of either has noise of its own where what is seen differs a little, but no more than another seed brings.
    let rms = |a: &[Vec3], b: &[Vec3]| {
        a.iter().zip(b).map(|(a, b)| f64::from((*a - *b).length_squared())).sum::<f64>().sqrt()
            / (a.len() as f64).sqrt()
    };
    let noise = rms(&of_nothing[1], &of_seed[1]);
    let difference = rms(&of_change[1], &of_nothing[1]);
    assert!(difference > 0.0 && difference < noise, "{difference} of {noise}");
    // Direct light is the same but for rounding: other numbers order the same sums otherwise.
    let worst = of_change[0].iter().zip(&of_nothing[0]).map(|(a, b)| (*a - *b).length() / b.length().max(1.0));
    assert!(worst.fold(0.0, f32::max) < 1e-6);
    // Another lamp: direct light is new everywhere.
    let (_, mut lit) = revised([true, true], &[], 2.0);
    let (kept, worst) = revise(&first, &mut lit, &params, 0.05);
    assert_eq!((kept, worst[0]), (0.0, 0.0));
}

/// A block behind the wall, described first, goes: all triangles, charts and texels have other numbers.
#[test]
fn what_stays_draws_the_same_random_numbers() {
    let none = Progress::none();
    let params = params();
    let rooms = |with_block: bool| {
        let (scene, _) = revised([true, false], &[], 5.0);
        let mut data = SceneData::new();
        let white = data.add_material(scene.materials()[0]).unwrap();
        if with_block {
            let mut block = MeshBuilder::new();
            block.box_(Vec3::new(0.6, 0.6, 0.0), Vec3::new(1.0, 1.0, 0.5), false, white);
            data.add_mesh(block.finish()).unwrap();
        }
        data.add_mesh(scene.meshes()[0].clone()).unwrap();
        for light in scene.lights().iter() {
            data.add_light(*light).unwrap();
        }
        let desc = LightmapDesc { texels_per_unit: 24.0, page_size: 512, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &none).unwrap()
    };
    let mut before = rooms(true);
    before.bake(&params, &none).unwrap();
    let mut after = rooms(false);
    // All light is let stand that can be kept.
    after.bake_changed_from(&before, &params, 1e9, &none).unwrap();
    let kept = light(&after);
    let [new, of_seed] = [params.seed, params.seed + 1].map(|seed| {
        after.bake(&BakeParams { seed, ..params }, &none).unwrap();
        light(&after)
    });
    let atlas = after.atlas();
    let behind = atlas.map.all().filter(|&texel| atlas.map.surface(&atlas.scene, texel).0.x > 4.2);
    let behind: Vec<usize> = behind.map(|texel| texel.index()).collect();
    let rms = |a: &[Vec3], b: &[Vec3]| {
        let squares = behind.iter().map(|&i| f64::from((a[i] - b[i]).length_squared()));
        (squares.sum::<f64>() / behind.len() as f64).sqrt()
    };
    let (difference, noise) = (rms(&kept[1], &new[1]), rms(&new[1], &of_seed[1]));
    assert!(behind.len() > 10_000 && difference < 0.2 * noise, "{difference} of {noise}, {} texels", behind.len());
}

#[test]
fn light_of_another_light_map_is_kept_with_stitched_seams_passes_and_light_by_direction() {
    let none = Progress::none();
    let directional = directional::INDIRECT | directional::DIRECT;
    for params in
        [BakeParams { stitch: true, ..params() }, BakeParams { stitch: true, directional, passes: 2, ..params() }]
    {
        let (_, mut first) = revised([true, true], &[], 5.0);
        first.bake(&params, &none).unwrap();
        let (_, mut same) = revised([true, true], &[], 5.0);
        // Of several passes the mean radiance is kept, which is not quite the first pass's.
        let keep_error = if params.passes > 1 { 0.1 } else { 0.0 };
        let stats = same.bake_changed_from(&first, &params, keep_error, &none).unwrap();
        let [a, b] = [&first, &same].map(|map| map.light.as_ref().unwrap());
        let kept = stats.kept_texels as f32 / a.direct.len() as f32;
        assert!(if params.passes > 1 { kept > 0.9 } else { kept == 1.0 }, "{kept} kept");
        assert!(a.direct == b.direct && a.indirect == b.indirect && a.spread == b.spread);
        assert!(a.directional == b.directional && a.state == b.state && a.backs == b.backs);
        // Light kept twice is that of before.
        let (_, mut again) = revised([true, true], &[], 5.0);
        again.bake_changed_from(&same, &params, keep_error, &none).unwrap();
        assert!(light(&again) == light(&first));
    }
}

/// Lights name images of skies by number: under the same one, there may be another image.
#[test]
fn light_of_another_sky_is_not_kept() {
    let none = Progress::none();
    let params = params();
    let bake = |turned: usize| {
        let mut data = SceneData::new();
        let white = data.add_material(Material { albedo: [0.7; 3], two_sided: true, ..Default::default() }).unwrap();
        let mut floor = MeshBuilder::new();
        floor.box_(Vec3::ZERO, Vec3::new(4.0, 4.0, 0.1), false, white);
        floor.box_(Vec3::new(1.0, 1.0, 0.1), Vec3::new(1.5, 1.5, 1.0), false, white);
        data.add_mesh(floor.finish()).unwrap();
        let pixels = (0..128).map(|i| [if (i + turned) % 16 == 3 { 5.0 } else { 1.0 }; 3]).collect();
        let environment = data.add_environment(crate::scene::Environment::new(16, 8, pixels).unwrap());
        data.add_light(Lamp::Sky { radiance: [1.0; 3], environment, up: Vec3::Z, rotation: 0.0 }).unwrap();
        let desc = LightmapDesc { texels_per_unit: 8.0, page_size: 256, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &none).unwrap()
    };
    let mut first = bake(0);
    first.bake(&params, &none).unwrap();
    for (turned, keeps) in [(0, true), (5, false)] {
        let mut second = bake(turned);
        let (kept, worst) = revise(&first, &mut second, &params, 0.05);
        assert_eq!(kept, if keeps { 1.0 } else { 0.0 });
        assert!(worst[0] < 1e-6, "direct light is wrong by {}", worst[0]);
    }
}

#[test]
fn what_looks_other_is_baked() {
    let none = Progress::none();
    let params = params();
    let (_, mut first) = revised([true, true], &[], 5.0);
    first.bake(&params, &none).unwrap();
    let desc = LightmapDesc { texels_per_unit: 24.0, page_size: 512, ..Default::default() };
    let rebuilt = |change: &dyn Fn(&mut Vec<Mesh>)| {
        let mut data = SceneData::new();
        let (scene, _) = revised([true, true], &[], 5.0);
        for albedo in [0.7, 0.1] {
            data.add_material(Material { albedo: [albedo; 3], ..Default::default() }).unwrap();
        }
        let mut meshes = scene.meshes().to_vec();
        change(&mut meshes);
        for mesh in meshes {
            data.add_mesh(mesh).unwrap();
        }
        for light in scene.lights().iter() {
            data.add_light(*light).unwrap();
        }
        let scene = data.committed();
        Lightmap::create(&scene, &desc, &none).unwrap()
    };
    let mut untouched = rebuilt(&|_| ());
    assert_eq!(revise(&first, &mut untouched, &params, 0.0).0, 1.0);
    // The block is dark: it and what it lights are baked, the second room is not.
    let mut dark = rebuilt(&|meshes| meshes[1].materials = MeshMaterials::One(1));
    let (kept, worst) = revise(&first, &mut dark, &params, 0.05);
    assert!((0.3..0.97).contains(&kept) && worst[0] < 1e-6 && worst[1] < 0.25, "{kept} {worst:?}");
    // One mesh of both: triangles are matched one by one.
    let mut joined = rebuilt(&|meshes| {
        let block = meshes.pop().unwrap();
        let walls = &mut meshes[0];
        let first = walls.positions.len() as u32;
        let joined = |a: &[Vec3], b: &[Vec3]| [a, b].concat();
        walls.positions = joined(&walls.positions, &block.positions).into();
        if !walls.normals.is_empty() {
            walls.normals = joined(&walls.normals, &block.normals).into();
        }
        if !walls.uvs.is_empty() {
            walls.uvs = [&walls.uvs[..], &block.uvs[..]].concat().into();
        }
        let moved: Vec<[u32; 3]> = block.indices.iter().map(|t| t.map(|i| i + first)).collect();
        walls.indices = [&walls.indices[..], &moved[..]].concat().into();
        walls.materials = MeshMaterials::One(0);
    });
    assert_eq!(revise(&first, &mut joined, &params, 0.0), (1.0, [0.0; 2]));
    // Another density, or other parameters: nothing can be kept.
    let finer = LightmapDesc { texels_per_unit: 30.0, ..desc.clone() };
    let (scene, _) = revised([true, true], &[], 5.0);
    let mut finer = Lightmap::create(&scene, &finer, &none).unwrap();
    assert_eq!(revise(&first, &mut finer, &params, 0.05).0, 0.0);
    let other = BakeParams { gather_rays: 32, ..params };
    assert_eq!(revise(&first, &mut untouched, &other, 0.05).0, 0.0);
}
