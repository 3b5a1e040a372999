#!/usr/bin/env bash
# What the CMake project cannot honour it refuses, and its sentence names the remedy. Configures only; builds nothing.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
verdict=0

# refused NAME "PATTERN OF THE REMEDY" ARGS...
refused() {
    local name=$1 remedy=$2
    shift 2
    rm -rf "$work/build"
    if cmake -S "$root/cmake" -B "$work/build" "$@" >"$work/log" 2>&1; then
        echo "   $name: NOT REFUSED"
        verdict=1
    # CMake breaks lines where it likes.
    elif ! tr -s ' \n' '  ' <"$work/log" | grep -qE -e "$remedy"; then
        echo "   $name: THE REMEDY ($remedy) IS NOT NAMED"
        cat "$work/log"
        verdict=1
    else
        echo "   $name: refused"
    fi
}

# accepted NAME "PATTERN OF A SETTING OF THE BUILD" ARGS...
accepted() {
    local name=$1 setting=$2
    shift 2
    rm -rf "$work/build"
    if cmake -S "$root/cmake" -B "$work/build" "$@" >"$work/log" 2>&1 &&
        grep -qE -e "$setting" "$work"/build/bakelite_settings.cmake "$work"/build/CMakeFiles/bakelite_build.dir/build.make; then
        echo "   $name: honoured"
    else
        echo "   $name: NOT HONOURED ($setting)"
        cat "$work/log"
        verdict=1
    fi
}

# A toolchain for a machine of which only the name is known.
toolchain() {
    cat >"$work/toolchain.cmake" <<TOOLCHAIN
set(CMAKE_SYSTEM_NAME $1)
set(CMAKE_SYSTEM_PROCESSOR $2)
set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
set(CMAKE_C_COMPILER ${CC:-cc})
TOOLCHAIN
}
# Compilers that say they are others.
mkdir "$work/old" "$work/empty"
printf '#!/bin/sh\nprintf "rustc 1.70.0\\nhost: x86_64-unknown-linux-gnu\\nrelease: 1.70.0\\n"\n' >"$work/old/rustc"
chmod +x "$work/old/rustc"

echo '== Build types'
accepted Release 'PROFILE=release ' -DCMAKE_BUILD_TYPE=Release
accepted 'no build type' 'PROFILE=release '
accepted Debug 'PROFILE=dev ' -DCMAKE_BUILD_TYPE=Debug
accepted RelWithDebInfo 'PROFILE=release-with-lines ' -DCMAKE_BUILD_TYPE=RelWithDebInfo
refused MinSizeRel 'BAKELITE_CARGO_PROFILE=release' -DCMAKE_BUILD_TYPE=MinSizeRel
refused Shipping 'BAKELITE_CARGO_PROFILE=release' -DCMAKE_BUILD_TYPE=Shipping
accepted 'Shipping with a profile' 'PROFILE=release ' -DCMAKE_BUILD_TYPE=Shipping -DBAKELITE_CARGO_PROFILE=release

echo '== Kinds of libraries and features'
accepted 'BUILD_SHARED_LIBS=ON' 'CRATE_TYPES "cdylib"' -DBUILD_SHARED_LIBS=ON
accepted 'BUILD_SHARED_LIBS=OFF' 'CRATE_TYPES "staticlib"' -DBUILD_SHARED_LIBS=OFF
accepted both 'CRATE_TYPES "cdylib,staticlib"'
refused none 'Switch one on' -DBAKELITE_SHARED=OFF -DBAKELITE_STATIC=OFF
accepted 'the default features' 'FEATURES "unwrap"'
accepted 'all features' 'FEATURES "unwrap,io"' -DBAKELITE_IO=ON
accepted 'no features' 'FEATURES ""' -DBAKELITE_UNWRAP=OFF

echo '== Rust'
refused 'an old rustc' 'rustup update.*BAKELITE_CARGO' -DBAKELITE_RUSTC="$work/old/rustc"
if ! PATH=/usr/bin:/bin command -v cargo >/dev/null; then
    (export PATH=/usr/bin:/bin HOME=/nowhere CARGO_HOME=/nowhere && refused 'no cargo' 'https://rustup.rs' && exit $verdict) || verdict=1
fi
refused 'an empty vendor folder' 'cargo vendor --locked' -DBAKELITE_VENDOR_DIR="$work/empty"

echo '== Toolchains'
toolchain Linux sparc64
refused 'an unknown machine' 'BAKELITE_RUST_TARGET' --toolchain "$work/toolchain.cmake"
refused 'an unknown target' 'BAKELITE_RUST_TARGET' -DBAKELITE_RUST_TARGET=teapot
# One of the targets is not installed; the others would do as well.
refused 'a target that is not installed' 'rustup target add mips64-openwrt-linux-musl|BAKELITE_RUST_TARGET' \
    -DBAKELITE_RUST_TARGET=mips64-openwrt-linux-musl
toolchain Linux aarch64
if [ -d "$(rustc --print target-libdir --target aarch64-unknown-linux-gnu)" ]; then
    accepted 'aarch64' 'RUST_TARGET "aarch64-unknown-linux-gnu"' --toolchain "$work/toolchain.cmake"
else
    refused 'aarch64 that is not installed' 'rustup target add aarch64-unknown-linux-gnu' --toolchain "$work/toolchain.cmake"
fi
toolchain Windows x86_64
if [ -d "$(rustc --print target-libdir --target x86_64-pc-windows-gnu)" ]; then
    accepted MinGW 'RUST_TARGET "x86_64-pc-windows-gnu"' --toolchain "$work/toolchain.cmake"
else
    refused 'MinGW that is not installed' 'rustup target add x86_64-pc-windows-gnu' --toolchain "$work/toolchain.cmake"
fi
exit $verdict
