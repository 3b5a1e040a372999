//! One table of kernel entry points per ISA.

use super::{PACKET_SIZE, Packet, RawHit, Ray};
use crate::bvh::Mbvh;
use crate::simd::Isa;
use glam::Vec3;

pub(crate) struct Kernels {
    pub(crate) isa: Isa,
}

impl Kernels {
    pub(crate) fn for_isa(isa: Isa) -> &'static Kernels {
        static T: [Kernels; 3] =
            [Kernels { isa: Isa::Portable }, Kernels { isa: Isa::Avx2 }, Kernels { isa: Isa::Avx512 }];
        &T[isa as usize - 1]
    }
    pub(crate) fn intersect(&self, bvh: &Mbvh, ray: &Ray) -> RawHit {
        // PLACEHOLDER until the kernels land: brute force
        let (o, d) = (Vec3::from_array(ray.origin), Vec3::from_array(ray.direction));
        let mut best = RawHit { t: ray.tmax, ..RawHit::MISS };
        for (id, [a, b, c]) in &bvh.tris {
            let (e1, e2) = (*b - *a, *c - *a);
            let p = d.cross(e2);
            let det = e1.dot(p);
            if det == 0.0 {
                continue;
            }
            let s = o - *a;
            let u = s.dot(p) / det;
            let q = s.cross(e1);
            let v = d.dot(q) / det;
            let t = e2.dot(q) / det;
            if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > ray.tmin && t <= best.t {
                best = RawHit { t, u, v, triangle: *id };
            }
        }
        if best.is_miss() { RawHit::MISS } else { best }
    }
    pub(crate) fn occluded(&self, bvh: &Mbvh, ray: &Ray) -> bool {
        !self.intersect(bvh, ray).is_miss()
    }
    pub(crate) fn gather(
        &self,
        bvh: &Mbvh,
        origin: Vec3,
        p: &Packet,
        tmin: f32,
        tmax: f32,
        out: &mut [RawHit; PACKET_SIZE],
    ) {
        for i in 0..p.count {
            out[i] = self.intersect(bvh, &Ray::new(origin, Vec3::new(p.x[i], p.y[i], p.z[i])).within(tmin, tmax));
        }
    }
}
