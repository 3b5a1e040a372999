//! Dispatch of kernels that are a single function: an entry point per ISA, and the choice between them.

/// Defines a kernel of a single function, and the function `$pick` that returns its entry point for an ISA: the
/// portable one if the machine cannot run the ISA. In the body, `$lanes` are the ISA's vectors; it may call whatever
/// needs nothing but the ISA.
macro_rules! kernel {
    ($(#[$doc:meta])* $visible:vis fn $pick:ident -> $pointer:ty;
        fn $name:ident<$lanes:ident>($($arg:ident: $type:ty),*) $body:block
    ) => {
        $(#[$doc])*
        $visible fn $pick(isa: $crate::simd::Isa) -> $pointer {
            match isa {
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Isa::Avx2 if isa.is_available() => avx2::checked,
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Isa::Avx512 if isa.is_available() => avx512::checked,
                _ => portable::checked,
            }
        }

        $crate::simd::kernel! { @portable Portable $name $lanes ($($arg: $type),*) $body }
        #[cfg(target_arch = "x86_64")]
        $crate::simd::kernel! { @avx2 Avx2 $name $lanes ($($arg: $type),*) $body }
        #[cfg(target_arch = "x86_64")]
        $crate::simd::kernel! { @avx512 Avx512 $name $lanes ($($arg: $type),*) $body }
    };
    (@$module:ident $isa:ident $name:ident $lanes:ident ($($arg:ident: $type:ty),*) $body:block) => {
        mod $module {
            use super::*;
            use $crate::simd::{entry_point, isa_features, $isa as $lanes};

            isa_features! { $isa => entry_point! { fn $name($($arg: $type),*) $body } }

            /// Calls the entry point. Safe, as it leaves the module through `the function that picks it` alone.
            pub(super) fn checked($($arg: $type),*) {
                // SAFETY: it is picked only after `is_available` has said that the machine has the ISA.
                unsafe { $name($($arg),*) }
            }
        }
    };
}
pub(crate) use kernel;
