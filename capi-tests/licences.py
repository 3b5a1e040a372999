#!/usr/bin/env python3
"""Licences of what the library is linked with: each dependency must offer one that asks for no more than a notice.

    capi-tests/licences.py              fails on a dependency that does not
    capi-tests/licences.py --list       prints name, version and licence of each
    capi-tests/licences.py --self-test  the check fails where it must
"""

import json
import re
import subprocess
import sys

# Licences that allow a closed program to contain the library, for a notice or for nothing.
ALLOWED = {"MIT", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "ISC", "Zlib", "Unlicense", "CC0-1.0", "0BSD", "MIT-0",
           "Unicode-3.0", "BSL-1.0", "Apache-2.0 WITH LLVM-exception"}


def is_allowed(expression):
    """Whether an SPDX expression can be met with allowed licences alone."""
    tokens = re.findall(r"\(|\)|\bAND\b|\bOR\b|[\w.+-]+(?:\s+WITH\s+[\w.-]+)?", expression.replace("/", " OR "))

    def alternatives():
        met = together()
        while tokens and tokens[0] == "OR":
            tokens.pop(0)
            met = together() or met
        return met

    def together():
        met = one()
        while tokens and tokens[0] == "AND":
            tokens.pop(0)
            met = one() and met
        return met

    def one():
        token = tokens.pop(0)
        if token == "(":
            met = alternatives()
            if tokens.pop(0) != ")":
                raise IndexError
            return met
        return " ".join(token.split()) in ALLOWED

    try:
        return alternatives() and not tokens
    except IndexError:
        return False  # no expression at all


def self_test():
    for good in ("MIT", "MIT OR GPL-3.0", "GPL-3.0 OR (Zlib AND MIT)", "Unlicense/MIT", "(MIT OR Apache-2.0) AND Unicode-3.0",
                 "Apache-2.0 WITH LLVM-exception OR GPL-2.0"):
        assert is_allowed(good), good
    for bad in ("", "GPL-3.0", "MIT AND GPL-3.0", "MPL-2.0", "(MIT OR Apache-2.0) AND LGPL-2.1", "MIT OR", "(MIT"):
        assert not is_allowed(bad), bad
    print("self-test: passed")


def main():
    metadata = json.loads(subprocess.run(
        ["cargo", "metadata", "--locked", "--format-version", "1", "--features", "bakelite/io,bakelite/unwrap"],
        check=True, stdout=subprocess.PIPE).stdout)
    packages = {p["id"]: p for p in metadata["packages"]}
    nodes = {n["id"]: n for n in metadata["resolve"]["nodes"]}
    # From the library on, through what is linked: neither tests nor what only runs while compiling.
    waiting = [p["id"] for p in packages.values() if p["name"] == "bakelite" and p["source"] is None]
    found = set()
    while waiting:
        identity = waiting.pop()
        if identity in found:
            continue
        found.add(identity)
        for dependency in nodes[identity]["deps"]:
            if any(kind["kind"] is None for kind in dependency["dep_kinds"]):
                waiting.append(dependency["pkg"])
    bad = 0
    for package in sorted((packages[i] for i in found), key=lambda p: p["name"]):
        licence = package["license"] or ""
        if "--list" in sys.argv:
            print(f"{package['name']} {package['version']}: {licence}")
        if not is_allowed(licence):
            print(f"{package['name']} {package['version']} asks for more than a notice: {licence or 'no licence is named'}")
            bad += 1
    print(f"{len(found)} packages, {bad} with a licence that is not allowed")
    return 1 if bad or len(found) < 10 else 0


if "--self-test" in sys.argv:
    self_test()
else:
    sys.exit(main())
