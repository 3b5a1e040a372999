//! Format of scene files: a head, sections of equal elements, a table of sections and a foot.
//!
//! The elements of all meshes follow each other in the sections of positions, indices and so on; records of meshes say how
//! many are each one's. Trees are those of memory, node for node, in the order that `crate::bvh::collapse` gives them.

use crate::base::geometry::NONE;
use crate::scene::{Light, Material};
use bytemuck::{Pod, Zeroable};
use glam::Vec3;

/// First bytes of a file, and last ones.
pub(super) const MAGIC: [u8; 8] = *b"bk-scene";

/// Version of the format; files of others are refused.
pub(super) const VERSION: u32 = 1;

/// Reads as another number where bytes have another order.
pub(super) const BYTE_ORDER: u32 = 0x0102_0304;

/// Alignment of sections in bytes: that of pages, so that each can be dropped from memory or advised on by itself.
pub(super) const ALIGN: u64 = 4096;

/// Kinds of sections; each is there at most once, and left out if it is empty.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum Kind {
    Meshes = 1,
    Positions = 2,
    Indices = 3,
    Normals = 4,
    Uvs = 5,
    LightmapUvs = 6,
    LightmapPages = 7,
    TriangleMaterials = 8,
    Instances = 9,
    Materials = 10,
    Lights = 11,
    Textures = 12,
    Texels = 13,
    Environments = 14,
    Pixels = 15,
    Trees = 16,
    Nodes = 17,
    Leaves = 18,
    CompactNodes = 19,
    CompactLeaves = 20,
    Skipped = 21,
    SharedLight = 22,
}

/// The last of [`Kind`].
pub(super) const KINDS: u32 = Kind::SharedLight as u32;

/// Kinds that a scene uses where they are; the others are copied.
pub(super) const IN_PLACE: [Kind; 11] = [
    Kind::Positions,
    Kind::Indices,
    Kind::Normals,
    Kind::Uvs,
    Kind::LightmapUvs,
    Kind::LightmapPages,
    Kind::TriangleMaterials,
    Kind::Nodes,
    Kind::Leaves,
    Kind::CompactNodes,
    Kind::CompactLeaves,
];

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Head {
    pub magic: [u8; 8],
    pub version: u32,
    pub byte_order: u32,
}

/// A section.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Entry {
    pub kind: u32,
    /// CRC-32 of its bytes.
    pub checksum: u32,
    /// From the start of the file.
    pub offset: u64,
    pub bytes: u64,
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Foot {
    /// Where the table begins, which ends where the foot begins.
    pub table: u64,
    /// Size of the file.
    pub bytes: u64,
    pub sections: u32,
    /// CRC-32 of head and table, and of the foot up to here: [`checksum_with`](Self::checksum_with).
    pub checksum: u32,
    pub magic: [u8; 8],
}

impl Foot {
    /// Returns the checksum that belongs to a file with this head and table.
    pub fn checksum_with(&self, head: &Head, table: &[Entry]) -> u32 {
        let mut sum = crc32fast::Hasher::new();
        sum.update(bytemuck::bytes_of(head));
        sum.update(bytemuck::cast_slice(table));
        sum.update(bytemuck::bytes_of(&self.table));
        sum.update(bytemuck::bytes_of(&self.bytes));
        sum.update(bytemuck::bytes_of(&self.sections));
        sum.finalize()
    }
}

