//! What repeats in a mesh, as columns, chairs and balusters do in scenes that were exported without instances: connected
//! surface with the same triangles in the same order and of the same lengths. The first of each kind is unwrapped, and the
//! others get its charts.
//!
//! A chart is valid for any triangles that are joined alike: whether it folds or overlaps is a matter of its own coordinates.
//! Lengths need to agree only as well as charts keep them, which is not exactly either.

use super::pieces::{CHARTS, Groups, ITEMS_PER_CHECK, Piece, connected_by_vertices};
use super::welded::Geometry;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_push, try_with_capacity};
use crate::base::progress::Stage;
use crate::base::sort::sort;
use crate::scene::NONE;
use glam::DVec3;
use std::hash::{DefaultHasher, Hasher};

/// Greatest difference of a triangle's sides, as a fraction of its longest one.
const SIDE: f64 = 0.01;

/// What is added to that, as a fraction of the extent of the whole component: exporters round coordinates.
const ROUNDING: f64 = 1e-3;

/// Greatest difference of the distances of vertices from the middle, as a fraction of the extent: surfaces with the same
/// lengths may still be bent otherwise, and have creases elsewhere.
const SHAPE: f64 = 0.01;

/// Number of different components with triangles joined alike among which a copy's first is looked for.
const MOST_COMPARED: usize = 16;

/// The connected components of a mesh.
pub(super) struct Components {
    /// By number: their triangles, by their place in the geometry, ascending.
    groups: Groups,
    /// The component of each triangle.
    of: Vec<u32>,
    /// The component that each is a copy of; the number of one that is no copy.
    first: Vec<u32>,
}

impl Components {
    /// Finds the components of a mesh, and which of them repeat. `may_copy` says whether one (the second) may get the charts
    /// of another.
    pub(super) fn of(
        geometry: &Geometry,
        may_copy: impl Fn(&[u32], &[u32]) -> bool,
        stage: &Stage,
    ) -> Result<Components> {
        let roots = connected_by_vertices(geometry.indices.iter().copied(), geometry.positions.len(), stage)?;
        let groups = Groups::new(&roots, stage)?;
        let mut of = roots;
        // Vertices by the order in which the component's triangles name them.
        let mut order = try_filled(geometry.positions.len(), NONE, CHARTS)?;
        for (number, members) in (0..).zip(groups.iter()) {
            let mut next = 0;
            for &t in members {
                of[t as usize] = number;
                for v in geometry.indices[t as usize] {
                    let place = &mut order[v as usize];
                    if *place == NONE {
                        (*place, next) = (next, next + 1);
                    }
                }
            }
        }
        stage.check()?;
        let shapes = Shapes { geometry, order: &order };
        let mut hashes = try_with_capacity(groups.len(), CHARTS)?;
        for (c, members) in (0u32..).zip(groups.iter()) {
            if (c as usize).is_multiple_of(ITEMS_PER_CHECK) {
                stage.check()?;
            }
            hashes.push((shapes.hash(members), c));
        }
        sort(&mut hashes, &|| stage.check())?;
        let mut first = try_collect(0..groups.len() as u32, CHARTS)?;
        for same in hashes.chunk_by(|a, b| a.0 == b.0) {
            stage.check()?;
            let mut kinds: Vec<u32> = Vec::new();
            for &(_, c) in same {
                let members = groups.get(c as usize);
                let is_first = |&&other: &&u32| {
                    let first = groups.get(other as usize);
                    shapes.are_alike(first, members) && may_copy(first, members)
                };
                match kinds.iter().find(is_first) {
                    Some(&other) => first[c as usize] = other,
                    None if kinds.len() < MOST_COMPARED => try_push(&mut kinds, c, CHARTS)?,
                    None => {}
                }
            }
        }
        Ok(Components { groups, of, first })
    }

    /// Whether a triangle (by its place in the geometry) belongs to a copy.
    pub(super) fn is_copied(&self, triangle: usize) -> bool {
        let component = self.of[triangle];
        self.first[component as usize] != component
    }

