//! Work on the direct light of a block: coarse, at the gather texels of the lowest LOD, and at full resolution, at the
//! texels of the light map, with the bits of a bake.

use super::blocks::{Block, DirectTile, DirectWork, NoisyTile, Rect, Tile};
use super::limit::Limit;
use super::room::Room;
use super::shown_layer::Shown;
use super::work::Context;
use crate::base::directional::Directional;
use crate::base::memory::{try_filled, try_to_vec};
use crate::base::sampling::combine;
use crate::lightmap::atlas::ids::{GatherTexel, LightMap, LightTexel};
use crate::lightmap::direct_blur::{self, DirectBlur};
use crate::lightmap::directional;
use crate::lightmap::texel_light::TexelLight;
use crate::lightmap::texel_light::averages::Averaged;
use glam::Vec3;
use std::time::Instant;

/// Maximum number of shadow rays per area light for coarse direct light.
const COARSE_SAMPLES: u32 = 4;

/// Maximum number of places in a block's rectangle that are searched for its texels before the limit is looked at again.
const SEARCHED: usize = 1024;

/// Number of places of a block's rectangle that are blurred before the limit is looked at again: about a tenth of a
/// millisecond.
const BLURRED: usize = 128;

impl Block {
    /// Computes direct light of the lowest LOD's texels; returns whether there was memory for it.
    pub fn work_on_coarse(&mut self, c: &Context, tile: &Tile, room: &mut Room, limit: &Limit) -> bool {
        coarse_light(c, tile.coarse(), room, limit);
        self.take_coarse(c, (&room.coarse, &room.coarse_directional), limit)
    }

    /// Does the work of [`work_on_coarse`](Self::work_on_coarse) for blocks together.
    pub fn coarse_of_all(c: &Context, blocks: &mut [(Block, &Tile)], room: &mut Room, limit: &Limit) {
        let mut from = 0;
        while from < blocks.len() {
            // As many blocks as have room in a tile.
            let mut count = 0;
            let fits = |(_, tile): &&(Block, &Tile)| {
                count += tile.coarse().len();
                count <= Room::TEXELS
            };
            let to = from + blocks[from..].iter().take_while(fits).count().max(1);
            coarse_light(c, blocks[from..to].iter().flat_map(|(_, tile)| tile.coarse()), room, limit);
            let (mut light, mut directional) = (&room.coarse[..], &room.coarse_directional[..]);
            for (block, tile) in &mut blocks[from..to] {
                let n = tile.coarse().len();
                let own = (&light[..n], directional.get(..n).unwrap_or_default());
                (light, directional) = (&light[n..], directional.get(n..).unwrap_or_default());
                block.take_coarse(c, own, limit);
            }
            from = to;
        }
    }

    /// Takes over coarse direct light; returns whether there was memory for it.
    fn take_coarse(&mut self, c: &Context, (light, by_direction): (&[Vec3], &[Directional]), limit: &Limit) -> bool {
        let what = "coarse direct light";
        let Some(values) = limit.granted(try_to_vec(light, what)) else { return false };
        let Some(by_direction) = limit.granted(try_to_vec(by_direction, what)) else { return false };
        let sum: f32 = values.iter().map(|v| v.element_sum()).sum();
        self.status.direct_mean = sum / values.len().max(1) as f32;
        self.status.coarse_epoch = c.light.direct_epoch;
        self.work.new_coarse = values.into_boxed_slice();
        self.work.new_coarse_directional = by_direction.into_boxed_slice();
        true
    }

    /// Computes direct light of the block's light map texels; returns whether it was completed.
    pub fn work_on_direct(&mut self, c: &Context, of: &Tile, room: &mut Room, limit: &Limit) -> bool {
        let under_way = self.work.direct.take().filter(|w| w.epoch == c.light.direct_epoch);
        let begin = || {
            // Vertices far away can make a block as large as a page.
            let rect = c.map.rect_in_light_map(of.placement, &of.rect);
            let asked = usize::from(c.asks(directional::DIRECT));
            let new = |rect: Rect| {
                let (values, directional) = (unknown(rect.area(), limit)?, unknown(asked * rect.area(), limit)?);
                Some(DirectTile { rect, values, directional })
            };
            let (mut lit, mut before) = (rect, None);
            if c.blurs && c.light.direct.has_wide() {
                lit = rect.grown(direct_blur::RADIUS);
                let variances = limit.granted(try_filled(lit.area(), 0.0, "direct light"))?.into_boxed_slice();
                before = Some(NoisyTile { tile: new(lit)?, variances });
            }
            let around = lit.grown(1).area();
            let (sharp, sharp_directional) = (unknown(around, limit)?, unknown(asked * around, limit)?);
            let (tile, epoch) = (new(rect)?, c.light.direct_epoch);
            Some(DirectWork { tile, before, next: 0, next_blurred: 0, epoch, sharp, sharp_directional })
        };
        let Some(mut direct) = under_way.or_else(begin) else { return false };
        loop {
            let is_lit = direct.next as usize == direct.lit().values.len();
            if is_lit && direct.is_blurred() {
                break;
            }
            if limit.reached() {
                self.work.direct = Some(direct);
                return false;
            }
            if is_lit {
                direct.blur_texels(c, of);
                continue;
            }
            let begun = Instant::now();
            let count = room.direct_pace.texels(limit, c.direct_rays.max(1.0) as u64);
            let looked_at = direct.add_texels(c, of, count, room, limit);
            if looked_at > 0 {
                room.direct_pace.note(begun, looked_at);
            }
        }
        self.status.direct_epoch = direct.epoch;
        self.work.new_direct = Some(direct.tile);
        true
    }
}

