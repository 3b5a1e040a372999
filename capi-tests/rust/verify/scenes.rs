//! Scenes made to hurt, and rays at them.

use super::oracle::Triangle;
use bakelite::sampling::{combine, sobol_2d, uniform, uniform_sphere};
use glam::{DVec3, Vec3};
use std::f64::consts::{PI, TAU};

/// A point of the cube [−1, 1]³, by number.
pub fn point(index: u32, dimension: u32, seed: u32) -> Vec3 {
    let x = |k| uniform(index, 3 * dimension + k, seed);
    Vec3::new(x(0), x(1), x(2)) * 2.0 - 1.0
}

pub fn direction(index: u32, seed: u32) -> Vec3 {
    uniform_sphere(sobol_2d(index, seed))
}

/// An integer in 0..n.
pub fn below(n: usize, index: u32, dimension: u32, seed: u32) -> usize {
    ((uniform(index, dimension, seed) as f64 * n as f64) as usize).min(n - 1)
}

/// Triangles of random shape in the unit cube.
pub fn soup(n: u32, size: f32, seed: u32) -> Vec<Triangle> {
    (0..n)
        .map(|i| {
            let p = point(i, 0, seed);
            [p, p + size * point(i, 1, seed), p + size * point(i, 2, seed)]
        })
        .collect()
}

/// A closed sphere, one vertex position per ring and segment.
pub fn sphere(centre: Vec3, radius: f64, segments: u32, rings: u32) -> Vec<Triangle> {
    let p = |i: u32, j: u32| {
        let (theta, phi) = (PI * j as f64 / rings as f64, TAU * (i % segments) as f64 / segments as f64);
        let r = if j == 0 || j == rings { 0.0 } else { theta.sin() };
        (centre.as_dvec3() + radius * DVec3::new(r * phi.cos(), r * phi.sin(), theta.cos())).as_vec3()
    };
    let mut out = Vec::new();
    for j in 0..rings {
        for i in 0..segments {
            if j + 1 < rings {
                out.push([p(i, j), p(i, j + 1), p(i + 1, j + 1)]);
            }
            if j > 0 {
                out.push([p(i, j), p(i + 1, j + 1), p(i + 1, j)]);
            }
        }
    }
    out
}

/// Planes of unit squares across each axis, at the coordinates `planes`, from 0 to n.
pub fn grid(n: i32, planes: &[i32]) -> Vec<Triangle> {
    let mut out = Vec::new();
    for axis in 0..3 {
        for &k in planes {
            for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
                let p = |i: i32, j: i32| {
                    let mut v = [0.0; 3];
                    (v[axis], v[(axis + 1) % 3], v[(axis + 2) % 3]) = (k as f32, i as f32, j as f32);
                    Vec3::from(v)
                };
                out.push([p(i, j), p(i + 1, j), p(i + 1, j + 1)]);
                out.push([p(i, j), p(i + 1, j + 1), p(i, j + 1)]);
            }
        }
    }
    out
}

/// n triangles around one vertex, each sharing an edge with the next; a wavy disc.
pub fn fan(n: u32) -> Vec<Triangle> {
    let rim = |i: u32| {
        let phi = TAU * (i % n) as f64 / n as f64;
        DVec3::new(phi.cos(), phi.sin(), 0.3 * (3.0 * phi).sin()).as_vec3()
    };
    let hub = Vec3::new(0.1, -0.05, 0.2);
    (0..n).map(|i| [hub, rim(i), rim(i + 1)]).collect()
}

/// Triangles of length 1 and width `width`.
pub fn needles(n: u32, width: f32, seed: u32) -> Vec<Triangle> {
    (0..n)
        .map(|i| {
            let (a, along, across) = (point(i, 0, seed), direction(i, seed), point(i, 1, seed));
            [a, a + along, a + 0.7 * along + width * across]
        })
        .collect()
}

/// Sheets of one tilted quad on top of each other: exact copies, copies with corners in other
/// order, and partly overlapping ones in the same plane.
pub fn coplanar_stack(n: u32) -> Vec<Triangle> {
    // Corners in quarters on the plane z = x / 2 are exact, so the sheets are exactly coplanar.
    let p = |x: f32, y: f32| Vec3::new(x, y, 0.5 * x);
    let quad =
        |x: f32, y: f32| [[p(x, y), p(x + 1.0, y), p(x + 1.0, y + 1.0)], [p(x, y), p(x + 1.0, y + 1.0), p(x, y + 1.0)]];
    (0..n)
        .flat_map(|i| {
            let shift = 0.25 * (i % 5) as f32;
            quad(shift, if i % 2 == 0 { shift } else { -shift }).map(|[a, b, c]| match i % 3 {
                0 => [a, b, c],
                1 => [b, c, a],
                _ => [c, b, a],
            })
        })
        .collect()
}

/// A soup of size 1 with one a million times smaller in it.
pub fn two_scales(n: u32, seed: u32) -> Vec<Triangle> {
    let mut out = soup(n, 0.7, seed);
    out.extend(soup(n, 0.7, seed ^ 1).into_iter().map(|t| t.map(|v| v * 1e-6)));
    out
}

/// One huge triangle over many small ones.
pub fn giant_over_small(n: u32, seed: u32) -> Vec<Triangle> {
    let mut out = soup(n, 0.1, seed);
    out.insert(n as usize / 2, [Vec3::new(-1e5, -1e5, 1.0), Vec3::new(1e5, -1e5, 1.5), Vec3::new(0.0, 1e5, 2.0)]);
    out
}