    /// Makes the pieces of copies from those of all other triangles. Also returns the triangles of copies that there are
    /// none for: a piece of what they are copies of belongs to another component, too.
    pub(super) fn copies<'a>(
        &self,
        geometry: &Geometry,
        pieces: impl Iterator<Item = &'a Piece>,
        stage: &Stage,
    ) -> Result<(Vec<Piece>, Vec<u32>)> {
        // After each component the next copy of the same.
        let mut next = try_filled(self.first.len(), NONE, CHARTS)?;
        for (copy, &first) in self.first.iter().enumerate().rev().filter(|&(copy, &first)| first as usize != copy) {
            next[copy] = std::mem::replace(&mut next[first as usize], copy as u32);
        }
        // Where a triangle stands: its component, and its rank there.
        let stands = |global: &u32| {
            let t = geometry.triangles.binary_search(global).expect("pieces are of this mesh") as u32;
            let component = self.of[t as usize];
            (component, self.groups.get(component as usize).binary_search(&t).expect("it is in its group"))
        };
        let mut all = Vec::new();
        let mut is_mixed = try_filled(self.first.len(), false, CHARTS)?;
        for piece in pieces {
            stage.check()?;
            let component = stands(&piece.triangles[0]).0;
            let places = try_collect(piece.triangles.iter().map(stands), CHARTS)?;
            if places.iter().any(|&(other, _)| other != component) {
                places.iter().for_each(|&(c, _)| is_mixed[c as usize] = true);
                continue;
            }
            let mut copy = next[component as usize];
            while copy != NONE {
                let members = self.groups.get(copy as usize);
                copy = next[copy as usize];
                let of_copy = places.iter().map(|&(_, rank)| geometry.triangles[members[rank] as usize]);
                let of_copy = Piece {
                    triangles: try_collect(of_copy, CHARTS)?.into(),
                    corners: try_collect(piece.corners.iter().copied(), CHARTS)?.into(),
                    given: None,
                };
                try_push(&mut all, (component, of_copy), CHARTS)?;
            }
        }
        let mut without = Vec::new();
        for (copy, &first) in self.first.iter().enumerate() {
            if first as usize != copy && is_mixed[first as usize] {
                self.groups.get(copy).iter().try_for_each(|&t| try_push(&mut without, t, CHARTS))?;
            }
        }
        without.sort_unstable();
        all.retain(|&(component, _)| !is_mixed[component as usize]);
        Ok((try_collect(all.into_iter().map(|(_, piece)| piece), CHARTS)?, without))
    }
}

/// The shapes of components, by their triangles.
struct Shapes<'a> {
    geometry: &'a Geometry,
    order: &'a [u32],
}

