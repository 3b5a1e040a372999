#!/usr/bin/env bash
# Installs bakelite from a CMake build folder to a fresh prefix and to a fresh DESTDIR, then builds
# and runs the consumer from a fresh folder, by find_package and by pkg-config.
#
#     test.sh BUILD_FOLDER
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
build=$1
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cc=${CC:-cc}

cmake --install "$build" --prefix "$work/prefix" >/dev/null
DESTDIR=$work/stage cmake --install "$build" --prefix /opt/bakelite >/dev/null
test -f "$work/stage/opt/bakelite/include/bakelite.h"

# A package that was moved must still be found.
mv "$work/prefix" "$work/moved"
prefix=$work/moved

run() {
    mkdir -p "$work/run"
    (cd "$work/run" && "$@")
    ls "$work"/run/cornell-page0-combined.png >/dev/null
    rm -r "$work/run"
}

echo '-- find_package'
cp -r "$here" "$work/consumer"
cmake -S "$work/consumer" -B "$work/consumer-build" -DCMAKE_PREFIX_PATH="$prefix" -DCMAKE_BUILD_TYPE=Release >/dev/null
cmake --build "$work/consumer-build" >/dev/null
run "$work/consumer-build/shared"
run "$work/consumer-build/static"

echo '-- pkg-config'
pc=$(dirname "$(find "$prefix" -name bakelite.pc)")
export PKG_CONFIG_PATH=$pc
libdir=$(pkg-config --variable=libdir bakelite)
# Word splitting of the flags is what pkg-config is made for.
# shellcheck disable=SC2046
$cc -std=c99 -Wall -Wextra -Werror -pedantic "$here/main.c" $(pkg-config --cflags --libs bakelite) -o "$work/shared"
LD_LIBRARY_PATH=$libdir run "$work/shared"
rm "$libdir"/libbakelite.so*
# shellcheck disable=SC2046
$cc -std=c99 "$here/main.c" $(pkg-config --cflags --static --libs bakelite) -o "$work/static"
run "$work/static"
echo 'consumers: passed'
