//! What repeats in a mesh, as columns, chairs and balusters do in scenes that were exported without instances: connected
//! surface with the same triangles in the same order, which differ by little but where they lie. The first of each kind is
//! unwrapped, and the others get its charts.
//!
//! A chart is valid for any triangles that are joined alike: whether it folds or overlaps is a matter of its own coordinates.
//! How much it is stretched is a matter of the triangles, and bounded here. What is all flat is left alone: its charts are
//! exact, and soon made.

use super::pieces::{CHARTS, Groups, ITEMS_PER_CHECK, Piece, connected_by_vertices};
use super::planar::doubled_area;
use super::welded::Geometry;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_push, try_with_capacity};
use crate::base::progress::Stage;
use crate::base::sort::sort;
use crate::scene::NONE;
use glam::DVec3;
use std::hash::{DefaultHasher, Hasher};

/// Greatest factor by which a copy's triangle may be longer or shorter in any direction than that of the first.
const STRETCH: f64 = 1.05;

/// Greatest part of the surface where it may be more: slivers, which rounded coordinates change much.
const MISFIT: f64 = 0.005;

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
    /// Whether any triangle of each is curved.
    are_curved: Vec<bool>,
    /// The component that each is a copy of; the number of one that is no copy.
    first: Vec<u32>,
}

impl Components {
    /// Bytes per triangle, if each is a component and curved.
    pub(super) const BYTES_PER_TRIANGLE: usize = 8 + 4 + 1 + 4;

    /// Finds the components of a mesh.
    pub(super) fn of(geometry: &Geometry, is_curved: &[bool], stage: &Stage) -> Result<Components> {
        let mut of = connected_by_vertices(geometry.indices.iter().copied(), geometry.positions.len(), stage)?;
        let groups = Groups::new(&of, stage)?;
        let mut are_curved = try_filled(groups.len(), false, CHARTS)?;
        let mut looks = Looks { stage, since: 0 };
        for (number, members) in (0..).zip(groups.iter()) {
            for &t in members {
                looks.count()?;
                of[t as usize] = number;
                are_curved[number as usize] |= is_curved[t as usize];
            }
        }
        let first = try_collect(0..groups.len() as u32, CHARTS)?;
        Ok(Components { groups, of, are_curved, first })
    }

    /// Whether a triangle (by its place in the geometry) belongs to a component that is not all flat.
    pub(super) fn is_curved(&self, triangle: usize) -> bool {
        self.are_curved[self.of[triangle] as usize]
    }

    /// Whether a triangle belongs to a copy.
    pub(super) fn is_copied(&self, triangle: usize) -> bool {
        let component = self.of[triangle];
        self.first[component as usize] != component
    }

    /// Finds which components are copies of others. None are those with triangles that have charts already.
    pub(super) fn find_copies(
        &mut self,
        geometry: &Geometry,
        has_chart: impl Fn(u32) -> bool,
        stage: &Stage,
    ) -> Result<()> {
        let groups = &self.groups;
        let mut looks = Looks { stage, since: 0 };
        // Vertices by the order in which the component's triangles name them.
        let mut order = try_filled(geometry.positions.len(), NONE, CHARTS)?;
        let mut hashes = try_with_capacity(self.are_curved.iter().filter(|&&is_curved| is_curved).count(), CHARTS)?;
        for (number, members) in (0..).zip(groups.iter()).filter(|&(c, _)| self.are_curved[c as usize]) {
            let (mut next, mut hasher) = (0, DefaultHasher::new());
            for &t in members {
                looks.count()?;
                let vertices = geometry.indices[t as usize].map(|v| {
                    let place = &mut order[v as usize];
                    if *place == NONE {
                        (*place, next) = (next, next + 1);
                    }
                    u128::from(*place)
                });
                let kind = u128::from(geometry.kinds[t as usize]);
                hasher.write_u128(kind << 96 | vertices[0] << 64 | vertices[1] << 32 | vertices[2]);
            }
            hashes.push((hasher.finish(), number));
        }
        sort(&mut hashes, &|| stage.check())?;
        for same in hashes.chunk_by(|a, b| a.0 == b.0).filter(|same| same.len() > 1) {
            let mut kinds: Vec<(u32, Size)> = Vec::new();
            for &(_, c) in same {
                let members = groups.get(c as usize);
                let size = Size::of(geometry, members, &mut looks)?;
                let mut like = None;
                for &(other, of_other) in &kinds {
                    let shapes = Shapes { geometry, order: &order, sizes: [of_other, size] };
                    if shapes.are_alike(groups.get(other as usize), members, &mut looks)? {
                        like = Some(other);
                        break;
                    }
                }
                match like {
                    Some(other) if !members.iter().any(|&t| has_chart(t)) => self.first[c as usize] = other,
                    None if kinds.len() < MOST_COMPARED => try_push(&mut kinds, (c, size), CHARTS)?,
                    _ => {}
                }
            }
        }
        Ok(())
    }

