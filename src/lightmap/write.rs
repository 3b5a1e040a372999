//! Replaces light of a baked light map by the caller's, for example by denoised light: all texels of some layers at
//! once. Texels that nobody can see take the new light of the texel that they take their sample from, and seams are
//! stitched anew, if the bake stitched them.

use super::atlas::ids::LightTexel;
use super::plan::Plan;
use super::seams::Stitch;
use super::{BakeParams, BakeStats, Layer, Light, Lightmap, TexelState};
use crate::base::directional::Directional;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_collect, try_vec};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::scene::MOST_LIGHT;
use glam::Vec3;
use rayon::prelude::*;

/// Texels per task.
const BLOCK: usize = 1 << 12;

/// New light of all texels; empty where the old stays.
#[derive(Default)]
struct New {
    direct: Vec<Vec3>,
    indirect: Vec<Vec3>,
    directional: Vec<Directional>,
}

impl New {
    /// Swaps the new light with that of a light map.
    fn swap(&mut self, light: &mut Light) {
        swap(&mut self.direct, &mut light.direct);
        swap(&mut self.indirect, &mut light.indirect);
        swap(&mut self.directional, &mut light.directional);
    }
}

fn swap<T>(new: &mut Vec<T>, old: &mut Vec<T>) {
    if !new.is_empty() {
        std::mem::swap(new, old);
    }
}

impl Lightmap {
    /// Replaces `layers` of light: `value` returns the new value of a layer, by its place in the list, at a page, column
    /// and row. It is asked for texels that are [valid](Layer::Validity) only. Layers: [`Layer::Direct`],
    /// [`Layer::Indirect`] and, after a bake with light by direction, [`Layer::L0`] and [`Layer::L1X`] to
    /// [`Layer::L1Z`], where L1 that is longer than L0 is shortened. Values must be finite and at most 1e30, and ≥ 0 but
    /// for L1. All texels must have been baked. [`Layer::Radiance`], [`Layer::Error`] and the difference of
    /// [halves](super::Half) stay those of the bake. A call that fails changes nothing.
    pub fn write(
        &mut self,
        layers: &[Layer],
        value: impl Fn(usize, u32, u32, u32) -> [f32; 3] + Sync,
        progress: &Progress,
    ) -> Result<()> {
        let device = self.atlas.scene.device().clone();
        let mut new = device.run(progress, || self.new_light(layers, &value, progress))?;
        let Some(mut light) = self.light.take() else { return Err(Error::Internal("no light".into())) };
        let mut old_stitch = light.stitch.take();
        if let Some(stitch) = &mut old_stitch {
            stitch.swap(&mut light);
        }
        new.swap(&mut light);
        let stitched = device.run(progress, || self.stitch_written(&light, old_stitch.is_some(), progress));
        match stitched {
            Ok((plan, mut stitch)) => {
                if let Some(stitch) = &mut stitch {
                    stitch.swap(&mut light);
                }
                light.stitch = stitch;
                (self.plan, self.light) = (plan, Some(light));
                Ok(())
            }
            Err(e) => {
                new.swap(&mut light);
                if let Some(stitch) = &mut old_stitch {
                    stitch.swap(&mut light);
                }
                light.stitch = old_stitch;
                self.light = Some(light);
                Err(e)
            }
        }
    }

    /// Stitches the seams of new light of all texels, if the bake did.
    fn stitch_written(&self, light: &Light, was_stitched: bool, progress: &Progress) -> Result<(Plan, Option<Stitch>)> {
        let (mut plan, mut stats) = (light.plan.clone(), BakeStats::default());
        let stitch = light.origin.map_or(was_stitched, |o| o.params.stitch);
        let (all, params) = (0..self.atlas.map.len(), BakeParams { stitch, ..Default::default() });
        let stitch = self.stitch(light, &all, &params, &mut plan, &mut stats, progress)?;
        Ok((plan, stitch))
    }

