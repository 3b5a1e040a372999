//! Working memory of a thread that works on blocks.

use super::limit::Pace;
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::try_with_capacity;
use crate::base::scratch::Scratch;
use crate::lightmap::atlas::ids::LightTexel;
use crate::lightmap::indirect::gather::{self, TileTexel};
use crate::lightmap::texel_light::TilePoints;
use crate::lightmap::texel_light::averages::Averaged;
use crate::lightmap::tiles::TILE;
use glam::Vec3;

/// Working memory of all threads.
pub(super) type Rooms = Scratch<Room>;

/// Working memory for texels whose rays are traced together.
pub(super) struct Room {
    pub gather: gather::Tile,
    pub texels: Vec<TileTexel>,
    pub gather_pace: Pace,
    pub points: TilePoints,
    /// Coarse direct light; by direction if it is asked for.
    pub coarse: Vec<Vec3>,
    pub coarse_directional: Vec<Directional>,
    /// Texels of the light map that are lit together, and the place of each in the block's tile.
    pub own: Vec<LightTexel>,
    pub places: Vec<u32>,
    /// Texels whose light without penumbrae is needed.
    pub sharp: Vec<LightTexel>,
    pub averaged: Vec<Averaged>,
    pub direct_pace: Pace,
}

impl Room {
    /// Maximum number of texels whose rays are traced together.
    pub const TEXELS: usize = TILE;

    /// Allocates room for texels; `[indirect, direct]`: whether that light is asked for by direction.
    pub fn new([indirect, direct]: [bool; 2]) -> Result<Room> {
        let what = "the rays of a block of texels";
        Ok(Room {
            gather: if indirect { gather::Tile::by_direction()? } else { gather::Tile::new()? },
            texels: try_with_capacity(Room::TEXELS, what)?,
            gather_pace: Pace::new(1e-4),
            points: if direct { TilePoints::by_direction(TILE)? } else { TilePoints::new(TILE)? },
            coarse: try_with_capacity(Room::TEXELS, what)?,
            coarse_directional: try_with_capacity(if direct { Room::TEXELS } else { 0 }, what)?,
            own: try_with_capacity(Room::TEXELS, what)?,
            places: try_with_capacity(Room::TEXELS, what)?,
            sharp: try_with_capacity(9 * Room::TEXELS, what)?,
            averaged: try_with_capacity(Room::TEXELS, what)?,
            direct_pace: Pace::new(1e-4),
        })
    }
}
