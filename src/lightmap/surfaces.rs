//! Which surfaces of two scenes are the same: after meshes were added, removed or edited, a light map of the new scene takes
//! over charts, texels and light of a light map of the earlier one.
//!
//! Objects of the same content in the same place are matched first, by hashes and then bit for bit. Of the others, single
//! triangles are, since an edited mesh may have kept most of its own. What is left in either scene was removed or is new.

use super::atlas::charts::Charts;
use super::atlas::ids::ChartId;
use crate::base::bounds::Bounds;
use crate::base::error::Result;
use crate::base::geometry::is_valid_triangle;
use crate::base::memory::{Reservation, try_collect, try_filled, try_par_collect, try_push, try_vec};
use crate::base::progress::Progress;
use crate::base::sort::sort;
use crate::scene::{Material, NONE, Object, Scene, Texture};
use glam::Vec3;
use rayon::prelude::*;
use std::hash::{DefaultHasher, Hash, Hasher};

/// Name of these lists in error messages.
pub(super) const MATCHED: &str = "what two scenes have in common";

/// Bytes per triangle that is matched by itself: its number, hash, class (twice), and links to others alike.
const TRIANGLE_BYTES: usize = 40;

/// Number of entries that a thread compares at a time.
const PART: usize = 1 << 14;

/// The former numbers of an object's triangles.
#[derive(Clone, Copy)]
enum Former {
    /// Those of an object whose first triangle this is.
    Object(u32),
    /// In the list of triangles, from this entry on.
    Triangles(usize),
}

/// For the surfaces of a scene, the same ones of an earlier scene.
pub(super) struct Surfaces {
    /// By object.
    objects: Vec<Former>,
    /// Former numbers of triangles that were matched by themselves; [`NONE`]: there was none.
    triangles: Vec<u32>,
    _memory: Reservation,
}

/// What only one of two scenes has.
pub(super) struct Rest {
    /// Boxes around it.
    pub boxes: Vec<Bounds>,
    /// Whether any of it emits light.
    pub emits: bool,
}

impl Surfaces {
    /// Matches the surfaces of an earlier scene and of a new one. To be called on the device's threads.
    pub fn between(scenes: [&Scene; 2], progress: &Progress) -> Result<(Surfaces, Rest)> {
        let materials = Materials::of(scenes, &|| progress.check())?;
        let counts = scenes.map(Scene::object_count);
        let object = |i: usize| match (i as u32).checked_sub(counts[0]) {
            None => Place { scene: scenes[0], materials: &materials.numbers[0], object: i as u32 },
            Some(object) => Place { scene: scenes[1], materials: &materials.numbers[1], object },
        };
        let total = (counts[0] + counts[1]) as usize;
        let check = || progress.check();
        let is_same = |i, j| object(i).is_same(&object(j));
        let of_objects = former(counts[0] as usize, total, |i| object(i).hash(), is_same, &check)?;
        // The triangles of all other objects.
        let is_taken = taken(&of_objects, counts[0] as usize)?;
        let mut rest: [Vec<u32>; 2] = [Vec::new(), Vec::new()];
        for number in (0..counts[0]).filter(|&number| !is_taken[number as usize]) {
            for triangle in scenes[0].triangles_of(number) {
                try_push(&mut rest[0], triangle, MATCHED)?;
            }
        }
        let mut objects = try_vec(counts[1] as usize, MATCHED)?;
        for (number, (out, &found)) in (0..).zip(objects.iter_mut().zip(&of_objects)) {
            if found != NONE {
                *out = Former::Object(scenes[0].first_triangle(found));
                continue;
            }
            *out = Former::Triangles(rest[1].len());
            for triangle in scenes[1].triangles_of(number) {
                try_push(&mut rest[1], triangle, MATCHED)?;
            }
        }
        let [before, after] = rest.each_ref().map(Vec::len);
        let bytes = TRIANGLE_BYTES * (before + after);
        let mut memory = scenes[1].device().memory().reserve(bytes, MATCHED)?;
        let triangle = |i: usize| match i.checked_sub(before) {
            None => Corners::of(scenes[0], &materials.numbers[0], rest[0][i]),
            Some(i) => Corners::of(scenes[1], &materials.numbers[1], rest[1][i]),
        };
        let hash = |i: usize| hash_of(&triangle(i));
        let mut triangles = former(before, before + after, hash, |i, j| triangle(i) == triangle(j), &check)?;
        let are_taken = taken(&triangles, before)?;
        let (mut boxes, mut emits) = (Vec::new(), false);
        emits |= add_boxes(scenes[0], &rest[0], |i| are_taken[i], &mut boxes)?;
        emits |= add_boxes(scenes[1], &rest[1], |i| triangles[i] != NONE, &mut boxes)?;
        for former in triangles.iter_mut().filter(|former| **former != NONE) {
            *former = rest[0][*former as usize];
        }
        memory.shrink(bytes - size_of_val(&triangles[..]));
        Ok((Surfaces { objects, triangles, _memory: memory }, Rest { boxes, emits }))
    }

