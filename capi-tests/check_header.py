#!/usr/bin/env python3
"""Fails where include/bakelite.h does not say what a caller needs to know.

    capi-tests/check_header.py               checks the header
    capi-tests/check_header.py --self-test   breaks the header, rule by rule, and sees whether that is found

Functions begin with a verb and describe each parameter; those that return a bk_result list the codes that they can return.
Quantities have units, pointers to output say who owns what they receive, text is UTF-8. Thread safety and cost are stated
for each function or once for its section; what all functions have in common is stated once, in the first section.
"""

import re
import sys

import c_header

# Verbs that a function's text may begin with. A new one is added on purpose.
VERBS = """Adds Allows Announces Applies Bakes Commits Copies Creates Estimates Fetches Finds Gets Loads Pauses Releases
Replaces Reports Receives Restores Returns Saves Sets Updates Writes""".split()

# Units and what has none. A field or argument with a floating-point number names one of them.
UNITS = re.compile(
    r"W/m2|W/sr|W/\(m2 sr\)|\bin W\b|radians|seconds|milliseconds|scene units?|texels|pixels|fraction|factor|ratio|relative"
    r"|multiples of|unit vectors?|vectors? of any length|in \[0, 1\]|1 per width|part of the work",
    re.IGNORECASE,
)
BYTES = re.compile(r"\bbytes\b|\b[KMG]i?B\b")
# Fields of structures of parameters say what they are if they are not set.
HAS_DEFAULTS = re.compile(r"_(desc|params)$|^bk_(camera|budget)$")

# What the first sections say for all functions.
SAID_ONCE = {
    "error": [
        "Pointers must not be NULL unless the description of the parameter allows it",
        "Pointers to input are read during the call only",
        "Output is written on success only",
        "Any function with a `bk_result` can return BK_ERROR_INTERNAL",
    ],
    "device": ["Ownership: handles", "Inside a callback", "Floating-point state:", "Stacks:"],
    "scene": ["Units: coordinates are right-handed"],
    "rays": ["Units: origins are in scene units"],
}

# Words that the glossary has better ones for, and sentences that cannot be read alone.
AVOID = re.compile(
    r"\b(what|tells?|told|meets?|met|stands? for|has something done|on its own)\b|\bas there[.,;]|\bof those, "
    r"|^(Of|That|Nor|Whether|Where|To be) ",
    re.IGNORECASE,
)


def problems(header):
    found = []

    def problem(item, text):
        found.append(f"bakelite.h:{item.line}: {item.name}: {text}")

    for group, phrases in SAID_ONCE.items():
        said = " ".join(header.groups.get(group, "").split())
        for phrase in phrases:
            if phrase not in said:
                found.append(f"bakelite.h: section {group} does not say: {phrase}")
    for item in header.items:
        check_language(item, problem)
        if item.kind in ("function", "callback"):
            check_function(header, item, problem)
        if item.kind == "struct":
            for f in item.fields:
                f.name = f"{item.name}.{f.name}"
                check_language(f, problem)
                check_field(item, f, problem)
                f.name = f.name.split(".")[1]
    return found


def check_language(item, problem):
    if not item.comment:
        problem(item, "has no comment")
        return
    for word in AVOID.finditer(item.comment):
        problem(item, f"says {word[0].strip()!r}; see the glossary in docs/architecture.md")
    first = re.split(r"[.:]( |\n|$)", item.comment)[0]
    if not re.match(r'[A-Z0-9`"]', first):
        problem(item, "does not begin with a capital letter")
    head, _ = c_header.sections(item.comment)
    if item.kind != "function" and not head.endswith((".", "?")):
        problem(item, "does not end with a full stop")


def is_float(type_):
    return re.search(r"\b(float|double)\b", type_) is not None


def check_field(struct, f, problem):
    if is_float(f.value) and not UNITS.search(f.comment):
        problem(f, "has no unit")
    if re.search(r"(stride|bytes|_budget|capacity)$", f.name) and not is_float(f.value) and not BYTES.search(f.comment):
        problem(f, "is not said to be in bytes")
    if HAS_DEFAULTS.search(struct.name) and f.name.split(".")[1] != "struct_size" and "Default" not in f.comment:
        problem(f, "has no default")
    if f.value == "const char *" and "UTF-8" not in f.comment:
        problem(f, "is not said to be UTF-8")
    # What a reader may follow ends somewhere: NULL if there is none, or a number of elements.
    if "*" in f.value and not re.search(r"NULL|`\w+`|\bvalid\b|triangle|vertex_count", f.comment):
        problem(f, "does not say how many elements there are, or whether it may be NULL")


