//! Saving a committed scene.

use super::format::*;
use crate::base::error::{Error, Result};
use crate::base::files::{self, Replacement};
use crate::base::geometry::NONE;
use crate::base::progress::{Progress, Stage};
use crate::bvh::Tree;
use crate::scene::{LightmapUvs, Mesh, MeshMaterials, Scene};
use bytemuck::{Pod, bytes_of, cast_slice};
use glam::Vec3;
use std::path::Path;

impl Scene {
    /// Writes the scene to a file, which is replaced as a whole, for [`open`](Scene::open): meshes, instances, materials,
    /// textures, environments, the lights as they are now, and the trees, refits included.
    pub fn save(&self, path: &Path, progress: &Progress) -> Result<()> {
        self.check_file()?;
        let write = || {
            let stage = progress.stage("saving", 0.0, 1.0, self.stats.bytes);
            files::prepare(path, |file| Writer { file, stage, at: 0, table: Vec::new() }.scene(self))
        };
        let new = self.device.run(progress, write)?;
        self.check_file()?;
        new.finish()
    }
}

struct Writer<'a, 'p> {
    file: &'a mut Replacement,
    stage: Stage<'a, 'p>,
    /// Number of bytes written.
    at: u64,
    table: Vec<Entry>,
}

impl Writer<'_, '_> {
    fn scene(mut self, scene: &Scene) -> Result<()> {
        let head = Head { magic: MAGIC, version: VERSION, byte_order: BYTE_ORDER };
        self.append(bytes_of(&head))?;
        self.meshes(scene.meshes())?;
        let instance =
            |i: &crate::scene::Instance| SavedInstance { mesh: i.mesh, transform: i.transform.to_cols_array() };
        self.records(Kind::Instances, scene.instances().iter().map(instance))?;
        let shared = (0..).zip(scene.instances()).filter_map(|(instance, i)| {
            let of = i.light_of?;
            Some(SavedSharedLight { instance, of })
        });
        self.records(Kind::SharedLight, shared)?;
        self.records(Kind::Materials, scene.materials().iter().map(SavedMaterial::new))?;
        self.records(Kind::Lights, scene.lights().iter().map(SavedLight::new))?;
        let images = scene.textures().iter().map(|t| SavedImage { width: t.width, height: t.height });
        self.records(Kind::Textures, images)?;
        self.section(Kind::Texels, scene.textures().iter().map(|t| &t.rgba8[..]))?;
        let images = scene.environments().iter().map(|e| {
            let (width, height) = e.size();
            SavedImage { width, height }
        });
        self.records(Kind::Environments, images)?;
        self.section(Kind::Pixels, scene.environments().iter().map(|e| e.rgb()))?;
        self.trees(scene)?;

        let table = self.at;
        let entries = std::mem::take(&mut self.table);
        self.append(cast_slice(&entries))?;
        let mut foot = Foot {
            table,
            bytes: self.at + size_of::<Foot>() as u64,
            sections: entries.len() as u32,
            checksum: 0,
            magic: MAGIC,
        };
        foot.checksum = foot.checksum_with(&head, &entries);
        self.append(bytes_of(&foot))
    }

    fn meshes(&mut self, meshes: &[Mesh]) -> Result<()> {
        let record = |mesh: &Mesh| {
            let flag = |is: bool, flag: u32| if is { flag } else { 0 };
            let (material, materials) = match &mesh.materials {
                MeshMaterials::One(m) => (*m, 0),
                MeshMaterials::PerTriangle(_) => (0, HAS_TRIANGLE_MATERIALS),
            };
            let has_pages = mesh.lightmap.as_ref().is_some_and(|l| !l.pages.is_empty());
            SavedMesh {
                vertices: mesh.positions.len() as u64,
                triangles: mesh.indices.len() as u64,
                flags: flag(!mesh.normals.is_empty(), HAS_NORMALS)
                    | flag(!mesh.uvs.is_empty(), HAS_UVS)
                    | flag(mesh.lightmap.is_some(), HAS_LIGHTMAP_UVS)
                    | flag(has_pages, HAS_LIGHTMAP_PAGES)
                    | materials
                    | flag(mesh.strict, IS_STRICT),
                material,
            }
        };
        self.records(Kind::Meshes, meshes.iter().map(record))?;
        self.section(Kind::Positions, meshes.iter().map(|m| &m.positions[..]))?;
        self.section(Kind::Indices, meshes.iter().map(|m| &m.indices[..]))?;
        self.section(Kind::Normals, meshes.iter().map(|m| &m.normals[..]))?;
        self.section(Kind::Uvs, meshes.iter().map(|m| &m.uvs[..]))?;
        let given = || meshes.iter().filter_map(|m| m.lightmap.as_ref());
        self.section(Kind::LightmapUvs, given().map(|l: &LightmapUvs| &l.uvs[..]))?;
        self.section(Kind::LightmapPages, given().map(|l| &l.pages[..]))?;
        let materials = meshes.iter().filter_map(|m| match &m.materials {
            MeshMaterials::One(_) => None,
            MeshMaterials::PerTriangle(materials) => Some(&materials[..]),
        });
        self.section(Kind::TriangleMaterials, materials)
    }