impl Tile {
    /// The texels of the lowest LOD.
    fn coarse(&self) -> &[GatherTexel] {
        &self.texels[..self.lod_end[0] as usize]
    }
}

/// Computes coarse direct light of texels into the room: at most [`Room::TEXELS`] of them.
fn coarse_light<'a>(c: &Context, texels: impl IntoIterator<Item = &'a GatherTexel>, room: &mut Room, limit: &Limit) {
    let atlas = &c.map.atlas;
    let point = |&texel: &GatherTexel| {
        (atlas.receiver(&atlas.gather, &c.light.sides.backs, texel), combine(c.direct_seed, atlas.gather.seed(texel)))
    };
    let samples = c.direct_samples.min(COARSE_SAMPLES);
    let Room { points, coarse, coarse_directional, .. } = room;
    coarse.clear();
    coarse_directional.clear();
    let mut rays = 0;
    points.light_at(
        &c.light.direct,
        &atlas.scene,
        samples,
        texels.into_iter().map(point),
        &mut rays,
        |light, directed| {
            coarse.push(light.value());
            coarse_directional.extend(directed.map(|directed| light.by_direction(directed)));
        },
    );
    limit.add(rays);
}

impl DirectWork {
    /// Computes the light of the next texels, up to `count` of the block's own; returns the number of those.
    fn add_texels(&mut self, c: &Context, of: &Tile, count: usize, room: &mut Room, limit: &Limit) -> usize {
        let (is_blurred_later, mut rays) = (self.before.is_some(), 0);
        let DirectTile { rect, values, .. } = self.lit();
        let (rect, area) = (*rect, values.len());
        let a = &c.map.atlas;
        let backs = &c.light.sides.backs;
        let lit = TexelLight {
            areas: a.areas(&a.map),
            direct: &c.light.direct,
            samples: c.direct_samples,
            seed: c.direct_seed,
            sky_from: Some(a),
        };
        let Room { averaged, places, own, .. } = room;
        averaged.clear();
        places.clear();
        own.clear();
        let width = rect.width().max(1);
        let end = area.min(self.next as usize + SEARCHED);
        while (self.next as usize) < end && own.len() < count.min(Room::TEXELS) {
            let at = self.next as usize;
            let (x, y) = (rect.x0 + (at % width) as i32, rect.y0 + (at / width) as i32);
            let texel = if is_blurred_later { texel_at(c, of, x, y) } else { owns(c, of, x, y) };
            if let Some(texel) = texel {
                own.push(texel);
                places.push(at as u32);
            }
            self.next += 1;
        }
        if c.light.direct.has_sharp() {
            self.find_sharp(c, &lit, room, &mut rays);
        }
        let Room { points, averaged, places, own, .. } = room;
        averaged.extend(own.iter().map(|&texel| {
            let (sharp, sharp_directional) = self.sharp_at(c, texel);
            Averaged {
                texel,
                back: a.is_back(&a.map, backs, texel),
                receiver: a.receiver(&a.map, backs, texel),
                sharp,
                sharp_directional,
                variation: lit.varies(texel, sharp, |s| self.sharp_at(c, s).0),
            }
        }));
        let (tile, variances) = match &mut self.before {
            Some(before) => (&mut before.tile, &mut before.variances[..]),
            None => (&mut self.tile, Default::default()),
        };
        let DirectTile { values, directional, .. } = tile;
        lit.irradiance(averaged, points, &mut rays, |i, e, variance, by_direction| {
            let place = places[i] as usize;
            values[place] = e;
            if let Some(here) = variances.get_mut(place) {
                *here = variance;
            }
            if let Some(here) = directional.get_mut(place) {
                *here = *by_direction;
            }
        });
        limit.add(rays);
        own.len()
    }