impl Shapes<'_> {
    /// The kind of a triangle, and its vertices by their order in the component.
    fn joined(&self, triangle: u32) -> (u32, [u32; 3]) {
        let vertices = self.geometry.indices[triangle as usize].map(|v| self.order[v as usize]);
        (self.geometry.kinds[triangle as usize], vertices)
    }

    fn hash(&self, members: &[u32]) -> u64 {
        let mut hasher = DefaultHasher::new();
        for &triangle in members {
            let (kind, [a, b, c]) = self.joined(triangle);
            hasher.write_u128(u128::from(kind) << 96 | u128::from(a) << 64 | u128::from(b) << 32 | u128::from(c));
        }
        hasher.finish()
    }

    /// The middle of a component's corners, and its extent.
    fn middle(&self, members: &[u32]) -> (DVec3, f64) {
        let corners = || members.iter().flat_map(|&t| self.geometry.corners(t as usize));
        let lower = corners().fold(DVec3::INFINITY, DVec3::min);
        let upper = corners().fold(DVec3::NEG_INFINITY, DVec3::max);
        let sum: DVec3 = corners().map(|c| c - lower).sum();
        (lower + sum / (3 * members.len()) as f64, (upper - lower).max_element())
    }

    fn are_alike(&self, a: &[u32], b: &[u32]) -> bool {
        let pairs = || a.iter().copied().zip(b.iter().copied());
        if a.len() != b.len() || pairs().any(|(a, b)| self.joined(a) != self.joined(b)) {
            return false;
        }
        let [(middle_a, extent), (middle_b, _)] = [self.middle(a), self.middle(b)];
        pairs().all(|(a, b)| {
            let [a, b] = [a, b].map(|t| self.geometry.corners(t as usize));
            let side = |c: [DVec3; 3], k: usize| c[k].distance(c[(k + 1) % 3]);
            let longest = side(a, 0).max(side(a, 1)).max(side(a, 2));
            (0..3).all(|k| {
                let far = a[k].distance(middle_a) - b[k].distance(middle_b);
                (side(a, k) - side(b, k)).abs() <= SIDE * longest + ROUNDING * extent && far.abs() <= SHAPE * extent
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::unwrap::unwrap;
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::charts::tests::{grid, scene_on};
    use crate::scene::Mesh;
    use glam::{Quat, Vec3};

    /// Sheets that follow one another in a mesh, moved and turned, with a flat triangle at each one's first corner.
    fn sheets(heights: &[fn(f32, f32) -> f32]) -> Mesh {
        let mut mesh = Mesh::default();
        for (i, height) in heights.iter().enumerate() {
            let turn = Quat::from_rotation_y(0.7 * i as f32) * Quat::from_rotation_x(0.4 * i as f32);
            let sheet = grid(18, 14, |x, y| height(x as f32, y as f32));
            let first = mesh.positions.len() as u32;
            let corner = sheet.positions[0];
            let flat = [corner, corner - 9.0 * Vec3::Y, corner + Vec3::new(9.0, -9.0, 0.0)];
            // As if written with three digits.
            let place = |p: Vec3| ((turn * p + 50.0 * i as f32 * Vec3::X) * 1e3).round() * 1e-3;
            mesh.positions.as_vec().extend(sheet.positions.iter().copied().chain(flat).map(place));
            let last = sheet.positions.len() as u32;
            let indices = sheet.indices.iter().copied().chain([[last, last + 1, last + 2]]);
            mesh.indices.as_vec().extend(indices.map(|t| t.map(|v| first + v)));
        }
        mesh
    }

    #[test]
    fn what_repeats_gets_the_charts_of_the_first_and_the_rest_its_own() {
        let wave: fn(f32, f32) -> f32 = |x, y| 1.5 * (0.6 * x).sin() + (0.5 * y).cos();
        // As long as that along its triangles' sides, but bent the other way in one half.
        let folded: fn(f32, f32) -> f32 = |x, y| (0.6 * x).sin().abs() * 1.5 + (0.5 * y).cos();
        let deeper: fn(f32, f32) -> f32 = |x, y| 1.9 * (0.6 * x).sin() + (0.5 * y).cos();
        let mesh = sheets(&[wave, deeper, wave, folded, wave]);
        let per_sheet = mesh.indices.len() / 5;
        let scene = scene_on(2, mesh);
        let triangles: Vec<u32> = (0..scene.triangle_count()).collect();
        let progress = Progress::none();
        let stage = progress.stage("unwrap", 0.0, 1.0, triangles.len() as u64);
        let pieces = unwrap(&scene, &triangles, None, &stage).unwrap();
        let mut corners = vec![None; triangles.len()];
        for piece in &pieces {
            for (&t, &c) in piece.triangles.iter().zip(&piece.corners) {
                assert!(corners[t as usize].replace(c).is_none(), "triangle {t} is in two pieces");
            }
        }
        let sheet = |i: usize| corners[i * per_sheet..(i + 1) * per_sheet].to_vec();
        assert!(corners.iter().all(Option::is_some));
        assert!(sheet(0) == sheet(2) && sheet(0) == sheet(4));
        assert!(sheet(0) != sheet(1) && sheet(0) != sheet(3));
        // Charts of copies have the lengths of their own surface, too.
        for t in 0..triangles.len() {
            let area = |[a, b, c]: [Vec3; 3]| 0.5 * (b - a).cross(c - a).length();
            let ratio = area(corners[t].unwrap().map(|[x, y]| Vec3::new(x, y, 0.0))) / area(scene.corners(t as u32));
            assert!((0.5..=2.0).contains(&ratio), "{t} {ratio}");
        }
    }

    #[test]
    fn components_are_told_apart_by_their_sides_and_their_shape() {
        let stage = Progress::none();
        let stage = stage.stage("unwrap", 0.0, 1.0, 1);
        let wave: fn(f32, f32) -> f32 = |x, y| (0.6 * x).sin() + (0.5 * y).cos();
        let mirrored: fn(f32, f32) -> f32 = |x, y| -(0.6 * x).sin() - (0.5 * y).cos();
        let twice: fn(f32, f32) -> f32 = |x, y| 2.0 * ((0.6 * x).sin() + (0.5 * y).cos());
        let mesh = sheets(&[wave, twice, wave, mirrored]);
        let count = mesh.indices.len();
        let scene = scene_on(1, mesh);
        let triangles: Vec<u32> = (0..scene.triangle_count()).collect();
        let geometry = Geometry::of(&scene, &triangles, &stage).unwrap();
        let components = Components::of(&geometry, |_, _| true, &stage).unwrap();
        assert_eq!(components.first.len(), 4);
        assert_eq!(&components.first[..3], [0, 1, 0]);
        let copied = (0..count).filter(|&t| components.is_copied(t)).count();
        assert_eq!(copied, components.first.iter().enumerate().filter(|&(c, &f)| c != f as usize).count() * count / 4);
        // A piece of two components leaves the copies of both without any.
        let all: Vec<u32> = (0..count as u32 / 2).collect();
        let mixed = Piece { corners: vec![[[0.0; 2]; 3]; all.len()].into(), triangles: all.into(), given: None };
        let (pieces, without) = components.copies(&geometry, [mixed].iter(), &stage).unwrap();
        assert!(
            pieces.is_empty() && without.len() == copied && without.iter().all(|&t| components.is_copied(t as usize))
        );
        // Who may not get the charts of another keeps his own.
        let none = Components::of(&geometry, |_, _| false, &stage).unwrap();
        assert!((0..count).all(|t| !none.is_copied(t)));
    }
}
