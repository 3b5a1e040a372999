//! The floating-point state of a thread: the library computes in its own, whatever the caller has set.
//!
//! On x86-64 that is MXCSR (no x87 instruction is used), on AArch64 FPCR: rounding to nearest, no flushing of
//! denormals, all exceptions masked. On other architectures nothing is set.
//!
//! Sources: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 1, section 10.2.3; Arm
//! Architecture Reference Manual for A-profile, section C5.2.8.

use std::cell::Cell;

#[cfg(target_arch = "x86_64")]
mod register {
    use std::arch::asm;

    pub(super) type Word = u32;

    /// All exceptions masked, rounding to nearest, neither FTZ nor DAZ.
    pub(super) const DEFAULT: Word = 0x1f80;

    /// The sticky flags of exceptions, which do not affect results.
    pub(super) const FLAGS: Word = 0x3f;

    #[inline(always)]
    pub(super) fn read() -> Word {
        let mut word: Word = 0;
        // SAFETY: writes MXCSR to the variable and does nothing else; every x86-64 CPU has it.
        unsafe { asm!("stmxcsr [{}]", in(reg) &raw mut word, options(nostack, preserves_flags)) };
        word
    }

    #[inline(always)]
    pub(super) fn write(word: Word) {
        // SAFETY: the word was read from MXCSR or is its default, so that no reserved bit is set. What runs
        // in between is either the library, in its default state, or the caller's own code.
        unsafe { asm!("ldmxcsr [{}]", in(reg) &raw const word, options(nostack, preserves_flags)) };
    }
}

#[cfg(target_arch = "aarch64")]
mod register {
    use std::arch::asm;

    pub(super) type Word = u64;

    /// No trap is enabled, rounding to nearest, no flushing, NaNs propagate.
    pub(super) const DEFAULT: Word = 0;

    /// The flags of exceptions are in another register, FPSR.
    pub(super) const FLAGS: Word = 0;

    #[inline(always)]
    pub(super) fn read() -> Word {
        let word: Word;
        // SAFETY: reads FPCR, which every AArch64 CPU with floating point lets every program read.
        unsafe { asm!("mrs {}, fpcr", out(reg) word, options(nostack, preserves_flags)) };
        word
    }

    #[inline(always)]
    pub(super) fn write(word: Word) {
        // SAFETY: the word was read from FPCR or is its default. What runs in between is either the library,
        // in its default state, or the caller's own code.
        unsafe { asm!("msr fpcr, {}", in(reg) word, options(nostack, preserves_flags)) };
    }
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
mod register {
    pub(super) type Word = u32;
    pub(super) const DEFAULT: Word = 0;
    pub(super) const FLAGS: Word = 0;

    #[inline(always)]
    pub(super) fn read() -> Word {
        DEFAULT
    }

    #[inline(always)]
    pub(super) fn write(_: Word) {}
}

use register::{DEFAULT, FLAGS, Word, read, write};

thread_local! {
    /// The state that the code that called the library on this thread has set.
    static OUTSIDE: Cell<Word> = const { Cell::new(DEFAULT) };
}

#[inline(always)]
fn is_default(word: Word) -> bool {
    (word ^ DEFAULT) & !FLAGS == 0
}

/// Sets the library's state on a thread that the library has started. (Threads inherit the state of those which
/// start them.)
pub(crate) fn set_on_own_thread() {
    write(DEFAULT);
}

/// Guard that sets the library's floating-point state; when dropped, it restores the caller's.
///
/// If the caller's state is the same already, as it mostly is, only the register is read.
pub(crate) struct LibraryState {
    /// The caller's state and the one outside of the previous call, if they are not the default.
    outside: Option<(Word, Word)>,
}

impl LibraryState {
    #[inline(always)]
    pub(crate) fn enter() -> LibraryState {
        let caller = read();
        LibraryState { outside: if is_default(caller) { None } else { Some(replace(caller)) } }
    }
}

#[cold]
fn replace(caller: Word) -> (Word, Word) {
    write(DEFAULT);
    // While a thread ends, the slot may be gone: callbacks get the default then.
    (caller, OUTSIDE.try_with(|outside| outside.replace(caller)).unwrap_or(DEFAULT))
}

impl Drop for LibraryState {
    #[inline(always)]
    fn drop(&mut self) {
        if let Some(outside) = self.outside {
            restore(outside);
        }
    }
}

#[cold]
fn restore((caller, before): (Word, Word)) {
    let _ = OUTSIDE.try_with(|outside| outside.set(before));
    write(caller);
}

/// Guard that sets the state of the code that called the library on this thread; when dropped, it sets the library's
/// again, whatever a callback has set meanwhile. On the library's own threads both are the default.
pub(crate) struct CallersState {
    outside: Word,
}

impl CallersState {
    pub(crate) fn enter() -> CallersState {
        // Callbacks of library calls that the callback makes run in the state that it has set, or else in the default.
        let outside = OUTSIDE.try_with(|outside| outside.replace(DEFAULT)).unwrap_or(DEFAULT);
        if !is_default(outside) {
            write(outside);
        }
        CallersState { outside }
    }
}

impl Drop for CallersState {
    fn drop(&mut self) {
        let _ = OUTSIDE.try_with(|outside| outside.set(self.outside));
        if !is_default(read()) {
            write(DEFAULT);
        }
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;

    /// Rounding towards zero, FTZ and DAZ, invalid operations and divisions by zero not masked.
    const STRANGE: Word = (0x1f80 | 0x6000 | 0x8040) & !(1 << 7 | 1 << 9);

    #[test]
    fn a_strange_state_is_replaced_and_comes_back() {
        write(STRANGE);
        {
            let _state = LibraryState::enter();
            assert!(is_default(read()));
            // Would be a signal in the caller's state.
            assert!((std::hint::black_box(0.0f32) / std::hint::black_box(0.0)).is_nan());
            {
                let _callback = CallersState::enter();
                assert_eq!(read() & !FLAGS, STRANGE);
                {
                    // The callback calls the library, from a state of its own.
                    write(DEFAULT | 0x2000);
                    let _state = LibraryState::enter();
                    assert!(is_default(read()));
                }
                assert_eq!(read() & !FLAGS, DEFAULT | 0x2000);
                // It calls once more, from the default state, and is called back in that.
                write(DEFAULT);
                let _state = LibraryState::enter();
                let _callback = CallersState::enter();
                assert!(is_default(read()));
            }
            {
                let _callback = CallersState::enter();
                assert_eq!(read() & !FLAGS, STRANGE);
            }
            assert!(is_default(read()));
            drop(CallersState::enter());
        }
        assert_eq!(read() & !FLAGS, STRANGE);
        write(DEFAULT);
    }

    #[test]
    fn flags_alone_are_no_other_state() {
        write(DEFAULT | FLAGS);
        assert!(LibraryState::enter().outside.is_none());
        write(DEFAULT);
    }
}