    fn trees(&mut self, scene: &Scene) -> Result<()> {
        let of_instances = || scene.instances.iter().flat_map(|i| &i.trees);
        // Triangles of meshes with instances are counted once.
        let elsewhere: usize = of_instances().map(|t| t.skipped.len() + t.gone).sum();
        let own_gone = (scene.stats.skipped_degenerate as usize).saturating_sub(scene.skipped.len() + elsewhere);
        let sah_cost = scene.stats.sah_cost;
        let own = SavedTree { sah_cost, ..saved(NONE, &scene.tree, scene.skipped.len(), own_gone, scene.is_refitted) };
        let others = of_instances().map(|t| saved(t.mesh, &t.tree, t.skipped.len(), t.gone, t.is_refitted));
        self.records(Kind::Trees, [own].into_iter().chain(others))?;
        let trees = || [&scene.tree].into_iter().chain(of_instances().map(|t| &t.tree));
        let whole = || trees().filter_map(|t| if let Tree::Whole(t) = t { Some(t) } else { None });
        let compact = || trees().filter_map(|t| if let Tree::Compact(t) = t { Some(t) } else { None });
        self.section(Kind::Nodes, whole().map(|t| &t.nodes[..]))?;
        self.section(Kind::Leaves, whole().map(|t| &t.leaves[..]))?;
        self.section(Kind::CompactNodes, compact().map(|t| &t.nodes[..]))?;
        self.section(Kind::CompactLeaves, compact().map(|t| &t.triangles[..]))?;
        let skipped = [&scene.skipped[..]].into_iter().chain(of_instances().map(|t| &t.skipped[..]));
        self.section(Kind::Skipped, skipped)
    }

    /// Writes a section of records that are made for it.
    fn records<T: Pod>(&mut self, kind: Kind, records: impl Iterator<Item = T>) -> Result<()> {
        let records = crate::base::memory::try_collect(records, "a scene file")?;
        self.section(kind, [&records[..]].into_iter())
    }

    /// Writes a section, the elements of all slices behind each other.
    fn section<'e, T: Pod>(&mut self, kind: Kind, parts: impl Iterator<Item = &'e [T]>) -> Result<()> {
        let mut sum = crc32fast::Hasher::new();
        let mut entry = Entry { kind: kind as u32, checksum: 0, offset: self.at.next_multiple_of(ALIGN), bytes: 0 };
        for part in parts.filter(|part| !part.is_empty()) {
            let mut gap = entry.offset.saturating_sub(self.at) as usize;
            while gap > 0 {
                let zeros = [0; 256];
                let some = gap.min(zeros.len());
                self.append(&zeros[..some])?;
                gap -= some;
            }
            for run in cast_slice::<T, u8>(part).chunks(1 << 20) {
                sum.update(run);
                self.append(run)?;
            }
            entry.bytes += size_of_val(part) as u64;
        }
        entry.checksum = sum.finalize();
        if entry.bytes > 0 {
            self.table.push(entry);
        }
        Ok(())
    }

    fn append(&mut self, bytes: &[u8]) -> Result<()> {
        let stage = &self.stage;
        self.file.append(bytes, |written| stage.advance(written))?;
        self.at = self
            .at
            .checked_add(bytes.len() as u64)
            .ok_or_else(|| Error::Io("a scene file has less than 2^64 bytes".into()))?;
        Ok(())
    }
}

/// The record of a tree, without its SAH cost.
fn saved(mesh: u32, tree: &Tree, skipped: usize, gone: usize, is_refitted: bool) -> SavedTree {
    let (nodes, leaves, is_compact) = match tree {
        Tree::Whole(t) => (t.nodes.len(), t.leaves.len(), 0),
        Tree::Compact(t) => (t.nodes.len(), t.triangles.len(), 1),
    };
    let (lower, upper): (Vec3, Vec3) = tree.bounds();
    SavedTree {
        mesh,
        is_compact,
        nodes: nodes as u64,
        leaves: leaves as u64,
        skipped: skipped as u64,
        gone: gone as u64,
        lower: lower.to_array(),
        upper: upper.to_array(),
        sah_cost: 0.0,
        is_refitted: is_refitted.into(),
    }
}
