//! The irradiance estimate (thesis 3.2.2; Jensen 2001, sections 7.2 and 7.3).
//!
//! E ≈ Σ w Φ / ((1 − 2/(3k)) π r²) over the photons in a cylinder of radius r around the surface
//! normal, with the cone filter w = 1 − d/(k r), d being the distance from the cylinder's axis. The
//! cylinder instead of a sphere keeps photons of other surfaces out (Jensen's flattened sphere), and
//! so do two tests: a photon's light comes from the side that the normal points to, and the surface
//! that it lies on faces within 60° of the normal. Without the latter, a disc near a corner would
//! count what the other wall receives.
//!
//! Offsets are in units of the radius, so that scenes may have any unit. The order of summation is
//! fixed by the grid and is the same on every ISA; lanes of f32 are emptied into f64 often enough
//! that a disc may hold millions.

use super::cylinder::{Cylinder, SAME_SURFACE};
use super::grid::Grid;
use super::noted::Noted;
use crate::simd::{self, Lanes, Mask, Simd};
use glam::Vec3;

/// Number of vectors summed in f32 before their sums are added in f64: bounds the rounding error to 2⁻¹⁹ while most
/// estimates do that once.
const FLUSH: usize = 64;

/// Kernel that computes estimates at as many points as all three slices (positions, normals, results) have, and may note
/// the photons that count.
pub(super) type EstimateFn = fn(&Grid, &Cylinder, &[[f32; 3]], &[[f32; 3]], &mut [[f32; 3]], Option<&mut Noted>);

simd::kernel! {
    /// Returns the kernel of an ISA; the portable one if the machine cannot run `isa`.
    pub(super) fn kernel -> EstimateFn;

    fn many<S>(
        g: &Grid, c: &Cylinder, p: &[[f32; 3]], n: &[[f32; 3]], out: &mut [[f32; 3]], noted: Option<&mut Noted>
    ) {
        let mut noted = noted;
        for ((p, n), out) in p.iter().zip(n).zip(out) {
            *out = estimate::<S>(g, c, Vec3::from_array(*p), Vec3::from_array(*n), &mut noted);
        }
    }
}

/// Lane numbers.
static IOTA: [f32; 8] = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];

/// Three components, each a vector of lanes.
#[derive(Clone, Copy)]
struct V3<L>([L; 3]);

impl<L: Lanes> V3<L> {
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn splat(v: [f32; 3]) -> Self {
        // SAFETY: forwarded.
        unsafe { V3([L::splat(v[0]), L::splat(v[1]), L::splat(v[2])]) }
    }

    /// # Safety
    /// The CPU must have the ISA, and `L::WIDTH` floats from `i` must be readable in each column.
    #[inline(always)]
    unsafe fn load(columns: &[*const f32; 12], first: usize, i: usize) -> Self {
        // SAFETY: forwarded.
        unsafe {
            V3([L::load(columns[first].add(i)), L::load(columns[first + 1].add(i)), L::load(columns[first + 2].add(i))])
        }
    }

    // The operations are written out, here and below: closures do not inherit an entry point's target features, and one
    // that is not inlined (in `array::map`) makes every operation on lanes a call.
    #[inline(always)]
    fn minus(self, o: Self) -> Self {
        V3([self.0[0] - o.0[0], self.0[1] - o.0[1], self.0[2] - o.0[2]])
    }

    #[inline(always)]
    fn times(self, l: L) -> Self {
        V3([self.0[0] * l, self.0[1] * l, self.0[2] * l])
    }

    #[inline(always)]
    fn dot(self, o: Self) -> L {
        self.0[0].mul_add(o.0[0], self.0[1].mul_add(o.0[1], self.0[2] * o.0[2]))
    }
}

