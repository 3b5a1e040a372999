//! Rays through a 4-wide tree, the MBVH of the thesis (3.1.2), by the kernels of the 8-wide one. Scenes have 8-wide trees, in
//! which rays take less time on every instruction set (docs/experiments.md#four-wide-trees): this one is for tables and
//! papers that ask for it.

use super::{RawHit, Ray, single, stream};
use crate::base::error::{Result, invalid_argument};
use crate::base::geometry::is_valid_triangle;
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use crate::bvh::{self, BuildOptions, ChildRef, Mbvh, References};
use crate::scene::Scene;
use crate::simd::{self, Isa, entry_point, isa_features};

/// The 4-wide tree of a scene's triangles. Hits are those of the scene, bit for bit, except for what spatial splits change.
pub struct FourWide {
    tree: Mbvh<4>,
    kernels: Kernels,
}

impl FourWide {
    /// Builds the tree for the instruction set of the scene's device, on the device's threads.
    ///
    /// # Errors
    /// Options outside their ranges, a scene without triangles that can be hit, not enough memory.
    pub fn new(scene: &Scene, options: &BuildOptions) -> Result<FourWide> {
        let (corners, none) = (|t: u32| scene.corners(t), Progress::none());
        let tree = scene.device().install(|| {
            let references = References::of_valid(
                scene.triangle_count() as usize,
                &corners,
                is_valid_triangle,
                Storage::MEMORY,
                &none,
            )?;
            if references.len() == 0 {
                return invalid_argument!("the scene has no triangle that can be hit");
            }
            bvh::build_four_wide(&corners, references, options, &none)
        })?;
        Ok(FourWide { tree, kernels: Kernels::of(scene.device().isa()) })
    }

    /// Number of nodes.
    pub fn node_count(&self) -> usize {
        self.tree.node_count()
    }

    /// Closest hit of one ray.
    pub fn intersect(&self, ray: &Ray) -> RawHit {
        // SAFETY: the kernels are those of a device's ISA, which the machine can run.
        unsafe { (self.kernels.intersect)(&self.tree, ray) }
    }

    /// Whether a ray hits anything.
    pub fn occluded(&self, ray: &Ray) -> bool {
        // SAFETY: as above.
        unsafe { (self.kernels.occluded)(&self.tree, ray) }
    }

    /// Closest hits of as many rays as both slices have, many of them under way at the same time.
    pub fn intersect_many(&self, rays: &[Ray], out: &mut [RawHit]) {
        // SAFETY: as above.
        unsafe { (self.kernels.many)(&self.tree, rays, out) }
    }

    /// Closest hits of as many rays as both slices have, as a stream.
    pub fn stream(&self, rays: &[Ray], out: &mut [RawHit]) {
        // SAFETY: as above.
        unsafe { (self.kernels.stream)(&self.tree, rays, out) }
    }
}

/// Kernels of one ISA.
#[derive(Clone, Copy)]
struct Kernels {
    intersect: unsafe fn(&Mbvh<4>, &Ray) -> RawHit,
    occluded: unsafe fn(&Mbvh<4>, &Ray) -> bool,
    many: unsafe fn(&Mbvh<4>, &[Ray], &mut [RawHit]),
    stream: unsafe fn(&Mbvh<4>, &[Ray], &mut [RawHit]),
}

macro_rules! kernels {
    ($module:ident, $isa:ident) => {
        mod $module {
            use super::*;
            use simd::$isa as S;

            isa_features! { $isa => entry_point! {
                fn intersect(tree: &Mbvh<4>, ray: &Ray) -> RawHit { single::one::<S, _, false>(tree, ray) }
            } }
            isa_features! { $isa => entry_point! {
                fn occluded(tree: &Mbvh<4>, ray: &Ray) -> bool { !single::one::<S, _, true>(tree, ray).is_miss() }
            } }
            isa_features! { $isa => entry_point! {
                fn many(tree: &Mbvh<4>, rays: &[Ray], out: &mut [RawHit]) {
                    let n = rays.len().min(out.len());
                    single::many::<S, _, false>(tree, ChildRef::ROOT, n, |i| rays[i], |i, hit| out[i] = hit)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn streamed(tree: &Mbvh<4>, rays: &[Ray], out: &mut [RawHit]) {
                    let n = rays.len().min(out.len());
                    stream::stream::<S, _, false>(tree, ChildRef::ROOT, &rays[..n], |i, hit| out[i] = hit)
                }
            } }

            pub(super) static TABLE: Kernels = Kernels { intersect, occluded, many, stream: streamed };
        }
    };
}

kernels!(portable, Portable);
#[cfg(target_arch = "x86_64")]
kernels!(avx2, Avx2);
#[cfg(target_arch = "x86_64")]
kernels!(avx512, Avx512);
#[cfg(target_arch = "x86_64")]
kernels!(vbmi2, Avx512Vbmi2);

impl Kernels {
    fn of(isa: Isa) -> Kernels {
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => avx2::TABLE,
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => Kernels {
                stream: if Isa::has_vbmi2() { vbmi2::TABLE.stream } else { avx512::TABLE.stream },
                ..avx512::TABLE
            },
            _ => portable::TABLE,
        }
    }
}