    /// Returns the former number of a triangle of the scene.
    pub fn triangle(&self, scene: &Scene, triangle: u32) -> Option<u32> {
        let (object, of_object) = scene.locate(triangle);
        match self.objects[object as usize] {
            Former::Object(first) => Some(first + of_object),
            Former::Triangles(begin) => Some(self.triangles[begin + of_object as usize]).filter(|&t| t != NONE),
        }
    }

    /// Returns the former number of a chart; `None` if none of its triangles was in one of as many triangles, or one lay
    /// elsewhere in it, by more than `most`. (Of a chart of the caller's, single triangles may be new.) Charts of the earlier
    /// scene come first.
    pub fn chart(&self, scene: &Scene, [old, new]: [&Charts; 2], chart: ChartId, most: f32) -> Option<ChartId> {
        let former = |triangle| self.triangle(scene, triangle);
        let mut triangles = new.triangles_of(chart);
        let found = old.find(triangles.clone().find_map(former)?)?;
        let is_near = |(a, b): (&[f32; 2], &[f32; 2])| (a[0] - b[0]).abs() <= most && (a[1] - b[1]).abs() <= most;
        let is_same = |triangle: u32| {
            former(triangle).is_none_or(|former| {
                let corners = [old.corners(former), new.corners(triangle)];
                old.find(former) == Some(found) && corners[0].iter().zip(&corners[1]).all(is_near)
            })
        };
        (triangles.len() == old.triangles_of(found).len() && triangles.all(is_same)).then_some(found)
    }
}

impl Default for Former {
    fn default() -> Self {
        Former::Triangles(0)
    }
}

/// For each of the things from `olds` on, of `total`, the number of one before that is the same, each of which is given
/// once; [`NONE`]: there is none. `hash` and `same` are by number.
fn former(
    olds: usize,
    total: usize,
    hash: impl Fn(usize) -> u64 + Sync,
    same: impl Fn(usize, usize) -> bool + Sync,
    check: &(impl Fn() -> Result<()> + Sync),
) -> Result<Vec<u32>> {
    let kinds = kinds(total, hash, same, check)?;
    // Lists of what is the same, by its kind.
    let mut first: Vec<u32> = try_filled(total, NONE, MATCHED)?;
    let mut next: Vec<u32> = try_filled(olds, NONE, MATCHED)?;
    for old in (0..olds).rev() {
        next[old] = std::mem::replace(&mut first[kinds[old] as usize], old as u32);
    }
    let take = |&kind: &u32| match first[kind as usize] {
        NONE => NONE,
        old => {
            first[kind as usize] = next[old as usize];
            old
        }
    };
    try_collect(kinds[olds..].iter().map(take), MATCHED)
}

