"""Reads include/bakelite.h, as cbindgen writes it: groups, constants, types and functions, with their comments."""

import re
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HEADER = ROOT / "include" / "bakelite.h"


@dataclass
class Item:
    kind: str  # constant, struct, handle, typedef, callback, function
    name: str
    comment: str
    group: str
    line: int
    value: str = ""  # of a constant or a typedef
    result: str = ""  # of a function or a callback
    arguments: list = field(default_factory=list)  # of (type, name)
    fields: list = field(default_factory=list)  # of Item: kind "field", value the type with any [n]
    is_experimental: bool = False


@dataclass
class Header:
    groups: dict  # text by name
    items: list

    def of(self, kind):
        return [i for i in self.items if i.kind == kind]


def parse(text):
    groups, items, comment, group = {}, [], [], None
    lines = text.split("\n")
    n = 0

    def add(kind, name, at, **more):
        items.append(Item(kind, name, "\n".join(comment), group, at + 1, **more))
        comment.clear()
        return items[-1]

    while n < len(lines):
        line, at = lines[n], n
        n += 1
        if match := re.match(r" \* @defgroup (\w+) .*", line):
            group, head = match[1], []
            while lines[n] != " * @{":
                head.append(lines[n][3:])
                n += 1
            groups[group] = "\n".join(head)
        elif line.startswith("///"):
            comment.append(line[4:])
        elif line == "/** @} */":
            group = None
        elif group is None or not line or line.startswith(("/*", " *")):
            continue
        elif match := re.match(r"#define (BK_\w+) (.+)", line):
            add("constant", match[1], at, value=match[2])
        elif match := re.match(r"typedef struct (bk_\w+) (bk_\w+);", line):
            add("handle", match[1], at)
        elif match := re.match(r"typedef struct (bk_\w+) \{", line):
            struct, texts = add("struct", match[1], at), []
            while not lines[n].startswith("}"):
                if inner := re.match(r"  ///( (.*))?$", lines[n]):
                    texts.append(inner[2] or "")
                else:
                    inner = re.match(r"  (.*?)(\w+)((\[\w+\])?);", lines[n])
                    kind = inner[1].strip() + inner[3]
                    struct.fields.append(Item("field", inner[2], "\n".join(texts), group, n + 1, value=kind))
                    texts = []
                n += 1
            n += 1
        elif line.startswith(("typedef", "BK_API", "BK_EXPERIMENTAL")):
            while not line.endswith(";"):
                line += " " + lines[n].strip()
                n += 1
            experimental = line.startswith("BK_EXPERIMENTAL")
            line = re.sub(r"^(BK_API|BK_EXPERIMENTAL|typedef) ", "", line)
            if match := re.match(r"(.*?)\(\*(bk_\w+)\)\((.*)\);", line):
                add("callback", match[2], at, result=match[1].strip(), arguments=arguments(match[3]))
            elif match := re.match(r"(.*?)(bk_\w+)\((.*)\);", line):
                found = add("function", match[2], at, result=match[1].strip(), arguments=arguments(match[3]))
                found.is_experimental = experimental
            elif match := re.match(r"(\w+) (bk_\w+);", line):
                add("typedef", match[2], at, value=match[1])
            else:
                raise SystemExit(f"bakelite.h:{at + 1}: what is this? {line}")
        elif line.startswith("#"):
            continue
        else:
            raise SystemExit(f"bakelite.h:{at + 1}: what is this? {line}")
    return Header(groups, items)


def arguments(text):
    """[("const bk_scene *", "scene"), ("float[3]", "lower")]"""
    if text == "void":
        return []
    found = [re.match(r"(.*?)(\w+)((?:\[\w+\])?)$", a.strip()) for a in text.split(",")]
    return [(m[1].strip() + m[3], m[2]) for m in found]


def sections(comment):
    """The text before the first command, and the commands: ([(param, name(s), text), ...])."""
    head, commands = [], []
    for line in comment.split("\n"):
        if match := re.match(r"@(param|retval)\s+(\S+)\s*(.*)|@(return)()\s+(.*)", line):
            kind, name, text = (match[1], match[2], match[3]) if match[1] else (match[4], match[5], match[6])
            commands.append([kind, name, text])
        elif commands:
            commands[-1][2] += " " + line.strip()
        else:
            head.append(line)
    return "\n".join(head).strip(), [tuple(c) for c in commands]
