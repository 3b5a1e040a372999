#!/usr/bin/env bash
# The C and C++ programs, and the library as far as it goes, under tools that watch memory.
#
#     capi-tests/sanitize.sh              c: what continuous integration runs, a minute or two
#     capi-tests/sanitize.sh all          all of the below but threads
#
# c         AddressSanitizer with LeakSanitizer and UndefinedBehaviorSanitizer in every C and C++ program. They see
#           the programs' own memory, what the library does to it by way of the C library, and all leaks. The library
#           is the release build, or that in the folder BAKELITE_LIBRARY_DIR, with `io` and `unwrap`.
# rust      The library too is compiled with AddressSanitizer (nightly toolchain, clang): its small unit tests, a short
#           run of fuzz_api, and the C programs against it. A quarter of an hour on two cores.
# valgrind  Memcheck over a small whole pipeline in C, with the kernels that Valgrind knows (at most AVX2).
# miri      Miri over the unit tests that need no large scene: lanes, handles, arguments, locks, samples
#           (nightly toolchain with miri and rust-src). Under it the portable kernels alone are available.
#
# CC, CXX: compilers (default cc, c++).
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
target=${CARGO_TARGET_DIR:-$root/target}
out=$target/sanitize
mkdir -p "$out"
export ASAN_OPTIONS=detect_leaks=1:strict_string_checks=1 UBSAN_OPTIONS=print_stacktrace=1
verdict=0

# run NAME COMMAND...: prints what failed, and its output.
run() {
    local name=$1
    shift
    if "$@" >"$out/$name.log" 2>&1; then
        echo "   $name: clean"
    else
        echo "   $name: FAILED"
        tail -40 "$out/$name.log"
        verdict=1
    fi
}

# program SOURCE FOLDER FLAGS...: one C or C++ test program, linked with the library in FOLDER, and run. Fails if that fails:
# `run` sets the verdict here, not the script's.
program() {
    local source=$1 library=$2 name verdict=0 compiler
    shift 2
    name=$(basename "$source")
    compiler=("${CC:-cc}" -std=gnu99)
    [ "${name##*.}" = c ] || compiler=("${CXX:-c++}" -std=c++17)
    mkdir -p "$out/$name.out"
    run "build-$name" "${compiler[@]}" -g -O1 -fno-omit-frame-pointer "$@" -I include "$source" -o "$out/$name.bin" \
        -L "$library" -lbakelite -lpthread -lm
    [ $verdict != 0 ] || run "$name" env LD_LIBRARY_PATH="$library" "$out/$name.bin" "$out/$name.out/"
    rm -rf "$out/$name.bin" "$out/$name.out"
    return $verdict
}

# programs FOLDER FLAGS...: every C and C++ test program, two at a time; but not runtime.c, whose stacks are too small for
# sanitizers, nor storage_faults.c, whose children end by signals and in the middle of work.
programs() {
    local source
    rm -f "$out/failed"
    for source in $(grep -l 'check\.h' capi-tests/c/*.c capi-tests/c/*.cpp | grep -v 'runtime\.c\|storage_faults\.c'); do
        [ "$(jobs -rp | wc -l)" -lt 2 ] || wait -n || true
        { program "$source" "$@" || touch "$out/failed"; } &
    done
    wait
    [ ! -e "$out/failed" ] || verdict=1
}

# shared: the shared library, with all that the programs call.
shared() {
    cargo rustc --release --locked --features io,unwrap --lib --crate-type cdylib
}

c() {
    echo '== C and C++ programs under AddressSanitizer, LeakSanitizer and UndefinedBehaviorSanitizer'
    [ -n "${BAKELITE_LIBRARY_DIR:-}" ] || shared
    programs "${BAKELITE_LIBRARY_DIR:-$target/release}" -fsanitize=address,undefined -fno-sanitize-recover=undefined
}

rust() {
    echo '== The library under AddressSanitizer'
    local triple library
    triple=$(rustc +nightly -vV | sed -n 's/^host: //p')
    library=$target/asan/$triple/release
    export RUSTFLAGS=-Zsanitizer=address CARGO_TARGET_DIR=$target/asan
    run asan-unit cargo +nightly test --release --locked --features io,unwrap --target "$triple" --lib -- \
        simd:: trace:: bvh:: capi:: io:: memory:: device:: live::save
    run asan-fuzz cargo +nightly test --release --locked --features io,unwrap --target "$triple" --test fuzz_api
    run asan-library cargo +nightly rustc --release --locked --features io,unwrap --target "$triple" --lib --crate-type cdylib
    unset RUSTFLAGS CARGO_TARGET_DIR
    # The run time of the sanitizer comes with the program.
    CC=clang CXX=clang++ programs "$library" -fsanitize=address
}

memcheck() {
    echo '== A small pipeline under Valgrind'
    shared
    "${CC:-cc}" -std=gnu99 -g -O1 -I include capi-tests/c/small_pipeline.c -o "$out/small_pipeline" \
        -L "$target/release" -lbakelite -lpthread -lm
    mkdir -p "$out/small_pipeline.out"
    run valgrind env LD_LIBRARY_PATH="$target/release" valgrind --error-exitcode=9 --leak-check=full \
        --errors-for-leak-kinds=definite "$out/small_pipeline" "$out/small_pipeline.out/"
}

miri() {
    echo '== Unit tests under Miri'
    export CARGO_TARGET_DIR=$target/miri MIRIFLAGS=-Zmiri-disable-isolation
    run miri cargo +nightly miri test --locked --no-default-features --lib -- \
        simd:: capi::args capi::error capi::handles capi::shared
    unset CARGO_TARGET_DIR MIRIFLAGS
}

case ${1:-c} in
    c | rust | miri) "${1:-c}" ;;
    valgrind) memcheck ;;
    all)
        c
        rust
        memcheck
        miri
        ;;
    *)
        sed -n '2,/^set/p' "$0" | grep '^#'
        exit 2
        ;;
esac
[ $verdict = 0 ] && echo 'clean' || echo 'NOT clean'
exit $verdict