    /// Makes the pieces of copies from those of all other triangles. Also returns the triangles of copies that there are
    /// none for, ascending: a piece of what they are copies of belongs to another component, too.
    pub(super) fn copies<'a>(
        &self,
        geometry: &Geometry,
        pieces: impl Iterator<Item = &'a Piece> + Clone,
        stage: &Stage,
    ) -> Result<(Vec<Piece>, Vec<u32>)> {
        // After each component the next copy of the same.
        let mut next = try_filled(self.first.len(), NONE, CHARTS)?;
        for (copy, &first) in self.first.iter().enumerate().rev().filter(|&(copy, &first)| first as usize != copy) {
            next[copy] = std::mem::replace(&mut next[first as usize], copy as u32);
        }
        let mut looks = Looks { stage, since: 0 };
        let place = |global: u32| geometry.triangles.binary_search(&global).expect("pieces are of this mesh") as u32;
        let component = |global: u32| self.of[place(global) as usize] as usize;
        let mut is_mixed = try_filled(self.first.len(), false, CHARTS)?;
        let repeats = |piece: &&Piece| next[component(piece.triangles[0])] != NONE;
        for piece in pieces.clone() {
            let first = component(piece.triangles[0]);
            for &t in &piece.triangles {
                looks.count()?;
                let other = component(t);
                if other != first {
                    (is_mixed[first], is_mixed[other]) = (true, true);
                }
            }
        }
        let mut all = Vec::new();
        for piece in pieces.filter(repeats) {
            let first = component(piece.triangles[0]);
            let mut copy = if is_mixed[first] { NONE } else { next[first] };
            while copy != NONE {
                let members = self.groups.get(copy as usize);
                copy = next[copy as usize];
                let mut of_copy = try_with_capacity(piece.triangles.len(), CHARTS)?;
                for &t in &piece.triangles {
                    looks.count()?;
                    let rank = self.groups.get(first).binary_search(&place(t)).expect("it is in its group");
                    of_copy.push(geometry.triangles[members[rank] as usize]);
                }
                let corners = try_collect(piece.corners.iter().copied(), CHARTS)?;
                try_push(&mut all, Piece { triangles: of_copy.into(), corners: corners.into(), given: None }, CHARTS)?;
            }
        }
        let mut without = Vec::new();
        for (copy, &first) in self.first.iter().enumerate() {
            if first as usize != copy && is_mixed[first as usize] {
                self.groups.get(copy).iter().try_for_each(|&t| try_push(&mut without, t, CHARTS))?;
            }
        }
        without.sort_unstable();
        Ok((all, without))
    }
}

/// Looks for a cancel, each time so many triangles have been counted.
struct Looks<'a, 'p, 's> {
    stage: &'a Stage<'p, 's>,
    since: usize,
}

impl Looks<'_, '_, '_> {
    fn count(&mut self) -> Result<()> {
        self.since += 1;
        if self.since == ITEMS_PER_CHECK {
            self.since = 0;
            self.stage.check()?;
        }
        Ok(())
    }
}

/// How large a component is.
#[derive(Clone, Copy)]
struct Size {
    /// Mean of its triangles' corners.
    middle: DVec3,
    extent: f64,
    area: f64,
}

impl Size {
    fn of(geometry: &Geometry, members: &[u32], looks: &mut Looks) -> Result<Size> {
        let (mut lower, mut upper, mut area) = (DVec3::INFINITY, DVec3::NEG_INFINITY, 0.0);
        let start = geometry.corners(members[0] as usize)[0];
        let mut sum = DVec3::ZERO;
        for &t in members {
            looks.count()?;
            let corners = geometry.corners(t as usize);
            area += triangle_area(corners);
            for c in corners {
                (lower, upper, sum) = (lower.min(c), upper.max(c), sum + (c - start));
            }
        }
        Ok(Size { middle: start + sum / (3 * members.len()) as f64, extent: (upper - lower).max_element(), area })
    }
}

/// The shapes of two components.
struct Shapes<'a> {
    geometry: &'a Geometry,
    order: &'a [u32],
    sizes: [Size; 2],
}

impl Shapes<'_> {
    /// The kind of a triangle, and its vertices by their order in the component.
    fn joined(&self, triangle: u32) -> (u32, [u32; 3]) {
        let vertices = self.geometry.indices[triangle as usize].map(|v| self.order[v as usize]);
        (self.geometry.kinds[triangle as usize], vertices)
    }

    fn are_alike(&self, a: &[u32], b: &[u32], looks: &mut Looks) -> Result<bool> {
        let [of_a, of_b] = self.sizes;
        let area_ratio = of_a.area / of_b.area;
        if a.len() != b.len() || !(1.0 / (STRETCH * STRETCH)..STRETCH * STRETCH).contains(&area_ratio) {
            return Ok(false);
        }
        let mut misfit = 0.0;
        for (&a, &b) in a.iter().zip(b) {
            looks.count()?;
            if self.joined(a) != self.joined(b) {
                return Ok(false);
            }
            let [a, b] = [a, b].map(|t| self.geometry.corners(t as usize));
            let is_far = |k: usize| {
                let difference = a[k].distance(of_a.middle) - b[k].distance(of_b.middle);
                difference.abs() > SHAPE * of_a.extent
            };
            if (0..3).any(is_far) {
                return Ok(false);
            }
            if !fits(a, b) {
                misfit += triangle_area(a).max(triangle_area(b));
                if misfit > MISFIT * of_a.area {
                    return Ok(false);
                }
            }
        }
        Ok(true)
    }
}

