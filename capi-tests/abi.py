#!/usr/bin/env python3
"""The binary interface of include/bakelite.h, written down in capi-tests/abi.txt: constants, layouts, functions.

    capi-tests/abi.py                      fails where the header differs from abi.txt
    capi-tests/abi.py --library FILE       also: FILE (ELF) exports just the header's functions
    capi-tests/abi.py --update             writes abi.txt, if CHANGELOG.md announces what changes
    capi-tests/abi.py --self-test          changes the header in places and sees whether that is found

Layouts are asked of a C compiler (CC, default cc) by a program that is made of the header. They are those of targets with
64-bit pointers; elsewhere only constants and functions are compared.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import c_header

RECORD = c_header.ROOT / "capi-tests" / "abi.txt"
CHANGELOG = c_header.ROOT / "CHANGELOG.md"
COMMENT = "# The interface of include/bakelite.h on targets with 64-bit pointers. Made by: capi-tests/abi.py --update\n"


def program(header):
    """A C program that prints the record."""
    out = ['#include <stdio.h>', '#include "bakelite.h"', "int main(void) {"]

    def line(text, *values):
        arguments = "".join(f", (long long)({v})" for v in values)
        out.append(f'    printf("{text}\\n"{arguments});')

    for item in header.of("constant"):
        line(f"constant {item.name} %lld", item.name)
    for item in header.of("struct"):
        line(f"struct {item.name}: %lld bytes", f"sizeof({item.name})")
        for f in item.fields:
            at = f"offsetof({item.name}, {f.name})", f"sizeof((({item.name} *)0)->{f.name})"
            line(f"field {item.name}.{f.name}: {f.value} at %lld, %lld bytes", *at)
    for item in header.of("typedef"):
        line(f"type {item.name}: {item.value}")
    for item in header.of("handle"):
        line(f"type {item.name}: opaque")
    for item in header.of("callback"):
        line(f"type {item.name}: {prototype(item)}")
    for item in header.of("function"):
        line(f"function {item.name}: {prototype(item)}{', experimental' if item.is_experimental else ''}")
    line("pointers: %lld bytes", "sizeof(void *)")
    out.append("    return 0;\n}\n")
    return "\n".join(out)


def prototype(item):
    """Without the names of parameters, which callers do not see."""
    return f"{item.result}({', '.join(t for t, _ in item.arguments) or 'void'})"


def record(text):
    header = c_header.parse(text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        (path / "bakelite.h").write_text(text, encoding="utf-8")
        (path / "abi.c").write_text(program(header), encoding="utf-8")
        compiler = os.environ.get("CC", "cc").split()
        command = [*compiler, "-std=c99", "-I", folder, str(path / "abi.c"), "-o", str(path / "abi")]
        subprocess.run(command, check=True)
        out = subprocess.run([str(path / "abi")], check=True, capture_output=True, text=True).stdout
    lines = out.splitlines()
    check_ends(lines)
    *lines, pointers = lines
    return lines, pointers == "pointers: 8 bytes"


def check_ends(lines):
    """A structure that ended in padding could not grow: an older program would have garbage where a new field begins."""
    size, end = {}, {}
    for line in lines:
        if match := re.match(r"struct (\w+): (\d+) bytes", line):
            size[match[1]] = int(match[2])
        elif match := re.match(r"field (\w+)\..* at (\d+), (\d+) bytes", line):
            end[match[1]] = int(match[2]) + int(match[3])
    for name, bytes_ in size.items():
        if end[name] != bytes_:
            sys.exit(f"abi: {name} ends in {bytes_ - end[name]} bytes of padding: put a field there or order the fields anew")


def difference(old, new):
    """Names whose lines differ, with both lines."""
    def by_name(lines):
        return {re.match(r"\w+ ([\w.]+)", line)[1]: line for line in lines}

    old, new = by_name(old), by_name(new)
    return {n: (old.get(n), new.get(n)) for n in [*old, *new] if old.get(n) != new.get(n)}


def unannounced(names):
    """Those that the newest section of the changelog does not mention. Fields are `bk_x.field`, or both names apart."""
    text = re.split(r"\n## ", CHANGELOG.read_text(encoding="utf-8"))[1]
    words = re.findall(r"[\w.]+", " ".join(re.findall(r"`[^`]+`", text)))
    mentioned = {part for w in words for part in w.split(".")}
    return [n for n in names if any(part not in mentioned for part in n.split("."))]


def exported(library):
    out = subprocess.run(["nm", "-D", "--defined-only", library], check=True, capture_output=True, text=True).stdout
    return {line.split()[2].split("@")[0] for line in out.splitlines() if line.split()[1] in "TtWVBDRi"}


def recorded():
    return [l for l in RECORD.read_text(encoding="utf-8").splitlines() if not l.startswith("#")] if RECORD.exists() else []


def compare(old, new, has_layouts):
    if not has_layouts:
        old, new = ([l for l in lines if not l.startswith(("struct ", "field "))] for lines in (old, new))
    return difference(old, new)


def check(library):
    new, has_layouts = record(c_header.HEADER.read_text(encoding="utf-8"))
    failed = False
    changes = compare(recorded(), new, has_layouts)
    for before, after in changes.values():
        print(f"- {before}" if before else "", f"+ {after}" if after else "", sep="\n" if before and after else "")
    if changes:
        print(
            "abi: include/bakelite.h is no longer the interface of capi-tests/abi.txt. Programs that are compiled against\n"
            "either may not work with the other. If that is meant, announce each change by name in the newest section of\n"
            "CHANGELOG.md, then run capi-tests/abi.py --update and commit both."
        )
        failed = True
    if library:
        functions = {line.split()[1].rstrip(":") for line in new if line.startswith("function ")}
        symbols = exported(library)
        for name in sorted(functions - symbols):
            print(f"abi: {library} does not export {name}")
        for name in sorted(symbols - functions):
            print(f"abi: {library} exports {name}, which the header does not have")
        failed |= functions != symbols
    if not failed:
        print(f"abi: {len(new)} lines as recorded{', ' + str(len(exported(library))) + ' symbols' if library else ''}")
    return 1 if failed else 0


def update():
    new, has_layouts = record(c_header.HEADER.read_text(encoding="utf-8"))
    if not has_layouts:
        sys.exit("abi: only a target with 64-bit pointers can write abi.txt")
    changes = difference(recorded(), new)
    if recorded() and (missing := unannounced(changes)):
        sys.exit("abi: the newest section of CHANGELOG.md does not mention " + ", ".join(missing))
    RECORD.write_text(COMMENT + "\n".join(new) + "\n", encoding="utf-8")
    print(f"abi: {len(changes)} changes written to {RECORD.name}")
    return 0


def self_test():
    text = c_header.HEADER.read_text(encoding="utf-8")
    changes = [
        ("a value", r"(#define BK_LEFT_OUT_SKY) \d+", r"\1 4", "BK_LEFT_OUT_SKY"),
        ("an order of fields", r"  float t;((?:\n.*)*?)\n  float u;", r"  float u;\1\n  float t;", "bk_hit.t"),
        ("a type of a field", r"  uint32_t page_count;", "  uint64_t page_count;", "bk_lightmap_info"),
        ("a parameter", r"bk_scene_mesh_count\(const bk_scene \*scene\)", "bk_scene_mesh_count(bk_scene *scene)", "bk_scene_mesh_count"),
        ("a function", r"BK_API uint32_t bk_version\(void\);", "", "bk_version"),
        ("a mark", r"BK_EXPERIMENTAL( bk_result bk_live_save)", r"BK_API\1", "bk_live_save"),
    ]
    failed = 0
    old, has_layouts = record(text)
    for what, pattern, replacement, expected in changes:
        changed, count = re.subn(pattern, replacement, text, count=1)
        if count == 0 or expected not in compare(old, record(changed)[0], True):
            print(f"self-test: nobody misses {what} (places to change: {count})")
            failed += has_layouts
    padded = re.sub(r"(  uint32_t first_texture;)", r"\1\n  /// One more.\n  uint32_t more;", text)
    try:
        record(padded)
        print("self-test: nobody misses a structure that ends in padding")
        failed += has_layouts
    except SystemExit:
        pass
    if unannounced(["bk_never_heard_of", "bk_bake_params.never"]) != ["bk_never_heard_of", "bk_bake_params.never"]:
        print("self-test: everything is announced")
        failed += 1
    print(f"self-test: {len(changes) + 2} changes, {failed} not found")
    return 1 if failed else 0


def main():
    arguments = sys.argv[1:]
    if arguments == ["--update"]:
        return update()
    if arguments == ["--self-test"]:
        return self_test()
    if arguments and (len(arguments) != 2 or arguments[0] != "--library"):
        sys.exit(__doc__)
    return check(arguments[1] if arguments else None)


if __name__ == "__main__":
    sys.exit(main())