/// Gives the same number to what is the same: that of the first of it.
fn kinds(
    count: usize,
    hash: impl Fn(usize) -> u64 + Sync,
    same: impl Fn(usize, usize) -> bool + Sync,
    check: &(impl Fn() -> Result<()> + Sync),
) -> Result<Vec<u32>> {
    let mut order = try_par_collect((0..count).into_par_iter().map(|i| (hash(i), i as u32)), MATCHED)?;
    sort(&mut order, check)?;
    // For each entry, the first thing that is the same; in parallel, since things are far apart in memory.
    let mut firsts: Vec<u32> = try_vec(count, MATCHED)?;
    let mut parts = Vec::new();
    let (mut hashed, mut found) = (&order[..], &mut firsts[..]);
    while !hashed.is_empty() {
        let end = hashed.len().min(PART);
        // What has the same hash stays together.
        let end = end + hashed[end..].iter().take_while(|entry| entry.0 == hashed[end - 1].0).count();
        let (part, rest) = hashed.split_at(end);
        let (firsts, others) = std::mem::take(&mut found).split_at_mut(end);
        try_push(&mut parts, (part, firsts), MATCHED)?;
        (hashed, found) = (rest, others);
    }
    parts.into_par_iter().try_for_each(|(part, firsts)| {
        check()?;
        let mut begin = 0;
        for alike in part.chunk_by(|a, b| a.0 == b.0) {
            let firsts = &mut firsts[begin..begin + alike.len()];
            for (k, &(_, i)) in alike.iter().enumerate() {
                let is_first = |&j: &usize| firsts[j] == alike[j].1 && same(alike[j].1 as usize, i as usize);
                firsts[k] = (0..k).find(is_first).map_or(i, |j| alike[j].1);
            }
            begin += alike.len();
        }
        Ok(())
    })?;
    let mut kinds: Vec<u32> = try_vec(count, MATCHED)?;
    order.iter().zip(&firsts).for_each(|(&(_, i), &first)| kinds[i as usize] = first);
    Ok(kinds)
}

/// Whether each of `count` things is among those found.
fn taken(found: &[u32], count: usize) -> Result<Vec<bool>> {
    let mut taken: Vec<bool> = try_vec(count, MATCHED)?;
    found.iter().filter(|&&i| i != NONE).for_each(|&i| taken[i as usize] = true);
    Ok(taken)
}

/// Adds boxes around runs of triangles that have no counterpart; returns whether any of them emits light.
fn add_boxes(
    scene: &Scene,
    triangles: &[u32],
    has_counterpart: impl Fn(usize) -> bool,
    boxes: &mut Vec<Bounds>,
) -> Result<bool> {
    let (mut emits, mut end) = (false, None);
    for (_, &triangle) in triangles.iter().enumerate().filter(|(i, _)| !has_counterpart(*i)) {
        let corners = scene.corners(triangle);
        if !is_valid_triangle(corners) {
            continue;
        }
        emits |= scene.material(triangle).is_emissive();
        if end != Some(triangle) || boxes.is_empty() {
            try_push(boxes, Bounds::EMPTY, MATCHED)?;
        }
        end = Some(triangle + 1);
        let last = boxes.len() - 1;
        corners.into_iter().for_each(|corner| boxes[last].add(corner));
    }
    Ok(emits)
}

/// Numbers of materials that are the same for the same content in both scenes.
struct Materials {
    numbers: [Vec<u32>; 2],
}