    /// Whether all of the block's own texels have their light.
    fn is_blurred(&self) -> bool {
        self.before.is_none() || self.next_blurred as usize == self.tile.values.len()
    }

    /// Blurs the next places of the block's rectangle.
    fn blur_texels(&mut self, c: &Context, of: &Tile) {
        let Some(before) = &self.before else { return };
        let (rect, known) = (self.tile.rect, before.tile.rect);
        let mut blur = DirectBlur::new(&c.map.atlas);
        let place = |texel: LightTexel| {
            let (x, y) = c.map.atlas.map.position(texel);
            (y - known.y0) as usize * known.width() + (x - known.x0) as usize
        };
        let noisy = |texel: LightTexel| {
            let i = place(texel);
            let light = before.tile.values[i];
            light.is_known().then_some((light, before.variances[i]))
        };
        let (from, width) = (self.next_blurred as usize, rect.width().max(1));
        let end = self.tile.values.len().min(from + BLURRED);
        for at in from..end {
            let (x, y) = (rect.x0 + (at % width) as i32, rect.y0 + (at / width) as i32);
            let Some(texel) = owns(c, of, x, y) else { continue };
            self.tile.values[at] = blur.mean(texel, noisy, |s| before.tile.values[place(s)]);
            if let Some(here) = self.tile.directional.get_mut(at) {
                *here = blur.mean(texel, noisy, |s| before.tile.directional[place(s)]);
            }
        }
        self.next_blurred = end as u32;
    }

    /// Computes light without penumbrae of the texels in the room and of those around them, as far as it is not known.
    fn find_sharp(&mut self, c: &Context, lit: &TexelLight<LightMap>, room: &mut Room, rays: &mut u64) {
        let a = &c.map.atlas;
        let Room { points, own, sharp, .. } = room;
        sharp.clear();
        for &texel in &*own {
            for near in [texel].into_iter().chain(lit.areas.neighbours(texel).into_iter().flatten()) {
                let place = self.place(c, near);
                if self.sharp[place].x.is_nan() {
                    // It is listed once.
                    self.sharp[place] = Vec3::ZERO;
                    sharp.push(near);
                }
            }
        }
        let receivers = sharp.iter().map(|&texel| a.receiver(&a.map, &c.light.sides.backs, texel));
        lit.sharp_of_tile(receivers, points, rays, |i, light, directed| {
            let place = self.place(c, sharp[i]);
            self.sharp[place] = light;
            if let Some((here, directed)) = self.sharp_directional.get_mut(place).zip(directed) {
                *here = *directed;
            }
        });
    }

    /// Light without penumbrae of a texel for which it is known, or of any if there is none.
    fn sharp_at(&self, c: &Context, texel: LightTexel) -> (Vec3, Directional) {
        if !c.light.direct.has_sharp() {
            return Default::default();
        }
        let place = self.place(c, texel);
        (self.sharp[place], self.sharp_directional.get(place).copied().unwrap_or_default())
    }

    /// Place in [`sharp`](Self::sharp) of one of the block's texels, or one beside them.
    fn place(&self, c: &Context, texel: LightTexel) -> usize {
        let lit = self.before.as_ref().map_or(self.tile.rect, |before| before.tile.rect);
        let ((x, y), known) = (c.map.atlas.map.position(texel), lit.grown(1));
        (y - known.y0) as usize * known.width() + (x - known.x0) as usize
    }
}

/// The texel of the light map at a column and row of a block's page; `None` if it is not of the block's placement.
fn texel_at(c: &Context, tile: &Tile, x: i32, y: i32) -> Option<LightTexel> {
    let a = &c.map.atlas;
    let at = a.map.at(tile.placement, x, y);
    at.filter(|&texel| a.map.placement_of(&a.charts, texel) == tile.placement)
}

/// The texel of the light map at a column and row of a block's page; `None` if it is not the block's.
pub(super) fn owns(c: &Context, tile: &Tile, x: i32, y: i32) -> Option<LightTexel> {
    let a = &c.map.atlas;
    let texel = texel_at(c, tile, x, y)?;
    let at = a.gather.layout.texel_coord(tile.placement, a.texel_local(tile.placement, texel));
    // Includes one texel around the block's own, so that rounding leaves no gaps between blocks.
    let own = tile.rect.grown(1);
    let (gx, gy) = (at[0].floor() as i32, at[1].floor() as i32);
    (gx >= own.x0 && gx < own.x1 && gy >= own.y0 && gy < own.y1).then_some(texel)
}

/// Makes room for direct light of texels, of which nothing is known yet.
fn unknown<T: Shown>(texels: usize, limit: &Limit) -> Option<Box<[T]>> {
    limit.granted(try_filled(texels, T::UNKNOWN, "direct light")).map(Vec::into_boxed_slice)
}