/// Irradiance at one point. With eight lanes on every ISA, so that sums have one order: AVX2 and AVX-512 give the same
/// bits (see docs/experiments.md, "One order of sums on every ISA").
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn estimate<S: Simd>(
    grid: &Grid,
    cylinder: &Cylinder,
    position: Vec3,
    normal: Vec3,
    noted: &mut Option<&mut Noted>,
) -> [f32; 3] {
    // SAFETY: the caller vouches for the ISA. Rows are runs of photons, and
    // from each photon's place a full vector can be read in every column.
    unsafe {
        let columns = grid.photons.pointers();
        let inverse_radius = S::F8::splat(1.0 / cylinder.radius);
        let (zero, one) = (S::F8::splat(0.0), S::F8::splat(1.0));
        let (top, bottom) = (S::F8::splat(cylinder.half_height), S::F8::splat(-cylinder.half_height));
        let inverse_k = S::F8::splat(cylinder.inverse_k);
        let same_surface = S::F8::splat(SAME_SURFACE);
        let iota = S::F8::load(IOTA.as_ptr());
        let centre = V3::<S::F8>::splat(position.to_array());
        let n = V3::<S::F8>::splat(normal.to_array());

        let mut total = [0.0f64; 3];
        let mut sum = [zero; 3];
        let mut pending = 0;
        let search = grid.search(position, normal, cylinder);
        for z in search.z.0..search.z.1 {
            for y in search.y.0..search.y.1 {
                let (begin, end) = grid.row(&search, y, z);
                let mut i = begin;
                while i < end {
                    // Lanes from `end` on belong to other rows.
                    let in_run = iota.lt(S::F8::splat((end - i) as f32));
                    let p = V3::<S::F8>::load(&columns, 0, i);
                    let d = p.minus(centre).times(inverse_radius);
                    let height = d.dot(n);
                    let radial2 = d.dot(d) - height * height;
                    let inside = in_run.and(radial2.le(one)).and(height.le(top)).and(bottom.le(height));
                    if inside.any() {
                        let travel = V3::load(&columns, 3, i).dot(n);
                        let facing = V3::load(&columns, 9, i).dot(n);
                        let counts = inside.and(travel.lt(zero)).and(same_surface.le(facing));
                        if let Some(noted) = noted {
                            noted.note(i, counts.bits());
                        }
                        let filter = one - radial2.max(zero).sqrt() * inverse_k;
                        let weight = S::F8::select(counts, filter, zero);
                        let power = V3::<S::F8>::load(&columns, 6, i);
                        for (sum, power) in sum.iter_mut().zip(power.0) {
                            *sum = power.mul_add(weight, *sum);
                        }
                        pending += 1;
                        if pending == FLUSH {
                            flush(&mut sum, &mut total, zero);
                            pending = 0;
                        }
                    }
                    i += S::F8::WIDTH;
                }
            }
        }
        if pending > 0 {
            flush(&mut sum, &mut total, zero);
        }
        let s = cylinder.scale;
        // A photon in the middle of a disc of 1e-30 units must still give a number to which others can be added.
        let finite = |x: f64| x.min(crate::scene::BRIGHTEST as f64) as f32;
        [finite(total[0] * s), finite(total[1] * s), finite(total[2] * s)]
    }
}