fn triangle_area(corners: [DVec3; 3]) -> f64 {
    0.5 * doubled_area(corners).length()
}

/// Whether the affine map from a triangle to another stretches or shrinks no length by more than [`STRETCH`].
fn fits(a: [DVec3; 3], b: [DVec3; 3]) -> bool {
    // In the plane of each, with the first side along x: the map is a triangular matrix.
    let flat = |[p, q, r]: [DVec3; 3]| {
        let (along, other) = (q - p, r - p);
        let x = along.length();
        (x, other.dot(along) / x, along.cross(other).length() / x)
    };
    let ((ax, au, av), (bx, bu, bv)) = (flat(a), flat(b));
    let (xx, yy) = (bx / ax, bv / av);
    let xy = (bu - xx * au) / av;
    // The singular values, by the sum of their squares and their product.
    let (sum, product) = (xx * xx + xy * xy + yy * yy, xx * yy);
    let most = (0.5 * (sum + (sum * sum - 4.0 * product * product).max(0.0).sqrt())).sqrt();
    most <= STRETCH && product / most >= 1.0 / STRETCH
}

#[cfg(test)]
mod tests {
    use super::super::unwrap::unwrap;
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::charts::tests::{grid, scene_on};
    use crate::lightmap::{Lightmap, LightmapDesc};
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
    fn a_light_map_of_the_same_scene_keeps_the_charts_of_copies() {
        let wave: fn(f32, f32) -> f32 = |x, y| 1.5 * (0.6 * x).sin() + (0.5 * y).cos();
        let scene = || scene_on(2, sheets(&[wave, |x, y| 0.2 * x * x + y, wave, wave]));
        let desc = LightmapDesc { texels_per_unit: 3.0, page_size: 512, ..Default::default() };
        let first = Lightmap::create(&scene(), &desc, &Progress::none()).unwrap();
        let scene = scene();
        let again = Lightmap::create_from(&scene, &desc, &first, &Progress::none()).unwrap();
        for triangle in 0..scene.triangle_count() {
            let corners = |map: &Lightmap| map.atlas.charts.corners(triangle);
            assert_eq!(corners(&first), corners(&again), "{triangle}");
        }
        assert_eq!(again.atlas.info.kept_charts, again.atlas.info.charts);
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
        let curved = vec![true; count];
        let mut components = Components::of(&geometry, &curved, &stage).unwrap();
        components.find_copies(&geometry, |_| false, &stage).unwrap();
        // Mirrored surface has the same sides, and the same distances from its middle.
        assert_eq!(components.first, [0, 1, 0, 0]);
        let copied = count / 2;
        assert_eq!((0..count).filter(|&t| components.is_copied(t)).count(), copied);
        // A piece of two components leaves the copies of both without any.
        let all: Vec<u32> = (0..count as u32 / 2).collect();
        let mixed = Piece { corners: vec![[[0.0; 2]; 3]; all.len()].into(), triangles: all.into(), given: None };
        let (pieces, without) = components.copies(&geometry, [mixed].iter(), &stage).unwrap();
        assert!(
            pieces.is_empty() && without.len() == copied && without.iter().all(|&t| components.is_copied(t as usize))
        );
        // What has charts keeps them, but others may get the same; what is all flat is not compared.
        components.first = (0..4).collect();
        components.find_copies(&geometry, |t| (t as usize) < count / 4, &stage).unwrap();
        assert_eq!(components.first, [0, 1, 0, 0]);
        components.first = (0..4).collect();
        components.find_copies(&geometry, |t| (t as usize) >= count / 2, &stage).unwrap();
        assert_eq!(components.first, [0, 1, 2, 3]);
        let mut flat = Components::of(&geometry, &vec![false; count], &stage).unwrap();
        flat.find_copies(&geometry, |_| false, &stage).unwrap();
        assert_eq!(flat.first, [0, 1, 2, 3]);
    }

    #[test]
    fn no_more_than_a_little_of_a_copy_is_stretched() {
        let triangle = |x: f64, y: f64| [DVec3::ZERO, DVec3::X, DVec3::new(x, y, 0.0)];
        assert!(fits(triangle(0.5, 1.0), triangle(0.5, 1.04)));
        assert!(!fits(triangle(0.5, 1.0), triangle(0.5, 1.06)) && !fits(triangle(0.5, 1.06), triangle(0.5, 1.0)));
        assert!(!fits(triangle(0.5, 1.0), triangle(0.8, 1.0)));
        // Sides of about the same lengths, ten times the area.
        assert!(!fits(triangle(0.5, 0.01), triangle(0.5, 0.1)));
        assert!(!fits(triangle(0.5, 0.0), triangle(0.5, 0.0)));
    }
}