impl Materials {
    fn of(scenes: [&Scene; 2], check: &(impl Fn() -> Result<()> + Sync)) -> Result<Materials> {
        let counts = scenes.map(|scene| scene.textures().len());
        let texture = |i: usize| match i.checked_sub(counts[0]) {
            None => &scenes[0].textures()[i],
            Some(i) => &scenes[1].textures()[i],
        };
        let hash = |i: usize| {
            let Texture { width, height, ref rgba8 } = **texture(i);
            hash_of(&(width, height, rgba8.as_flattened()))
        };
        let textures = kinds(counts[0] + counts[1], hash, |i, j| texture(i) == texture(j), check)?;
        let texture_of = |side: usize, number: u32| match number {
            NONE => NONE,
            number => textures[[0, counts[0]][side] + number as usize],
        };
        let count = scenes[0].materials().len();
        let material = |i: usize| {
            let (side, i) = i.checked_sub(count).map_or((0, i), |i| (1, i));
            let Material { albedo, emission, two_sided, albedo_texture, alpha_cutoff, transmission } =
                scenes[side].materials()[i];
            let colours = [albedo, emission, transmission].map(|c| c.map(f32::to_bits));
            (colours, two_sided, texture_of(side, albedo_texture), alpha_cutoff.to_bits())
        };
        let total = count + scenes[1].materials().len();
        let mut numbers = kinds(total, |i| hash_of(&material(i)), |i, j| material(i) == material(j), check)?;
        let of_new = try_collect(numbers.drain(count..), MATCHED)?;
        Ok(Materials { numbers: [numbers, of_new] })
    }
}

/// An object of a scene, whose materials are numbered by content.
struct Place<'a> {
    scene: &'a Scene,
    materials: &'a [u32],
    object: u32,
}

impl Place<'_> {
    fn object(&self) -> Object<'_> {
        self.scene.object(self.object)
    }

    /// Yields the materials of the triangles that stand in the scene.
    fn materials(&self) -> impl Iterator<Item = u32> {
        self.scene.triangles_of(self.object).map(|t| self.materials[self.scene.material_id(t) as usize])
    }

    fn hash(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        let mesh = self.object().mesh();
        bytemuck::cast_slice::<_, u32>(&mesh.positions[..]).hash(&mut hasher);
        mesh.indices.as_flattened().hash(&mut hasher);
        self.materials().for_each(|material| material.hash(&mut hasher));
        hasher.finish()
    }

    fn is_same(&self, other: &Place) -> bool {
        fn bits<T: bytemuck::NoUninit>(values: &[T]) -> &[u32] {
            bytemuck::cast_slice(values)
        }
        let [here, there] = [self.object(), other.object()];
        let (a, b) = (here.mesh(), there.mesh());
        here.stands_as(&there)
            && a.indices == b.indices
            && bits(&a.normals[..]) == bits(&b.normals[..])
            && bits(&a.uvs[..]) == bits(&b.uvs[..])
            && self.materials().eq(other.materials())
    }
}

/// All that makes a triangle look as it does, bit for bit.
#[derive(Hash, PartialEq)]
struct Corners {
    positions: [[u32; 3]; 3],
    normals: Option<[[u32; 3]; 3]>,
    uvs: Option<[[u32; 2]; 3]>,
    material: u32,
}

impl Corners {
    fn of(scene: &Scene, materials: &[u32], triangle: u32) -> Corners {
        let (number, of_object) = scene.locate(triangle);
        let object = scene.object(number);
        let mesh = object.mesh();
        let vertices = mesh.indices[of_object as usize];
        let bits = |v: Vec3| v.to_array().map(f32::to_bits);
        Corners {
            positions: object.corners(of_object).map(bits),
            normals: (!mesh.normals.is_empty()).then(|| vertices.map(|v| bits(object.normal(v)))),
            uvs: (!mesh.uvs.is_empty()).then(|| vertices.map(|v| mesh.uvs[v as usize].to_array().map(f32::to_bits))),
            material: materials[scene.material_id(triangle) as usize],
        }
    }
}

fn hash_of(content: &impl Hash) -> u64 {
    let mut hasher = DefaultHasher::new();
    content.hash(&mut hasher);
    hasher.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_the_first_of_what_is_the_same_whatever_the_hashes() {
        let count = 5 * PART;
        for hashes in [1, 7, 5000] {
            let hash = |i: usize| (i % hashes) as u64;
            let same = |i: usize, j: usize| i % (3 * hashes) == j % (3 * hashes);
            let found = kinds(count, hash, same, &|| Ok(())).unwrap();
            assert!((0..count).all(|i| found[i] as usize == i % (3 * hashes)), "{hashes} hashes");
        }
    }
}