    /// Collects and checks the new light.
    fn new_light(
        &self,
        layers: &[Layer],
        value: &(impl Fn(usize, u32, u32, u32) -> [f32; 3] + Sync),
        progress: &Progress,
    ) -> Result<New> {
        let light = self.light()?;
        if light.state.contains(&TexelState::Unbaked) {
            return Err(Error::InvalidState("some texels of the light map have not been baked yet".into()));
        }
        if let Some((place, layer)) = (0..).zip(layers).find(|(i, layer)| layers[..*i].contains(layer)) {
            return invalid_argument!("layer {place} is {layer:?}, as an earlier one is");
        }
        let stage = progress.stage("new light", 0.0, 0.5, (layers.len() * light.state.len()) as u64);
        let mut new = New::default();
        for (place, &layer) in layers.iter().enumerate() {
            if layer.is_directional() && !layer.is_ratio() && light.directional.is_empty() {
                return Err(Error::InvalidState("the light map was baked without light by direction".into()));
            }
            let least = match layer {
                Layer::Direct | Layer::Indirect | Layer::L0 => 0.0,
                Layer::L1X | Layer::L1Y | Layer::L1Z => -MOST_LIGHT,
                _ => return invalid_argument!("layer {place} is {layer:?}, which cannot be written"),
            };
            let mut values = try_vec(light.state.len(), "new light")?;
            values.par_chunks_mut(BLOCK).enumerate().try_each(|(block, values)| {
                for (i, new) in (block * BLOCK..).zip(values.iter_mut()) {
                    let (page, x, y) = self.written_place(LightTexel::new(i));
                    *new = Vec3::from(value(place, page, x, y));
                    if !(new.cmpge(Vec3::splat(least)).all() && new.cmple(Vec3::splat(MOST_LIGHT)).all()) {
                        return invalid_argument!("{layer:?} is {new} at texel ({x}, {y}) of page {page}");
                    }
                }
                stage.advance(values.len() as u64)
            })?;
            let part = match layer {
                Layer::Direct => {
                    new.direct = values;
                    continue;
                }
                Layer::Indirect => {
                    new.indirect = values;
                    continue;
                }
                Layer::L0 => |d: &mut Directional, v| d.l0 = v,
                Layer::L1X => |d: &mut Directional, v| d.l1[0] = v,
                Layer::L1Y => |d: &mut Directional, v| d.l1[1] = v,
                _ => |d: &mut Directional, v| d.l1[2] = v,
            };
            if new.directional.is_empty() {
                new.directional = self.former_directional(light)?;
            }
            new.directional.iter_mut().zip(values).for_each(|(d, v)| part(d, v));
        }
        new.directional.par_iter_mut().with_min_len(BLOCK).each(|d| {
            if !d.is_possible() {
                *d = d.valid();
            }
        });
        Ok(new)
    }

    /// Returns a copy of the light by direction, without stitching.
    fn former_directional(&self, light: &Light) -> Result<Vec<Directional>> {
        let mut copy = try_collect(light.directional.iter().copied(), "new light")?;
        if let Some(stitch) = &light.stitch {
            stitch.former_directional(&mut copy);
        }
        Ok(copy)
    }