def check_function(header, item, problem):
    text, commands = c_header.sections(item.comment)
    if text.split(" ")[0] not in VERBS:
        problem(item, f"begins with {text.split(' ')[0]!r}, not with one of the verbs in check_header.py")

    described = {}
    for kind, names, words in commands:
        if kind == "param":
            described.update((name, words) for name in names.split(","))
    names = [name for _, name in item.arguments]
    if list(described) != names:
        problem(item, f"describes {list(described)}, its parameters are {names}")
    for type_, name in item.arguments:
        check_argument(item, type_, name, described.get(name, ""), problem)

    codes = [name for kind, name, _ in commands if kind == "retval"]
    returns = [words for kind, _, words in commands if kind == "return"]
    if item.result == "bk_result":
        if not codes:
            problem(item, "lists no error")
        if any(type_ == "bk_progress_fn" for type_, _ in item.arguments) and "BK_ERROR_CANCELLED" not in codes:
            problem(item, "can be cancelled, but does not list BK_ERROR_CANCELLED")
        if any(name.startswith("path") for name in names) and "BK_ERROR_IO" not in codes:
            problem(item, "works on files, but does not list BK_ERROR_IO")
        creates = any(type_.endswith("**") for type_, _ in item.arguments)
        if creates and any(t == "bk_progress_fn" for t, _ in item.arguments) and "BK_ERROR_OUT_OF_MEMORY" not in codes:
            problem(item, "creates an object, but does not list BK_ERROR_OUT_OF_MEMORY")
    elif item.result != "void" and not returns:
        problem(item, "does not say what it returns")
    elif item.kind == "function" and item.result not in ("void", "bk_result") and "*" not in item.result:
        takes_handle = any(type_.startswith(("const bk_", "bk_")) and "*" in type_ for type_, _ in item.arguments)
        is_never_null = "NULL gives" in item.comment
        if takes_handle and "on failure" not in returns[0] + text and not is_never_null:
            problem(item, "does not say what it returns on failure")
    known = {i.name for i in header.of("constant")}
    for code in codes:
        if code not in known or not code.startswith("BK_ERROR"):
            problem(item, f"lists {code}, which is no error")
    if len(set(codes)) != len(codes):
        problem(item, "lists a code twice")
    if item.result.endswith("*") and not re.search(r"valid until|constant", returns[0] if returns else ""):
        problem(item, "does not say how long its result is valid")

    if item.kind == "function":
        said = header.groups[item.group] + "\n\n" + text
        for phrase, what in [("Thread safety:", "thread safety"), ("Cost:", "cost")]:
            if not re.search(rf"(^|\n){phrase} \w", said):
                problem(item, f"has no {what}, nor has its section: a paragraph that begins with {phrase!r}")
    if item.is_experimental != bool(re.search(r"(^|\n)Experimental: ", text)):
        problem(item, "is declared experimental and does not say so, or the reverse")


def check_argument(item, type_, name, words, problem):
    at = f"parameter {name}"
    if len(words.split()) < 1:
        problem(item, f"{at} has no text")
    elif re.search(r"\*\*$", type_) and not re.search(r"the caller releases with bk_\w+_release; NULL on failure", words):
        problem(item, f"{at}: who releases it? what does it receive on failure?")
    elif is_float(type_) and not UNITS.search(words):
        problem(item, f"{at} has no unit")
    elif type_ == "const char *" and item.kind == "function" and not re.search(r"UTF-8|\"\w+\"", words):
        problem(item, f"{at} is not said to be UTF-8")
    elif type_ == "const char *" and item.kind == "callback" and not re.search(r"valid during|for example", words):
        problem(item, f"{at}: how long is it valid?")
    elif re.search(r"(stride|bytes|capacity)$", name) and not (BYTES.search(words) or "number of" in words):
        problem(item, f"{at} is not said to be in bytes")
    elif type_ == "size_t" and not (BYTES.search(words) or "number of" in words):
        problem(item, f"{at} does not say of what it is the number")
    elif type_ == "bk_progress_fn" and "may be NULL" not in words:
        problem(item, f"{at} is not said to be optional")
    elif re.search(r"_view \*$", type_) and not type_.startswith("const") and not item.name.endswith("_init"):
        if not re.search(r"valid while", words):
            problem(item, f"{at}: how long are the pointers valid that it receives?")
    elif re.search(r"(?<!const )(uint8_t|float|uint32_t|void|char|size_t) \*$", type_) and not type_.startswith("const"):
        if name != "user" and not words.startswith("receives"):
            problem(item, f"{at} does not say what it receives")


