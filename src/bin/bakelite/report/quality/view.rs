//! What a camera sees of the light: views of bakes against one that is path traced with the library's
//! kernels, by structural similarity.

use super::ssim::ssim;
use super::texel_paths::TexelPaths;
use crate::pictures::{PRIMARY_RAYS, background, missed, receiver, render, tone_mapped};
use bakelite::direct::DirectLight;
use bakelite::io::image::auto_exposure;
use bakelite::lightmap::{Layer, Lightmap};
use bakelite::sampling::combine;
use bakelite::scene::Camera;
use bakelite::trace::PACKET_SIZE;
use bakelite::{Progress, Result};
use std::time::Instant;

/// Shadow rays per primary ray and area light of the reference.
const SHADOW_RAYS: u32 = 16;

/// A path traced view.
pub struct ViewReference {
    camera: Camera,
    pub size: [usize; 2],
    background: Vec<f32>,
    exposure: f32,
    shown: Vec<[u8; 3]>,
    /// Per pixel, of indirect light; at least as many as asked for.
    pub paths: u32,
    pub seconds: f64,
    /// Similarity of two independent halves, each with half the paths. Two views that are exact but for
    /// the noise of the whole are more alike. `None` if the view is too small.
    pub of_halves: Option<f64>,
}

impl ViewReference {
    /// Path traces a view with some `paths` per pixel.
    pub fn new(
        lightmap: &Lightmap,
        camera: Camera,
        size: [usize; 2],
        paths: u32,
        progress: &Progress,
    ) -> Result<ViewReference> {
        let start = Instant::now();
        let scene = lightmap.scene();
        let (direct, tracer) = (DirectLight::new(scene), TexelPaths::new(scene));
        let of_round = 2 * PRIMARY_RAYS * PACKET_SIZE as u32;
        let rounds = paths.div_ceil(of_round);
        let half = |seed: u32| {
            render(scene, &camera, size, seed, progress, "view", |seen| {
                let at = receiver(scene, &seen.hit);
                let e = direct.irradiance(&at, SHADOW_RAYS, combine(seen.seed, 1), &mut 0);
                Ok(e + tracer.indirect_at(&at, rounds, combine(seen.seed, 2))?)
            })
        };
        let halves = [half(1)?, half(2)?];
        let mean = |(a, b): (&[f32; 3], &[f32; 3])| std::array::from_fn(|c| 0.5 * (a[c] + b[c]));
        let whole: Vec<[f32; 3]> = halves[0].iter().zip(&halves[1]).map(mean).collect();
        let missed = missed(scene, &camera, size);
        let exposure = auto_exposure(&whole, |i| missed[i] == 0.0);
        let background = background(scene, missed);
        let [a, b] = halves.map(|half| tone_mapped(&half, &background, exposure));
        Ok(ViewReference {
            camera,
            size,
            shown: tone_mapped(&whole, &background, exposure),
            background,
            exposure,
            paths: rounds * of_round,
            seconds: start.elapsed().as_secs_f64(),
            of_halves: ssim(&a, &b, size[0]),
        })
    }

    /// Similarity of a view of the light map alone.
    pub fn of_bake(&self, lightmap: &Lightmap) -> Result<Option<f64>> {
        let image = render(lightmap.scene(), &self.camera, self.size, 0, &Progress::none(), "view", |seen| {
            Ok(lightmap.sample(Layer::Combined, seen.hit.triangle, seen.hit.front, seen.hit.u, seen.hit.v).into())
        })?;
        Ok(ssim(&tone_mapped(&image, &self.background, self.exposure), &self.shown, self.size[0]))
    }
}
