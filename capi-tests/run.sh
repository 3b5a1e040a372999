#!/usr/bin/env bash
# All tests, on a fresh Debian or Ubuntu machine with a Rust toolchain: installs what is missing,
# runs the Rust tests, builds the C and C++ programs with CMake and runs ctest. The exit code is the
# verdict; the last line counts.
#
#     capi-tests/run.sh
#
# BAKELITE_SCENES: a folder of real scenes to compare with Embree on, beside the built-in ones
# (default: ../shared/scenes, if there is such a folder).
# PROPTEST_RNG_SEED, PROPTEST_CASES: where property tests start (the same place each time, so that a
# failure is the change's) and how many cases they try. To look for what no run has met yet:
#     PROPTEST_CASES=10000 cargo test --release --locked --all-features
# BAKELITE_ISA: portable or avx2, to test what machines without better instruction sets run.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD

# ---- What is missing ----

need=()
command -v cmake >/dev/null || need+=(cmake)
command -v make >/dev/null || need+=(make)
command -v g++ >/dev/null || need+=(g++)
command -v pkg-config >/dev/null || need+=(pkg-config)
command -v python3 >/dev/null || need+=(python3)
/usr/bin/python3 -c 'import numpy' 2>/dev/null || need+=(python3-numpy)
command -v doxygen >/dev/null || need+=(doxygen)
[ -e /usr/include/embree3/rtcore.h ] || need+=(libembree-dev)
command -v mpirun >/dev/null || need+=(libopenmpi-dev openmpi-bin)
# The viewer, and a screen and OpenGL in software to test it with.
[ -e /usr/include/GLFW/glfw3.h ] || need+=(libglfw3-dev)
[ -e /usr/include/GL/glcorearb.h ] || need+=(libgl-dev)
command -v xvfb-run >/dev/null || need+=(xvfb xauth)
ls /usr/lib/*/dri/swrast_dri.so >/dev/null 2>&1 || need+=(libgl1-mesa-dri)
if [ ${#need[@]} -gt 0 ]; then
    echo "== Installing with apt: ${need[*]}"
    sudo=()
    [ "$(id -u)" = 0 ] || sudo=(sudo)
    "${sudo[@]}" apt-get update -qq
    "${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${need[@]}" >/dev/null
fi
command -v cargo >/dev/null || {
    echo 'There is no cargo: install Rust first, see https://rustup.rs' >&2
    exit 1
}
embree=ON
if [ ! -e /usr/include/embree3/rtcore.h ]; then
    embree=OFF
    echo '== The package libembree-dev of this system is not Embree 3: THE COMPARISON WITH EMBREE IS LEFT OUT'
fi
viewer=ON
if [ ! -e /usr/include/GLFW/glfw3.h ]; then
    viewer=OFF
    echo '== There is no GLFW: THE VIEWER IS LEFT OUT'
fi
command -v xvfb-run >/dev/null || echo '== There is no xvfb-run: THE VIEWER IS NOT TESTED'

# ---- The tests ----

target=${CARGO_TARGET_DIR:-$root/target}
build=$target/capi-tests
log=$(mktemp)
trap 'rm -f "$log"' EXIT
verdict=0

echo '== Rust, without features'
cargo check --release --locked --no-default-features

echo '== Rust documentation'
RUSTDOCFLAGS='-D warnings' cargo doc --release --locked --no-deps --lib --all-features

echo '== Rust, with all features'
export PROPTEST_RNG_SEED=${PROPTEST_RNG_SEED:-1}
cargo test --release --locked --all-features --no-fail-fast 2>&1 | tee -a "$log" || verdict=1
# Apart: together, cbindgen would turn on features of the library's dependencies, which C programs then compile anew.
cargo test --release --locked -p bakelite-header 2>&1 | tee -a "$log" || verdict=1

echo '== C and C++'
scenes=${BAKELITE_SCENES:-$root/../shared/scenes}
[ -d "$scenes" ] || echo "   (no folder $scenes: only the built-in scenes are compared with Embree)"
cmake -S capi-tests -B "$build" -DBAKELITE_CARGO_TARGET_DIR="$target" -DBAKELITE_SCENES="$scenes" \
    -DBAKELITE_TEST_EMBREE=$embree -DBAKELITE_TEST_VIEWER=$viewer >/dev/null
cmake --build "$build" --parallel 2 || verdict=1
ctest --test-dir "$build" --output-on-failure --parallel 2 2>&1 | tee -a "$log" || verdict=1

# ---- The count: "test result: ok. 3 passed; 0 failed; ..." and "100% tests passed, 0 tests failed out of 12" ----

awk '
    /^test result:/ { passed += $4; failed += $6 }
    /tests passed, .* tests failed out of/ { passed += $NF - $4; failed += $4 }
    END { printf "%d passed, %d failed\n", passed, failed }
' "$log"
exit $verdict
