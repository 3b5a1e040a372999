#!/usr/bin/env bash
# The packages, as somebody gets them who has never seen the sources: .deb and .tar.gz are built, the .deb is installed
# on a fresh Debian, a small program is compiled there with pkg-config and with CMake, and bakes; and the library is
# built without a network from `cargo vendor`.
#
#     capi-tests/package.sh              all of it
#     capi-tests/package.sh packages     without the build from vendored sources
#     capi-tests/package.sh vendored     that alone
#
# BAKELITE_CHROOT: a fresh Debian with gcc, libc6-dev, make, cmake and pkg-config (default: made by debootstrap, which
# takes root and a network; without either the package is unpacked to an empty folder instead, and that is said).
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
target=${CARGO_TARGET_DIR:-$root/target}
out=$target/package
program=$root/capi-tests/consumer
mkdir -p "$out"

packages() {
    echo '== Packages'
    cmake -S cmake -B "$out/build" -DCMAKE_BUILD_TYPE=Release -DCMAKE_INSTALL_PREFIX=/usr -DBAKELITE_IO=ON \
        -DBAKELITE_CARGO_TARGET_DIR="$target" >/dev/null
    cmake --build "$out/build"
    rm -f "$out"/build/*.deb "$out"/build/*.tar.gz
    cmake --build "$out/build" --target package >/dev/null
    (cd "$out/build" && ls -l ./*.deb ./*.tar.gz)
    local libraries="$out/build/lib" bytes
    # Promised in docs/install.md for all features. Readers and writers of files take a third of it.
    bytes=$(stat -Lc %s "$libraries/libbakelite.a")
    [ "$bytes" -le 30000000 ] || { echo "libbakelite.a has $bytes bytes, more than 30 MB" && exit 1; }
    bytes=$(stat -Lc %s "$libraries/libbakelite.so")
    [ "$bytes" -le 11600000 ] || { echo "libbakelite.so has $bytes bytes, more than 11.6 MB" && exit 1; }
}

# A picture of a lit room is no single colour: its file cannot be compressed to nothing.
look() {
    local picture=$1
    [ "$(head -c 8 "$picture" | od -An -tx1 | tr -d ' ')" = 89504e470d0a1a0a ]
    [ "$(stat -c %s "$picture")" -gt 5000 ]
    cp "$picture" "$out/"
    echo "   baked: $out/$(basename "$picture")"
}

# What somebody types on a fresh Debian: docs/install.md, "Packages".
cat >"$out/commands.sh" <<'COMMANDS'
set -eux
dpkg -i /packages/*.deb
ldconfig
cd /program
cc main.c $(pkg-config --cflags --libs bakelite) -o with-pkg-config
mkdir -p pkg-config cmake
(cd pkg-config && ../with-pkg-config)
cc -static main.c $(pkg-config --cflags --static --libs bakelite) -o wholly-static 2>/dev/null
cmake -S . -B build -DCMAKE_BUILD_TYPE=Release
cmake --build build
(cd cmake && ../build/default)
COMMANDS

on_a_fresh_debian() {
    local chroot=${BAKELITE_CHROOT:-$out/debian}
    if [ ! -e "$chroot/usr/bin/cmake" ]; then
        if [ "$(id -u)" != 0 ] || ! command -v debootstrap >/dev/null; then
            echo '== There is no root or no debootstrap: THE PACKAGE IS NOT INSTALLED ON A FRESH DEBIAN, only unpacked'
            unpacked
            return
        fi
        echo '== A fresh Debian'
        debootstrap --variant=minbase --include=gcc,libc6-dev,make,cmake,pkg-config bookworm "$chroot" >"$out/debootstrap.log"
    fi
    echo '== The .deb on a fresh Debian'
    rm -rf "$chroot/packages" "$chroot/program"
    mkdir "$chroot/packages" "$chroot/program"
    cp "$out"/build/*.deb "$chroot/packages"
    cp "$program/main.c" "$program/CMakeLists.txt" "$chroot/program"
    cp "$out/commands.sh" "$chroot/commands.sh"
    chroot "$chroot" sh /commands.sh
    look "$chroot/program/pkg-config/cornell-page0-combined.png"
    cmp "$chroot/program/pkg-config/cornell-page0-combined.png" "$chroot/program/cmake/cornell-page0-combined.png"
    chroot "$chroot" dpkg --remove libbakelite-dev 'libbakelite0.1' >/dev/null
    [ -z "$(find "$chroot/usr" -name '*bakelite*')" ]
}

unpacked() {
    rm -rf "$out/unpacked" "$out/run"
    mkdir -p "$out/unpacked" "$out/run"
    for deb in "$out"/build/*.deb; do
        dpkg-deb -x "$deb" "$out/unpacked"
    done
    cmake -S "$program" -B "$out/unpacked-build" -DCMAKE_PREFIX_PATH="$out/unpacked/usr" -DCMAKE_BUILD_TYPE=Release >/dev/null
    cmake --build "$out/unpacked-build" >/dev/null
    (cd "$out/run" && "$out/unpacked-build/default")
    look "$out/run/cornell-page0-combined.png"
}

tarball() {
    echo '== The .tar.gz'
    rm -rf "$out/tarball" "$out/tarball-build"
    mkdir -p "$out/tarball/run"
    tar -xzf "$out"/build/*.tar.gz -C "$out/tarball" --strip-components=1
    cmake -S "$program" -B "$out/tarball-build" -DCMAKE_PREFIX_PATH="$out/tarball" -DCMAKE_BUILD_TYPE=Release >/dev/null
    cmake --build "$out/tarball-build" >/dev/null
    (cd "$out/tarball/run" && "$out/tarball-build/default")
    look "$out/tarball/run/cornell-page0-combined.png"
}

vendored() {
    echo '== Without a network, from vendored sources'
    rm -rf "$out/vendor" "$out/vendored" "$out/empty"
    mkdir -p "$out/empty"
    cargo vendor --locked "$out/vendor" >/dev/null 2>&1
    # A home of cargo's that has never seen a registry.
    local alone=(env "CARGO_HOME=$out/empty")
    unshare --net true 2>/dev/null && alone=(unshare --net "${alone[@]}")
    "${alone[@]}" cmake -S cmake -B "$out/vendored" -DCMAKE_BUILD_TYPE=Release -DBUILD_SHARED_LIBS=ON -DBAKELITE_UNWRAP=OFF \
        -DBAKELITE_VENDOR_DIR="$out/vendor" >/dev/null
    "${alone[@]}" cmake --build "$out/vendored"
    [ ! -e "$out/empty/registry" ]
    test -e "$out/vendored/lib/libbakelite.so"
    rm -rf "$out/vendor" "$out/vendored" "$out/empty"
}

what=${1:-all}
if [ "$what" != vendored ]; then
    packages
    on_a_fresh_debian
    tarball
fi
if [ "$what" != packages ]; then
    vendored
fi
echo 'packages: passed'
