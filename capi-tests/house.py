#!/usr/bin/env python3
"""The library in figures: files, lines, longest file and longest function of each folder of src, as a table.

    capi-tests/house.py                   the files as they are
    capi-tests/house.py REVISION          a revision of git
    capi-tests/house.py BEFORE AFTER      two revisions, side by side

Tests are left out: files called tests, and a file's last module of tests. The length of a function is that of rustfmt's
layout, from the line with `fn` to the brace that closes it.
"""

import collections
import pathlib
import re
import subprocess
import sys

FUNCTION = re.compile(r"( *)(?:pub(?:\([a-z: ]+\))? |const |unsafe |extern \"C\" )*fn (\w+)")
TESTS = re.compile(r"#\[cfg\(test\)\]\n(?:pub\S* )?mod tests")


def git(*args):
    return subprocess.run(["git", *args], check=True, capture_output=True, text=True).stdout


def sources(revision):
    """Yields the path and the text of each file."""
    listing = git("ls-tree", "-r", "--name-only", revision, "src") if revision else git("ls-files", "src")
    for path in listing.split():
        if path.endswith(".rs") and not re.search(r"tests(\.rs|/)", path):
            yield path, git("show", f"{revision}:{path}") if revision else pathlib.Path(path).read_text()


def functions(lines):
    """Yields the length and the name of each function with a body."""
    for start, line in enumerate(lines):
        head = FUNCTION.match(line)
        if not head:
            continue
        for end in range(start, len(lines)):
            if lines[end] == head[1] + "}" or end == start and line.endswith("}"):
                yield end - start + 1, head[2]
            if lines[end].startswith(head[1] + "}") or end == start and line.endswith(";"):
                break


def figures(revision):
    """The cells of each folder: two levels of folders, and all."""
    folders = collections.defaultdict(list)
    for path, text in sources(revision):
        lines = TESTS.split(text)[0].splitlines()
        file = len(lines), path.split("/")[-1], max(functions(lines), default=(0, ""))
        folders["/".join(path.split("/")[1:-1][:2])].append(file)
        folders["all"].append(file)
    cells = {}
    for name, files in folders.items():
        function = max(f[2] for f in files)
        longest = max(files)
        cells[name] = (str(len(files)), str(sum(f[0] for f in files)), f"`{longest[1]}` {longest[0]}",
                       f"`{function[1]}` {function[0]}")
    return cells


def main():
    columns = [figures(revision) for revision in sys.argv[1:3] or [None]]
    print("| folder | files | lines | longest file | longest function |\n|---|---|---|---|---|")
    names = sorted(set().union(*columns), key=lambda name: (name == "all", name))
    for name in names:
        cells = zip(*(column.get(name, ("–",) * 4) for column in columns))
        print(f"| `{name or 'src'}` |", " | ".join(" → ".join(c) for c in cells), "|")


main()