    /// Returns page, column and row of the texel whose new light a texel takes.
    fn written_place(&self, texel: LightTexel) -> (u32, u32, u32) {
        let (atlas, map) = (&self.atlas, &self.atlas.map);
        let placement = map.placement_of(&atlas.charts, texel);
        let place = &map.layout[placement];
        let (mut x, mut y) = map.position(texel);
        if atlas.buried.get(texel.index()) == Some(&true) {
            let sample = &map[texel];
            let at = map.layout.texel_coord(placement, atlas.charts.local(sample.triangle, sample.u, sample.v));
            // Coordinates are not negative, so truncation rounds down.
            let source = (at[0] as i32, at[1] as i32);
            if map.at(placement, source.0, source.1).is_some() {
                (x, y) = source;
            }
        }
        (place.page, x as u32, y as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::error::Error;
    use crate::lightmap::{BakeParams, Half, LayerData, LightmapDesc, directional};
    use crate::scene::builtin;

    const PARAMS: BakeParams = BakeParams {
        photon_count: 5_000,
        max_bounces: 0,
        gather_rays: 16,
        radius: 0.0,
        near_hits: 0.0,
        interpolation_error: 1.0,
        interpolation_contrast: 0.15,
        own_rays: 0,
        blur_radius: 0,
        direct_samples: 4,
        seed: 3,
        memory_budget: 0,
        texel_begin: 0,
        texel_end: 0,
        stitch: true,
        directional: directional::INDIRECT,
        passes: 2,
        target_error: 0.0,
    };

    const WRITTEN: [Layer; 6] = [Layer::Indirect, Layer::Direct, Layer::L0, Layer::L1X, Layer::L1Y, Layer::L1Z];

    fn atrium(params: &BakeParams) -> Lightmap {
        let scene = builtin("atrium").unwrap().committed();
        let desc = LightmapDesc { texels_per_unit: 3.0, page_size: 256, ..Default::default() };
        let mut map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        map.bake(params, &Progress::none()).unwrap();
        map
    }

    /// All pages of a layer.
    fn read(map: &Lightmap, layer: Layer) -> Vec<[f32; 3]> {
        let page = |page| match map.read(page, layer).unwrap() {
            LayerData::Rgb(v) => v,
            LayerData::Scalar(v) => v.into_iter().map(|x| [x; 3]).collect(),
            LayerData::Integer(_) => panic!("{layer:?} is no light"),
        };
        (0..map.info().page_count).flat_map(page).collect()
    }

    fn bits(map: &Lightmap) -> Vec<u32> {
        let values = WRITTEN.iter().flat_map(|&layer| read(map, layer));
        values.flatten().map(f32::to_bits).collect()
    }

    /// Writes what was read from layers of all pages.
    fn write(map: &mut Lightmap, layers: &[Layer], from: &[Vec<[f32; 3]>], progress: &Progress) -> Result<()> {
        let size = map.info().width;
        map.write(layers, |layer, page, x, y| from[layer][((page * size + y) * size + x) as usize], progress)
    }

    #[test]
    fn light_that_was_read_before_stitching_gives_the_bits_of_a_bake() {
        let mut map = atrium(&PARAMS);
        let plain = atrium(&BakeParams { stitch: false, ..PARAMS });
        let (stitched, unstitched) = (bits(&map), bits(&plain));
        assert!(stitched != unstitched && map.light.as_ref().unwrap().stitch.is_some());
        let mut from = WRITTEN.map(|layer| read(&plain, layer));
        // What is not covered, or inside of solids, is not looked at.
        let validity = read(&plain, Layer::Validity);
        for values in &mut from {
            values.iter_mut().zip(&validity).filter(|(_, v)| v[0] < 1.0).for_each(|(v, _)| *v = [f32::NAN; 3]);
        }
        write(&mut map, &WRITTEN, &from, &Progress::none()).unwrap();
        let (now, hidden) = (bits(&map), map.light.as_ref().unwrap().state.contains(&TexelState::Hidden));
        assert!(hidden, "no texel of the atrium is inside of something");
        // The light of texels inside of solids was interpolated for their own places by the bake.
        let texels = |bits: &[u32]| -> Vec<[u32; 3]> {
            let all = bits.chunks_exact(3).map(|t| [t[0], t[1], t[2]]);
            let valid = validity.iter().cycle().map(|v| v[0] == 1.0);
            all.zip(valid).filter(|(_, is_valid)| *is_valid).map(|(t, _)| t).collect()
        };
        assert!(texels(&now) == texels(&stitched), "seams are not as after the bake");
        // The same once more: the light before the stitching is kept.
        write(&mut map, &WRITTEN, &from, &Progress::none()).unwrap();
        assert!(bits(&map) == now);
    }

    #[test]
    fn written_light_is_read_sampled_saved_and_padded() {
        let mut map = atrium(&BakeParams { stitch: false, ..PARAMS });
        let size = map.info().width;
        // A value of its own for each texel.
        let value = |page: u32, x: u32, y: u32| [1.0 + page as f32, 1.0 + x as f32, 1.0 + y as f32];
        map.write(&[Layer::Indirect], |_, page, x, y| value(page, x, y), &Progress::none()).unwrap();
        let direct = read(&map, Layer::Direct);
        let (indirect, combined) = (read(&map, Layer::Indirect), read(&map, Layer::Combined));
        let validity = read(&map, Layer::Validity);
        let charts: Vec<u32> = (0..map.info().page_count)
            .flat_map(|page| match map.read(page, Layer::Chart).unwrap() {
                LayerData::Integer(v) => v,
                _ => panic!("numbers"),
            })
            .collect();
        let mut repeated = 0;
        for (i, texel) in indirect.iter().enumerate() {
            let (page, y, x) = (i as u32 / (size * size), i as u32 / size % size, i as u32 % size);
            assert_eq!(charts[i] == crate::scene::NONE, validity[i][0] == 0.0);
            if validity[i][0] == 1.0 {
                assert_eq!(*texel, value(page, x, y));
                assert_eq!(Vec3::from(combined[i]), Vec3::from(direct[i]) + Vec3::from(*texel));
            } else if validity[i][0] > 0.0 {
                let from = ((texel[2] - 1.0) as u32 * size + (texel[1] - 1.0) as u32) as usize;
                let from = (page * size * size) as usize + from;
                assert!(validity[from][0] == 1.0 && charts[from] == charts[i], "{texel:?} at {x}, {y}");
                repeated += 1;
            }
        }
        assert!(repeated > 1000, "{repeated}");
        let path = std::env::temp_dir().join(format!("bakelite-written-{}", std::process::id()));
        map.save_result(&path, &Progress::none()).unwrap();
        let mut loaded = atrium(&PARAMS);
        loaded.load_result(&path, &Progress::none()).unwrap();
        std::fs::remove_file(&path).unwrap();
        assert!(bits(&loaded) == bits(&map) && read(&loaded, Layer::Error) == read(&map, Layer::Error));
        // A bake begins anew.
        map.bake(&PARAMS, &Progress::none()).unwrap();
        assert!(bits(&map) == bits(&atrium(&PARAMS)));
    }

    #[test]
    fn a_call_that_fails_or_is_cancelled_changes_nothing() {
        let mut map = atrium(&PARAMS);
        let before = bits(&map);
        let refused = |map: &mut Lightmap, layers: &[Layer], value: [f32; 3], part: &str| {
            let e = map.write(layers, |_, _, _, _| value, &Progress::none()).unwrap_err().to_string();
            assert!(e.contains(part), "{e}");
            assert!(bits(map) == before, "{part}");
        };
        refused(&mut map, &[Layer::Combined], [1.0; 3], "Combined, which cannot be written");
        refused(&mut map, &[Layer::RatioX], [0.0; 3], "RatioX, which cannot be written");
        refused(&mut map, &[Layer::L0, Layer::L0], [1.0; 3], "as an earlier one");
        refused(&mut map, &[Layer::Indirect], [1.0, -1e-9, 1.0], "Indirect is [1, -0.000000001, 1] at texel");
        refused(&mut map, &[Layer::Direct], [1.0, f32::NAN, 1.0], "Direct is");
        refused(&mut map, &[Layer::L1X], [1.0, f32::INFINITY, 1.0], "L1X is");
        let from = WRITTEN.map(|layer| read(&map, layer));
        let mut cancelled = 0;
        for after in 0.. {
            let calls = std::sync::atomic::AtomicU32::new(0);
            let progress = Progress::new(|_, _| calls.fetch_add(1, std::sync::atomic::Ordering::Relaxed) < after);
            match write(&mut map, &WRITTEN[..2], &from, &progress) {
                Err(e) => assert_eq!(e, Error::Cancelled),
                Ok(()) => break,
            }
            assert!(bits(&map) == before, "{after}");
            cancelled += 1;
        }
        assert!(cancelled > 1, "{cancelled}");
        let mut some = atrium(&BakeParams { directional: 0, ..PARAMS });
        let e = some.write(&[Layer::L0], |_, _, _, _| [0.0; 3], &Progress::none()).unwrap_err();
        assert!(matches!(&e, Error::InvalidState(e) if e.contains("by direction")), "{e}");
        let mut none = Lightmap::create(some.scene(), &LightmapDesc::default(), &Progress::none()).unwrap();
        let e = none.write(&[Layer::Direct], |_, _, _, _| [0.0; 3], &Progress::none()).unwrap_err();
        assert!(matches!(e, Error::InvalidState(_)), "{e}");
        none.bake(&BakeParams { texel_end: 10, ..PARAMS }, &Progress::none()).unwrap();
        let e = none.write(&[Layer::Direct], |_, _, _, _| [0.0; 3], &Progress::none()).unwrap_err();
        assert!(matches!(&e, Error::InvalidState(e) if e.contains("not been baked yet")), "{e}");
    }

    #[test]
    fn directional_light_stays_possible() {
        let mut map = atrium(&PARAMS);
        let value = |layer: usize, _, _, _| if layer == 0 { [1.0, 2.0, 0.0] } else { [3.0, -1.0, 0.5] };
        map.write(&[Layer::L0, Layer::L1Y], value, &Progress::none()).unwrap();
        assert!(map.light.as_ref().unwrap().directional.iter().all(Directional::is_possible));
    }

    /// The noise of the halves: that of two bakes, independent of one another.
    #[test]
    fn halves_have_the_light_and_independent_noise() {
        let params = BakeParams { stitch: false, directional: 0, passes: 4, ..PARAMS };
        let map = atrium(&params);
        let half = |layer, half| match map.read_half(0, layer, half).unwrap() {
            LayerData::Rgb(v) => v,
            _ => panic!("no light"),
        };
        let reference = atrium(&BakeParams { passes: 16, seed: 99, ..params });
        for layer in [Layer::Combined, Layer::Indirect, Layer::Direct] {
            let (a, b, both) = (half(layer, Half::First), half(layer, Half::Second), read(&map, layer));
            let (mut errors, mut product) = ([0.0; 2], 0.0);
            for (((a, b), both), truth) in a.iter().zip(&b).zip(&both).zip(&read(&reference, layer)) {
                let [a, b, both, truth] = [a, b, both, truth].map(|v| Vec3::from(*v));
                assert!((0.5 * (a + b) - both).abs().max_element() <= 1e-4 * both.max_element() + 1e-6);
                let [a, b] = [a - truth, b - truth].map(|v| v.element_sum() / truth.element_sum().max(0.1));
                (errors[0], errors[1], product) = (errors[0] + a * a, errors[1] + b * b, product + a * b);
            }
            let correlation = product / (errors[0] * errors[1]).sqrt();
            let ratio = errors[0] / errors[1];
            assert!(correlation.abs() < 0.2 && (0.5..2.0).contains(&ratio), "{layer:?}: {correlation} {ratio}");
        }
        assert!(matches!(map.read_half(0, Layer::Radiance, Half::First), Err(Error::InvalidArgument(_))));
        let single = atrium(&BakeParams { passes: 1, ..params });
        assert!(matches!(single.read_half(0, Layer::Indirect, Half::First), Err(Error::InvalidState(_))));
    }
}