/// Moves lane sums to f64.
#[inline(always)]
fn flush<L: Lanes>(sum: &mut [L; 3], total: &mut [f64; 3], zero: L) {
    for c in 0..3 {
        for &x in &sum[c].to_array()[..L::WIDTH] {
            total[c] += x as f64;
        }
        sum[c] = zero;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::memory::MemoryMonitor;
    use crate::base::progress::Progress;
    use crate::base::sampling::{sobol_2d, uniform, uniform_sphere};
    use crate::photon::trace::{Account, StoredPhoton, Traced};
    use crate::simd::Isa;
    use std::f64::consts::PI;
    use std::sync::Arc;

    fn grid_of(photons: &[StoredPhoton], radius: f32) -> Grid {
        let blocks = photons.chunks(37).map(<[_]>::to_vec).collect();
        let memory = Account::new(Arc::new(MemoryMonitor::new(None)), 0);
        let traced = Traced { blocks, stats: Default::default(), memory, guides: None };
        Grid::build(traced, radius, &Progress::none(), (0.0, 1.0)).unwrap().0
    }

    fn run(isa: Isa, grid: &Grid, cylinder: &Cylinder, p: Vec3, n: Vec3) -> [f32; 3] {
        let mut out = [[0.0; 3]];
        kernel(isa)(grid, cylinder, &[p.to_array()], &[n.to_array()], &mut out, None);
        out[0]
    }

    /// The estimate by the book in f64: what certainly counts, and what lies within rounding of a
    /// border.
    fn oracle(photons: &[StoredPhoton], c: [f32; 3], p: Vec3, n: Vec3) -> ([f64; 3], [f64; 3]) {
        let [r, half_height, k] = c.map(|x| x as f64);
        let n64 = n.as_dvec3();
        let (mut certain, mut border) = ([0.0; 3], [0.0; 3]);
        for photon in photons {
            let d = (photon.position.as_dvec3() - p.as_dvec3()) / r;
            let height = d.dot(n64);
            let radial = (d - n64 * height).length();
            let margins = [
                1.0 - radial,
                half_height - height.abs(),
                -photon.direction.as_dvec3().dot(n64),
                photon.normal.as_dvec3().dot(n64) - SAME_SURFACE as f64,
            ];
            let least = margins.into_iter().fold(f64::INFINITY, f64::min);
            let sum = if least > 1e-5 { &mut certain } else { &mut border };
            if least > -1e-5 {
                let scale = (1.0 - radial / k) / ((1.0 - 2.0 / (3.0 * k)) * PI * r * r);
                (0..3).for_each(|i| sum[i] += photon.power[i] as f64 * scale);
            }
        }
        (certain, border)
    }

    #[track_caller]
    fn check(photons: &[StoredPhoton], c: [f32; 3], queries: &[(Vec3, Vec3)]) -> f64 {
        let grid = grid_of(photons, c[0]);
        let cylinder = Cylinder::new(c[0], c[1], c[2]);
        let mut all = 0.0;
        for isa in Isa::available() {
            for &(p, n) in queries {
                let found = run(isa, &grid, &cylinder, p, n);
                let (certain, border) = oracle(photons, c, p, n);
                for i in 0..3 {
                    let slack = 1e-5 * (certain[i] + border[i]);
                    let range = certain[i] - slack..=certain[i] + border[i] + slack;
                    let e = found[i] as f64;
                    assert!(range.contains(&e), "{} at {p} along {n}: {e} not in {range:?}", isa.name());
                    all += e;
                }
            }
        }
        all
    }

    fn random(count: u32, seed: u32, place: impl Fn(Vec3) -> Vec3) -> Vec<StoredPhoton> {
        let photon = |i| {
            let at = |d| uniform(i, d, seed);
            StoredPhoton {
                position: place(Vec3::new(at(0), at(1), at(2))),
                direction: uniform_sphere([at(3), at(4)]).normalize(),
                power: Vec3::new(at(5), at(6), at(7)),
                normal: uniform_sphere([at(8), at(9)]).normalize(),
            }
        };
        (0..count).map(photon).collect()
    }

    fn queries(count: u32, place: impl Fn(Vec3) -> Vec3) -> Vec<(Vec3, Vec3)> {
        let query = |i| {
            let at = |d| uniform(i, d, 77);
            let n =
                if i % 4 == 0 { Vec3::AXES[i as usize / 4 % 3] } else { uniform_sphere(sobol_2d(i, 5)).normalize() };
            (place(Vec3::new(at(0), at(1), at(2))), n)
        };
        (0..count).map(query).collect()
    }

    #[test]
    fn weights_one_by_one_add_up_to_the_estimate() {
        let photon = |i| StoredPhoton {
            position: Vec3::new(uniform(i, 0, 1), uniform(i, 1, 1), 0.3 * uniform(i, 2, 1)),
            direction: uniform_sphere([uniform(i, 3, 1), uniform(i, 4, 1)]),
            power: Vec3::splat(uniform(i, 5, 1)),
            normal: uniform_sphere([uniform(i, 6, 1), uniform(i, 7, 1)]),
        };
        let photons: Vec<StoredPhoton> = (0..2000).map(photon).collect();
        let (position, normal) = (Vec3::new(0.5, 0.4, 0.1), Vec3::new(0.1, 0.2, 1.0).normalize());
        let (grid, cylinder) = (grid_of(&photons, 0.3), Cylinder::new(0.3, 0.25, 1.1));
        let mut e = [[0.0; 3]];
        kernel(Isa::Portable)(&grid, &cylinder, &[position.to_array()], &[normal.to_array()], &mut e, None);
        let view = grid.photons.view();
        let weight = |i| cylinder.weight(&view, i, position, normal).unwrap_or(0.0);
        let sum: f64 = (0..photons.len()).map(|i| f64::from(weight(i) * view.power[0][i])).sum();
        assert!(e[0][0] > 1.0 && (sum * cylinder.scale / f64::from(e[0][0]) - 1.0).abs() < 1e-5, "{sum} {e:?}");
    }

    #[test]
    fn it_equals_brute_force_in_a_cloud_at_any_radius_height_and_filter() {
        let photons = random(3_000, 1, |p| p);
        for (r, half_height, k) in [(0.2, 0.25, 1.1), (0.07, 1.0, 1.0), (0.5, 0.1, f32::INFINITY), (0.3, 4.0, 2.0)] {
            assert!(check(&photons, [r, half_height, k], &queries(200, |p| p)) > 0.0);
        }
    }

    #[test]
    fn it_equals_brute_force_outside_and_beyond_the_photons() {
        let photons = random(500, 2, |p| p);
        check(&photons, [0.4, 0.5, 1.1], &queries(300, |p| p * 3.0 - 1.0));
        assert!(check(&photons, [5.0, 2.0, 1.1], &queries(50, |p| p * 3.0 - 1.0)) > 0.0, "a radius beyond the scene");
    }

    #[test]
    fn it_equals_brute_force_at_huge_and_tiny_coordinates() {
        for scale in [1e-24, 1e-12, 1e9, 1e17] {
            for shift in [0.0, 40.0] {
                let place = |p: Vec3| (p + shift) * scale;
                let mut photons = random(1_000, 3, place);
                // So that the irradiance is a valid f32.
                photons.iter_mut().for_each(|p| p.power *= scale.min(1.0));
                assert!(check(&photons, [0.3 * scale, 0.4, 1.1], &queries(100, place)) > 0.0, "{scale} {shift}");
            }
        }
    }

    #[test]
    fn it_equals_brute_force_where_cells_are_capped_and_where_all_share_one() {
        // A tight cluster in a huge scene: no grid of cells the size of the radius would fit.
        let mut photons = random(2_000, 4, |p| p * 0.01);
        photons.push(StoredPhoton { position: Vec3::splat(1e4), ..photons[0] });
        let grid = grid_of(&photons, 1e-3);
        assert!(grid.bytes() < 2 * 64 * photons.len(), "{} bytes", grid.bytes());
        assert!(check(&photons, [2e-3, 0.5, 1.1], &queries(100, |p| p * 0.01)) > 0.0);
        let same = vec![photons[0]; 700];
        let (p, n) = (photons[0].position, photons[0].normal);
        check(&same, [1e-3, 0.5, 1.1], &[(p, n), (p, -photons[0].direction)]);
    }

    #[test]
    fn it_equals_brute_force_on_a_plane_whose_photons_lie_on_cell_borders() {
        let mut photons = random(4_096, 5, |p| p);
        for (i, p) in photons.iter_mut().enumerate() {
            p.position = Vec3::new((i % 64) as f32, (i / 64) as f32, 0.0) * 0.125;
            (p.normal, p.direction.z) = (Vec3::Z, -p.direction.z.abs());
        }
        let on_border = |p: Vec3| (p * 64.0).floor() * 0.125 * Vec3::new(1.0, 1.0, 0.0);
        for r in [0.25, 0.5, 1.0] {
            let at = queries(100, on_border).into_iter().map(|q| (q.0, Vec3::Z)).collect::<Vec<_>>();
            assert!(check(&photons, [r, 0.25, 1.1], &at) > 0.0);
        }
    }

    #[test]
    fn photons_exactly_on_the_border_of_the_cylinder_count() {
        let photon = |position| StoredPhoton { position, direction: -Vec3::Z, power: Vec3::ONE, normal: Vec3::Z };
        let places = [
            Vec3::new(0.25, 0.0, 0.0),
            Vec3::new(-0.25, 0.0, 0.0),
            Vec3::new(0.0, 0.25, 0.0),
            Vec3::new(0.0, -0.25, 0.0625),
            Vec3::new(0.0, 0.0, -0.0625),
        ];
        let just_outside = [Vec3::new(0.25000006, 0.0, 0.0), Vec3::new(0.0, 0.0, 0.062500015)];
        let photons: Vec<_> = places.into_iter().chain(just_outside).map(photon).collect();
        let grid = grid_of(&photons, 0.25);
        for isa in Isa::available() {
            let found = run(isa, &grid, &Cylinder::new(0.25, 0.25, f32::INFINITY), Vec3::ZERO, Vec3::Z);
            let expected = 5.0 / (PI * 0.0625);
            assert!((found[0] as f64 / expected - 1.0).abs() < 1e-6, "{}: {} for {expected}", isa.name(), found[0]);
        }
    }

    #[test]
    fn an_empty_map_is_dark_and_nonsense_is_too() {
        let cylinder = Cylinder::new(0.1, 0.25, 1.1);
        let empty = grid_of(&[], 0.1);
        let full = grid_of(&random(100, 6, |p| p), 0.1);
        for isa in Isa::available() {
            assert_eq!(run(isa, &empty, &cylinder, Vec3::ZERO, Vec3::Z), [0.0; 3]);
            for x in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX] {
                assert_eq!(run(isa, &full, &cylinder, Vec3::new(0.5, x, 0.5), Vec3::Z), [0.0; 3]);
                assert_eq!(run(isa, &full, &cylinder, Vec3::splat(x), Vec3::Z), [0.0; 3]);
            }
            assert_eq!(run(isa, &full, &cylinder, Vec3::splat(0.5), Vec3::NAN), [0.0; 3]);
        }
    }

    #[test]
    fn a_disc_of_a_million_photons_loses_none_to_rounding() {
        let photon =
            StoredPhoton { direction: -Vec3::Z, power: Vec3::splat(0.1), normal: Vec3::Z, ..Default::default() };
        let grid = grid_of(&vec![photon; 1_000_000], 1.0);
        for isa in Isa::available() {
            let found = run(isa, &grid, &Cylinder::new(1.0, 0.25, f32::INFINITY), Vec3::ZERO, Vec3::Z);
            let error = found[1] as f64 / (1e6 * 0.1f32 as f64 / PI) - 1.0;
            assert!(error.abs() < 0.5f64.powi(19), "{}: {error}", isa.name());
        }
    }
}
