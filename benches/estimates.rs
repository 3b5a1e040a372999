//! Irradiance estimates against those with a k-d tree, kiddo's immutable one, on one thread: the same photons, points,
//! radius, cylinder and filter, 20,000 points spread over the photons, in five alternating pairs:
//!
//!     cargo bench -p bakelite-benches --bench estimates
//!
//! The scene is the atrium with its lights, or the file that `BAKELITE_BENCH_SCENE` names, lit from its middle. The
//! tree finds the photons in the ball around the cylinder; which of them count, and how much, is decided photon by
//! photon with the library's data.

use bakelite::bvh::BuildQuality;
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::{Isa, Progress};
use common::commit_lit;
use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use std::hint::black_box;
use std::time::Instant;

const POINTS: usize = 20_000;
const PAIRS: usize = 5;

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    let scene = commit_lit(Isa::best(), BuildQuality::Default);
    let params = PhotonParams::default();
    let map = PhotonMap::trace(&scene, &params, &Progress::none()).expect("map");
    let view = map.columns();
    let vector = |columns: &[&[f32]; 3], i: usize| Vec3::new(columns[0][i], columns[1][i], columns[2][i]);
    let count = view.len();
    let places: Vec<[f32; 3]> = (0..count).map(|i| vector(&view.position, i).to_array()).collect();
    let start = Instant::now();
    let tree: ImmutableKdTree<f32, 3> = ImmutableKdTree::new_from_slice(&places).expect("tree");
    let build = start.elapsed().as_secs_f64();

    let at = |i: usize| i * (count / POINTS);
    let positions: Vec<[f32; 3]> = (0..POINTS).map(|i| places[at(i)]).collect();
    let normals: Vec<[f32; 3]> = (0..POINTS).map(|i| vector(&view.normal, at(i)).to_array()).collect();
    let radius = map.radius();
    let ball = radius * radius * (1.0 + params.half_height * params.half_height);
    let scale = 1.0 / ((1.0 - 2.0 / (3.0 * params.cone_k)) * std::f32::consts::PI * radius * radius);
    let (mut ours, mut theirs) = (vec![[0.0; 3]; POINTS], vec![[0.0; 3]; POINTS]);
    let by_tree = |out: &mut [[f32; 3]]| {
        for ((p, n), out) in positions.iter().zip(&normals).zip(out) {
            let (centre, normal) = (Vec3::from(*p), Vec3::from(*n));
            let mut sum = Vec3::ZERO;
            for found in tree.query(p).within::<SquaredEuclidean<f32>>(ball).unsorted().execute() {
                let i = found.item as usize;
                let d = (vector(&view.position, i) - centre) / radius;
                let height = d.dot(normal);
                let radial2 = d.length_squared() - height * height;
                let counts = radial2 <= 1.0
                    && height.abs() <= params.half_height
                    && vector(&view.direction, i).dot(normal) < 0.0
                    && vector(&view.normal, i).dot(normal) >= 0.5;
                if counts {
                    sum += vector(&view.power, i) * (1.0 - radial2.max(0.0).sqrt() / params.cone_k);
                }
            }
            *out = (sum * scale).to_array();
        }
    };
    let (mut rates, mut ratios) = (Vec::new(), Vec::new());
    for _ in 0..PAIRS {
        let start = Instant::now();
        map.estimate_block(&positions, &normals, black_box(&mut ours));
        let of_ours = start.elapsed().as_secs_f64();
        let start = Instant::now();
        by_tree(black_box(&mut theirs));
        let of_theirs = start.elapsed().as_secs_f64();
        rates.push(POINTS as f64 / of_ours);
        ratios.push(of_theirs / of_ours);
    }
    let mean = ours.iter().flatten().sum::<f32>() / (3 * POINTS) as f32;
    let apart = ours.iter().flatten().zip(theirs.iter().flatten()).map(|(a, b)| (a - b).abs() / (a + mean));
    println!(
        "{count} photons, radius {radius}; {}; grid {:.3} s, tree {build:.3} s",
        scene.device().isa().name(),
        map.stats().grid_seconds
    );
    println!(
        "{:.0} estimates per second, {:.2} times as many as with kiddo; largest relative difference {:.1e}",
        median(rates),
        median(ratios),
        apart.fold(0.0, f32::max)
    );
}
