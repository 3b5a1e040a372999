//! Where the meshes of nodes stand: once per node, or as often as `EXT_mesh_gpu_instancing` says; and which of them
//! become instances.

use super::Reader;
use crate::base::error::Result;
use crate::io::Import;
use crate::io::source::Checked;
use crate::scene::Instance;
use glam::{Affine3A, DMat4, Quat, Vec3};
use serde_json::{Map, Value};
use std::collections::HashMap;
use std::io::BufReader;

/// Least number of triangles of a primitive that becomes a mesh with instances if it stands in several places. (Rays
/// are faster through copies than through instances of small meshes: docs/performance.md.)
const LEAST_TRIANGLES: usize = 1000;

const EXTENSION: &str = "EXT_mesh_gpu_instancing";

/// Accessors by attribute.
pub(super) type Attributes = Map<String, Value>;

/// What the extension says, by node. (The crate `gltf` could keep all unknown extensions of all objects, with half a
/// megabyte of code.)
pub(super) fn attributes_of_nodes(import: &mut Import, json: &[u8]) -> Result<HashMap<usize, Attributes>> {
    let mut found = HashMap::new();
    if !json.windows(EXTENSION.len()).any(|w| w == EXTENSION.as_bytes()) {
        return Ok(found);
    }
    // As in `document::parse`.
    let estimate = json.len().saturating_mul(4);
    import.account.hold(estimate, "the JSON of the scene")?;
    let reader = BufReader::new(Checked::new(json, import.advance));
    let mut root: Value = serde_json::from_reader(reader).map_err(|e| import.error(e))?;
    for (n, node) in root.get_mut("nodes").and_then(Value::as_array_mut).into_iter().flatten().enumerate() {
        let Some(extension) = node.get_mut("extensions").and_then(|e| e.get_mut(EXTENSION)) else { continue };
        let attributes = extension.get_mut("attributes").map(Value::take);
        import.account.make_room_in_map(&mut found, "the nodes")?;
        found.insert(n, if let Some(Value::Object(attributes)) = attributes { attributes } else { Map::new() });
    }
    drop(root);
    import.account.give_back(estimate);
    Ok(found)
}

impl<'i> Reader<'i, '_> {
    /// The accessors of translations, rotations and scales that `EXT_mesh_gpu_instancing` gives a node, and the number of
    /// its places; `None` without the extension.
    fn attributes(&mut self, node: &gltf::Node) -> Result<Option<([Option<gltf::Accessor<'i>>; 3], usize)>> {
        if !self.instancing.contains_key(&node.index()) {
            return Ok(None);
        }
        self.place = format!("{EXTENSION} of node {}", node.index());
        let document = self.document;
        let find = |name: &str, number: &Value| {
            let found = number.as_u64().and_then(|n| document.accessors().nth(usize::try_from(n).ok()?));
            found.map_or_else(|| self.malformed(format_args!("{name} names no accessor")), Ok)
        };
        let (mut known, mut count) = ([None, None, None], None);
        for (name, number) in self.instancing.get(&node.index()).into_iter().flatten() {
            let accessor = find(name, number)?;
            if *count.get_or_insert(accessor.count()) != accessor.count() {
                return self.malformed("its attributes have different counts");
            }
            if let Some(i) = ["TRANSLATION", "ROTATION", "SCALE"].iter().position(|n| n == name) {
                known[i] = Some(accessor);
            }
        }
        Ok(Some((known, count.unwrap_or(0))))
    }

    /// The number of places where a node's mesh stands.
    pub(super) fn count_places(&mut self, node: &gltf::Node) -> Result<usize> {
        Ok(self.attributes(node)?.map_or(1, |(_, count)| count))
    }

    /// The transforms of a node's mesh to the world.
    pub(super) fn places(&mut self, node: &gltf::Node, transform: &DMat4) -> Result<Vec<DMat4>> {
        let Some(([translation, rotation, scale], count)) = self.attributes(node)? else {
            let mut one = self.import.account.list(1, "the nodes")?;
            one.push(*transform);
            return Ok(one);
        };
        let translation = translation.map(|a| self.column::<3>(&a)).transpose()?;
        let rotation = rotation.map(|a| self.column::<4>(&a)).transpose()?;
        let scale = scale.map(|a| self.column::<3>(&a)).transpose()?;
        let mut places = self.import.account.list(count, "the nodes")?;
        for i in 0..count as u32 {
            if (i as usize).is_multiple_of(super::PART) {
                self.import.check()?;
            }
            let turn = rotation.as_ref().map_or(Quat::IDENTITY, |r| Quat::from_array(r.get(i))).as_dquat();
            let length = turn.length();
            if !(length > 0.0 && length.is_finite()) {
                return self.malformed(format_args!("rotation {i} is {turn}, no rotation"));
            }
            let place = DMat4::from_scale_rotation_translation(
                scale.as_ref().map_or(Vec3::ONE, |s| s.get(i).into()).as_dvec3(),
                turn.normalize(),
                translation.as_ref().map_or(Vec3::ZERO, |t| t.get(i).into()).as_dvec3(),
            );
            places.push(transform * place);
        }
        Ok(places)
    }

    /// Adds a primitive where it stands: as an instance if it stands in several places, is large enough and its
    /// transform can be that of one, else as a mesh.
    pub(super) fn add_placed(&mut self, mesh: usize, primitive: &gltf::Primitive, transform: &DMat4) -> Result<()> {
        let is_unique = self.mesh_uses[mesh] == 1;
        let corners = match primitive.indices() {
            Some(indices) => indices.count(),
            None => primitive.get(&gltf::Semantic::Positions).map_or(0, |a| a.count()),
        };
        let m = transform.to_cols_array_2d().map(|column| column.map(|x| x as f32));
        let transform_of_instance = Affine3A::from_cols_array_2d(&m.map(|[x, y, z, _]| [x, y, z]));
        let may_be = |mesh| Instance::new(mesh, transform_of_instance).validate(mesh as usize + 1).is_ok();
        if is_unique || corners < 3 * LEAST_TRIANGLES || !may_be(0) {
            return self.add_primitive(primitive, transform, is_unique);
        }
        let key = (mesh, primitive.index());
        let number = match self.shared.get(&key) {
            Some(&number) => number,
            None => {
                let number = self.import.scene.meshes().len() as u32;
                self.add_primitive(primitive, &DMat4::IDENTITY, false)?;
                // It may be invisible.
                let number = ((self.import.scene.meshes().len() as u32) > number).then_some(number);
                self.import.account.make_room_in_map(&mut self.shared, "the meshes with instances")?;
                self.shared.insert(key, number);
                number
            }
        };
        match number {
            Some(mesh) => self.import.add_instance(Instance::new(mesh, transform_of_instance)),
            None => Ok(()),
        }
    }
}