/// Triangles of many sizes and directions, all with the same centroid.
pub fn equal_centroids(n: u32, seed: u32) -> Vec<Triangle> {
    (0..n)
        .map(|i| {
            let size = 1.0 / (1 + i % 16) as f32;
            let (a, b) = (size * point(i, 0, seed), size * point(i, 1, seed));
            [a, b, -(a + b)]
        })
        .collect()
}

/// Triangles each `ratio` times the size of the one before, at that distance from 0: splitting by
/// area takes them off one by one.
pub fn geometric_chain(n: u32, largest: f64, ratio: f64) -> Vec<Triangle> {
    (0..n)
        .map(|i| {
            let s = largest * ratio.powi(i as i32);
            let v = |x: f64, y: f64, z: f64| (s * DVec3::new(x, y, z)).as_vec3();
            [v(1.0, -0.4, -0.4), v(1.0, 0.6, -0.3), v(1.0, -0.1, 0.7)]
        })
        .collect()
}

/// Good triangles with all sorts of unusable ones between them.
pub fn with_degenerates(n: u32, seed: u32) -> Vec<Triangle> {
    let mut out = Vec::new();
    for (i, [a, b, c]) in soup(n, 0.6, seed).into_iter().enumerate() {
        out.push(match i % 8 {
            0 => [a, a, a],
            1 => [a, b, a],
            // Exactly on a line: quarters are exact.
            2 => {
                let a = (a * 4.0).round() / 4.0;
                [a, a + Vec3::X, a + 0.5 * Vec3::X]
            }
            3 => [a, b, Vec3::new(f32::NAN, c.y, c.z)],
            4 => [a, Vec3::new(b.x, f32::INFINITY, b.z), c],
            5 => [Vec3::new(a.x, a.y, f32::NEG_INFINITY), b, c],
            6 => [a, b * 3e12, c],
            _ => [a, b, c],
        });
        out.push([a, b, c]);
    }
    out
}

/// Triangles one to a few ulps wide.
pub fn slivers(n: u32, seed: u32) -> Vec<Triangle> {
    (0..n)
        .map(|i| {
            let (a, b) = (point(i, 0, seed), point(i, 1, seed));
            let mut c = a.lerp(b, uniform(i, 9, seed));
            let k = below(3, i, 10, seed);
            (0..1 + i % 4).for_each(|_| c[k] = c[k].next_up());
            [a, b, c]
        })
        .collect()
}

/// Box around what is finite and in range.
pub fn bounds(triangles: &[Triangle]) -> (Vec3, Vec3) {
    let good = triangles.iter().filter(|t| super::oracle::is_in_range(t)).flatten();
    good.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lower, upper), &v| (lower.min(v), upper.max(v)))
}

/// A point to aim at: of the triangle's inside, of an edge, or a corner.
pub fn target(triangle: &Triangle, index: u32, seed: u32) -> Vec3 {
    let x = |k| uniform(index, k, seed);
    let k = below(3, index, 20, seed);
    let (a, b, c) = (triangle[k], triangle[(k + 1) % 3], triangle[(k + 2) % 3]);
    match index % 4 {
        0 => a + x(21).sqrt() * ((b - a) + x(22) * (c - b)),
        1 => a.midpoint(b),
        2 => a.lerp(b, x(21)),
        _ => a,
    }
}

/// An origin: in or around the scene, on a surface, on a corner, far away, or on a lattice point.
pub fn origin(triangles: &[Triangle], index: u32, seed: u32) -> Vec3 {
    let (lower, upper) = bounds(triangles);
    let (centre, half) = (lower.midpoint(upper), (upper - lower) * 0.5);
    let usable: Vec<&Triangle> = triangles.iter().filter(|t| super::oracle::is_in_range(t)).collect();
    let triangle = usable[below(usable.len(), index, 30, seed)];
    match index % 8 {
        0 | 1 => centre + 0.9 * half * point(index, 11, seed),
        2 => centre + 2.0 * half * point(index, 11, seed),
        3 => centre + 20.0 * half.max_element() * direction(index, seed),
        4 => target(triangle, 4 * index, seed),
        5 => triangle[index as usize / 8 % 3],
        6 => (4.0 * (centre + half * point(index, 11, seed))).round() / 4.0,
        // Close to a surface.
        _ => target(triangle, 4 * index, seed) + 0.01 * half * point(index, 12, seed),
    }
}

/// Directions from one origin: all round, at targets, along axes, of any length.
pub fn directions(triangles: &[Triangle], origin: Vec3, n: u32, seed: u32) -> Vec<[f32; 3]> {
    let one = |i: u32| {
        let d = match below(8, i, 40, seed) {
            0..=2 => direction(i, seed),
            3 => {
                let mut axis = [if i.is_multiple_of(2) { 0.0 } else { -0.0 }; 3];
                axis[below(3, i, 41, seed)] = if i % 4 < 2 { 1.0 } else { -1.0 };
                axis.into()
            }
            _ => target(&triangles[below(triangles.len(), i, 42, seed)], combine(i, 43), seed) - origin,
        };
        // Whole packets of plain lengths and packets with odd ones in them.
        let odd = (i / 32) % 3 == 2 && i.is_multiple_of(8);
        let d = if odd { d * 2f32.powi(below(120, i, 44, seed) as i32 - 60) } else { d };
        d.to_array()
    };
    (0..n).map(one).collect()
}