def self_test(text):
    """Each of these makes the header worse in one place; each must be found."""
    worse = [
        ("a parameter", r"/// @param layer  .*\n", "", "bk_lightmap_read: describes"),
        ("a verb", r"/// Copies one layer of one page", "/// One layer of one page", "not with one of the verbs"),
        ("errors", r"/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted\n(BK_API\nbk_result bk_gather)", r"\1", "bk_gather: lists no error"),
        ("a cancel", r"/// @retval BK_ERROR_CANCELLED .*\n(BK_API bk_result bk_scene_commit)", r"\1", "bk_scene_commit: can be cancelled"),
        ("a code that is none", r"@retval BK_ERROR_IO ", "@retval BK_ERROR_FILE ", "BK_ERROR_FILE, which is no error"),
        ("a result", r"/// @return  number of meshes.*\n", "", "bk_scene_mesh_count: does not say what it returns"),
        ("a result on failure", r"number of meshes; 0 on failure", "number of meshes", "returns on failure"),
        ("a unit of a field", r"Vertical field of view in radians, in", "Vertical field of view, in", "fov_y: has no unit"),
        ("a unit of a parameter", r"origin of all rays, in scene units", "origin of all rays", "parameter origin has no unit"),
        ("bytes", r"Distance between positions in bytes, at", "Distance between positions, at", "not said to be in bytes"),
        ("ownership of a handle", r"receives the scene, which the caller releases with bk_scene_release; NULL", "receives the scene; NULL", "who releases it"),
        ("life of pointers", r"receives pointers that are valid while the map lives", "receives pointers", "how long are the pointers valid"),
        ("life of a string", r"and valid until the", "and free before the", "how long its result is valid"),
        ("thread safety", r" \* Thread safety: any thread, all functions at the same time; during bk_scene_refit", " * Whenever; during bk_scene_refit", "has no thread safety"),
        ("cost", r" \* Cost: grows with", " * It grows with", "has no cost"),
        ("a default", r"between charts\. Default: 2\.", "page_size`.", "padding: has no default"),
        ("an optional callback", r"progress callback and its pointer; may be NULL", "progress callback and its pointer", "not said to be optional"),
        ("UTF-8", r"name of the file; UTF-8", "name of the file", "not said to be UTF-8"),
        ("what is said once", r"Pointers to input are read during the call only", "Pointers to input are read", "section error does not say"),
        ("the mark", r"/// Experimental: another version of the library may refuse the file.\n///\n/// Cost: the time of writing", "/// Cost: the time of writing", "declared experimental"),
        ("a word", r"/// Number of the mesh\.", "/// Number of the mesh that a ray meets.", "says 'meets'"),
        ("a sentence", r"/// Number of charts that were made by unwrapping\.", "/// Of those, made by unwrapping.", "unwrapped_charts: says"),
    ]
    failed = 0
    for what, pattern, replacement, expected in worse:
        broken, count = re.subn(pattern, replacement, text, count=1)
        if count == 0:
            print(f"self-test: the header has no place to take away {what} from: {pattern}")
            failed += 1
        elif not any(expected in p for p in problems(c_header.parse(broken))):
            print(f"self-test: nobody misses {what}")
            failed += 1
    print(f"self-test: {len(worse)} defects, {failed} not found")
    return failed


def main():
    text = c_header.HEADER.read_text(encoding="utf-8")
    if sys.argv[1:] == ["--self-test"]:
        return 1 if self_test(text) else 0
    header = c_header.parse(text)
    found = problems(header)
    print("\n".join(found) or f"bakelite.h: {len(header.of('function'))} functions, {len(header.of('struct'))} structures, no problem")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
