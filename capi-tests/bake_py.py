#!/usr/bin/env python3
"""examples/bake.py and denoise.py against what is known of their scenes.

    BAKELITE_LIBRARY=libbakelite.so bake_py.py FOLDER/
"""

import ctypes
import os
import re
import subprocess
import sys

import numpy as np

EXAMPLES = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "examples")
sys.path.insert(0, EXAMPLES)
sys.dont_write_bytecode = True
import bake  # noqa: E402
import denoise  # noqa: E402


def structures():
    """The structures that bake.py declares are those of the header, field by field."""
    with open(os.path.join(EXAMPLES, "..", "include", "bakelite.h"), encoding="utf-8") as file:
        header = re.sub(r"///.*", "", file.read())
    kinds = {"uint32_t": ctypes.c_uint32, "uint64_t": ctypes.c_uint64, "size_t": ctypes.c_size_t, "float": ctypes.c_float,
             "double": ctypes.c_double}
    compared = 0
    for name, declared in [*vars(bake).items(), *vars(denoise).items()]:
        if not (isinstance(declared, type) and issubclass(declared, ctypes.Structure) and declared is not ctypes.Structure):
            continue
        c_name = "bk" + re.sub(r"([A-Z])", lambda m: "_" + m[1].lower(), name)
        body = re.search(r"typedef struct %s \{(.*?)\}" % c_name, header, re.S)[1]
        expected = []
        for kind, pointer, field, length in re.findall(r"(?:const )?(\w+) (\*?)(\w+)(?:\[(\d+)\])?;", body):
            kind = ctypes.c_void_p if pointer else kinds[kind]
            expected.append((field, kind * int(length) if length else kind))
        assert declared._fields_ == expected, f"{name} is not {c_name}: {declared._fields_}, {expected}"
        compared += 1
    assert compared == 6, compared


def main(out):
    structures()
    # The program as one runs it.
    subprocess.run([sys.executable, os.path.join(EXAMPLES, "bake.py"), "--out", out, "--texels", "128"], check=True)
    light = np.load(out + "lightmap.npy")
    with open(out + "lightmap.png", "rb") as file:
        assert file.read(8) == b"\x89PNG\r\n\x1a\n"

    # The same bake, layer by layer: the same bits.
    stages = []
    with bake.Baker() as baker:
        bake.describe(baker)
        baker.bake(128, lambda _, stage: stages.append(stage))
        assert np.array_equal(baker.read(bake.LAYER_COMBINED), light), "another run has other bits"
        direct, valid = baker.read(bake.LAYER_DIRECT), baker.read(bake.LAYER_VALIDITY)
    assert light.shape == (128, 128, 3) and np.isfinite(light).all() and stages
    covered = valid == 1
    assert covered.mean() > 0.3, covered.mean()

    # The brightest surfaces see all of the sun and at most all of the sky; a floor far from the box nearly that.
    sun = np.array([5, 4.5, 4]) / np.linalg.norm([0.5, -1, 0.3])
    sky = np.pi * np.array([0.2, 0.3, 0.5])
    expected = sun + sky
    open_floor = np.median(direct[covered], axis=0)
    assert np.all(np.abs(open_floor / expected - 1) < 0.03), (open_floor, expected)
    assert np.all(direct[covered].max(axis=0) < 1.02 * expected)
    # There is shadow: the sky alone, and not all of it.
    assert np.all(np.percentile(direct[covered], 2, axis=0) < 1.02 * sky)

    # Errors are sentences.
    with bake.Baker() as baker:
        try:
            baker.add_mesh([[0, 0, 0]], [[0, 0, 7]], 99)
        except RuntimeError as error:
            assert "7" in str(error) or "99" in str(error), error
        else:
            raise AssertionError("a wrong mesh was accepted")

    # Denoised light is nearer to the truth.
    command = [sys.executable, os.path.join(EXAMPLES, "denoise.py"), "--texels", "128"]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    before, after = map(float, re.findall(r"0\.\d+", told))
    assert 0 < after < 0.75 * before, told
    print("bake.py, denoise.py: passed")


main(sys.argv[1])
