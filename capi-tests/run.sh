#!/bin/sh
# Passes all tests: installs what is missing (Debian, Ubuntu), runs the Rust tests, builds the C and
# C++ programs with CMake and runs them, the comparison with Embree included. Its exit code is the
# verdict. Real scenes are used if they lie in ../shared/scenes or in $BAKELITE_SCENES.
set -eu
cd "$(dirname "$0")/.."

missing=""
need() { # command-or-file, package
    if ! command -v "$1" >/dev/null 2>&1 && ! [ -e "$1" ]; then missing="$missing $2"; fi
}
need cmake cmake
need make make
need g++ g++
need pkg-config pkg-config
need /usr/include/embree3/rtcore.h libembree-dev
if [ -n "$missing" ]; then
    echo "installing:$missing"
    as_root=""
    [ "$(id -u)" = 0 ] || as_root=sudo
    $as_root apt-get update -qq
    # shellcheck disable=SC2086
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing
fi
command -v cargo >/dev/null || { echo "a Rust toolchain is needed: https://rustup.rs" >&2; exit 1; }

target=${CARGO_TARGET_DIR:-$PWD/target}
if [ -d "${BAKELITE_SCENES:-../shared/scenes}" ]; then
    BAKELITE_SCENES=$(cd "${BAKELITE_SCENES:-../shared/scenes}" && pwd)
    export BAKELITE_SCENES
    echo "scenes: $BAKELITE_SCENES"
else
    echo "scenes: the built-in ones only"
fi

echo "== Rust tests"
# Optimised: they trace millions of rays. The library and the programs below share the build.
cargo test --release --locked
cargo check --release --locked --no-default-features

echo "== C and C++ programs"
cmake -S capi-tests -B "$target/capi-tests" -DCMAKE_BUILD_TYPE=Release -DBAKELITE_CARGO_TARGET_DIR="$target" \
    ${BAKELITE_SCENES:+-DBAKELITE_SCENES="$BAKELITE_SCENES"}
cmake --build "$target/capi-tests"
ctest --test-dir "$target/capi-tests" --output-on-failure
echo "all tests passed"