/// A mesh has normals, and so on, as many as it has vertices or triangles.
pub(super) const HAS_NORMALS: u32 = 1;
pub(super) const HAS_UVS: u32 = 1 << 1;
pub(super) const HAS_LIGHTMAP_UVS: u32 = 1 << 2;
pub(super) const HAS_LIGHTMAP_PAGES: u32 = 1 << 3;
pub(super) const HAS_TRIANGLE_MATERIALS: u32 = 1 << 4;
/// [`Mesh::strict`](crate::scene::Mesh::strict).
pub(super) const IS_STRICT: u32 = 1 << 5;

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SavedMesh {
    pub vertices: u64,
    pub triangles: u64,
    /// Flags as above.
    pub flags: u32,
    /// Material of all triangles, unless each has its own; then 0.
    pub material: u32,
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SavedInstance {
    pub mesh: u32,
    /// Images of the axes, then of the origin.
    pub transform: [f32; 12],
}

/// An instance that shows the light of another one.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SavedSharedLight {
    pub instance: u32,
    pub of: u32,
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SavedMaterial {
    pub albedo: [f32; 3],
    pub emission: [f32; 3],
    pub transmission: [f32; 3],
    pub alpha_cutoff: f32,
    pub albedo_texture: u32,
    /// 0 or 1.
    pub two_sided: u32,
}

impl SavedMaterial {
    pub fn new(m: &Material) -> SavedMaterial {
        SavedMaterial {
            albedo: m.albedo,
            emission: m.emission,
            transmission: m.transmission,
            alpha_cutoff: m.alpha_cutoff,
            albedo_texture: m.albedo_texture,
            two_sided: m.two_sided.into(),
        }
    }

    pub fn material(&self) -> Material {
        Material {
            albedo: self.albedo,
            emission: self.emission,
            two_sided: self.two_sided != 0,
            albedo_texture: self.albedo_texture,
            alpha_cutoff: self.alpha_cutoff,
            transmission: self.transmission,
        }
    }
}

/// A light: its kind (0 point, 1 spot, 2 directional, 3 rectangle, 4 sky), colour, and values in the order of the fields of
/// [`Light`]; those that it does not have are 0.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SavedLight {
    pub kind: u32,
    /// Of a sky; [`NONE`]: none.
    pub environment: u32,
    pub color: [f32; 3],
    pub values: [f32; 9],
}

impl SavedLight {
    pub fn new(light: &Light) -> SavedLight {
        let vectors = |a: Vec3, b: Vec3, c: Vec3| [a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z];
        let with = |kind, values| SavedLight { kind, environment: NONE, color: light.color(), values };
        let zero = Vec3::ZERO;
        match *light {
            Light::Point { position, .. } => with(0, vectors(position, zero, zero)),
            Light::Spot { position, direction, inner, outer, .. } => {
                with(1, vectors(position, direction, Vec3::new(inner, outer, 0.0)))
            }
            Light::Directional { direction, angular_radius, .. } => {
                with(2, vectors(direction, Vec3::new(angular_radius, 0.0, 0.0), zero))
            }
            Light::Rect { position, edge_u, edge_v, .. } => with(3, vectors(position, edge_u, edge_v)),
            Light::Sky { environment, up, rotation, .. } => {
                SavedLight { environment, ..with(4, vectors(up, Vec3::new(rotation, 0.0, 0.0), zero)) }
            }
        }
    }

    /// Returns the light; `None` if there is no such kind.
    pub fn light(&self) -> Option<Light> {
        let [a, b, c] = [0, 3, 6].map(|i| Vec3::from_slice(&self.values[i..]));
        let color = self.color;
        Some(match self.kind {
            0 => Light::Point { position: a, intensity: color },
            1 => Light::Spot { position: a, direction: b, inner: c.x, outer: c.y, intensity: color },
            2 => Light::Directional { direction: a, irradiance: color, angular_radius: b.x },
            3 => Light::Rect { position: a, edge_u: b, edge_v: c, radiance: color },
            4 => Light::Sky { radiance: color, environment: self.environment, up: a, rotation: b.x },
            _ => return None,
        })
    }

    /// Whether all values are those of another light but for rounding.
    pub fn is_nearly(&self, other: &SavedLight) -> bool {
        let values = |light: &SavedLight| light.color.into_iter().chain(light.values);
        (self.kind, self.environment) == (other.kind, other.environment)
            && values(self).zip(values(other)).all(|(a, b)| (a - b).abs() <= 1e-6 * a.abs().max(b.abs()))
    }
}

/// Size of a texture or an environment.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SavedImage {
    pub width: u32,
    pub height: u32,
}

/// A tree: first that of all meshes without instances, then those of meshes with some, by number.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct SavedTree {
    /// Number of the mesh; [`NONE`]: that of all meshes without instances.
    pub mesh: u32,
    /// 0: full, its nodes and leaves in the sections of those; 1: compact, likewise.
    pub is_compact: u32,
    pub nodes: u64,
    /// Number of values of the leaves.
    pub leaves: u64,
    /// Number of triangles that are not in the tree.
    pub skipped: u64,
    /// Number of those in the tree that cannot be hit, since a refit.
    pub gone: u64,
    /// Box around all triangles.
    pub lower: [f32; 3],
    pub upper: [f32; 3],
    /// See [`SceneStats::sah_cost`](crate::scene::SceneStats::sah_cost); 0 for meshes with instances.
    pub sah_cost: f32,
    /// 1: a refit has moved a mesh in it; 0: none has, or the file is of an earlier build.
    pub is_refitted: u32,
}
