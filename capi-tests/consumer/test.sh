#!/usr/bin/env bash
# Installs bakelite from a CMake build folder to a fresh prefix and to a fresh DESTDIR, then builds
# and runs the consumer from a fresh folder, by find_package, by pkg-config and with FetchContent.
#
#     test.sh BUILD_FOLDER CARGO_TARGET_FOLDER
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
build=$1
cargo_target=$2
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cc=${CC:-cc}

# fails COMMAND...: it must. (`set -e` does not look at `! COMMAND`.)
fails() {
    if "$@"; then
        echo "should have failed: $*" >&2
        exit 1
    fi
}

# needs PROGRAM: the libraries that it loads.
needs() { readelf -d "$1" | sed -n 's/.*(NEEDED).*\[\(.*\)\]/\1/p'; }

cmake --install "$build" --prefix "$work/prefix" >/dev/null
DESTDIR=$work/stage cmake --install "$build" --prefix /opt/bakelite >/dev/null
test -f "$work/stage/opt/bakelite/include/bakelite.h"

# Who wants only what programs load gets no more.
cmake --install "$build" --prefix "$work/runtime" --component bakelite_runtime >/dev/null
[ -z "$(find "$work/runtime" -name '*.h' -o -name '*.a' -o -name '*.pc' -o -name '*.cmake')" ]
soname=$(readelf -d "$work"/runtime/lib*/libbakelite.so.*.*.* | sed -n 's/.*(SONAME).*\[\(.*\)\]/\1/p')
# 0.1 and 0.2 are different interfaces: a program of one must not load the other.
[ "$soname" = libbakelite.so.0.1 ]
test -e "$work"/runtime/lib*/"$soname"

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
cmake --build "$work/consumer-build" >/dev/null 2>&1
for program in default shared static wholly_static; do
    run "$work/consumer-build/$program"
done
[[ $(needs "$work/consumer-build/shared") == *libbakelite.so.0.1* ]]
[[ $(needs "$work/consumer-build/static") != *bakelite* ]]
[ -z "$(needs "$work/consumer-build/wholly_static")" ]
echo '-- find_package: what the installation lacks is refused'
fails cmake -S "$work/consumer" -B "$work/refused" -DCMAKE_PREFIX_PATH="$prefix" -DCOMPONENTS='shared;teapots' >"$work/log" 2>&1
grep -q 'built without teapots'  "$work/log"

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
# shellcheck disable=SC2046
$cc -static -std=c99 "$here/main.c" $(pkg-config --cflags --static --libs bakelite) -o "$work/wholly-static" 2>/dev/null
run "$work/wholly-static"

echo '-- make'
# shellcheck disable=SC2046
make -s -f - CC="$cc" OUT="$work/made" SOURCE="$here/main.c" <<'MAKE'
$(OUT): $(SOURCE)
	$(CC) -o $@ $< $(shell pkg-config --cflags --static --libs bakelite)
MAKE
run "$work/made"

echo '-- FetchContent'
mkdir "$work/fetching"
cp "$here/main.c" "$work/fetching"
cat >"$work/fetching/CMakeLists.txt" <<'PROJECT'
cmake_minimum_required(VERSION 3.18)
project(fetching LANGUAGES C)
include(FetchContent)
FetchContent_Declare(bakelite SOURCE_DIR "${ROOT}" SOURCE_SUBDIR cmake)
FetchContent_MakeAvailable(bakelite)
add_executable(program main.c)
target_link_libraries(program PRIVATE bakelite::bakelite)
install(TARGETS program)
PROJECT
cmake -S "$work/fetching" -B "$work/fetching-build" -DCMAKE_BUILD_TYPE=Release -DROOT="$here/../.." -DBAKELITE_IO=ON \
    -DBAKELITE_CARGO_TARGET_DIR="$cargo_target" >/dev/null
cmake --build "$work/fetching-build" >/dev/null 2>&1
run "$work/fetching-build/program"
# A library that is part of a project is not installed with it unless asked for.
cmake --install "$work/fetching-build" --prefix "$work/fetched" >/dev/null
[ -z "$(find "$work/fetched" -name '*bakelite*')" ]
echo 'consumers: passed'
