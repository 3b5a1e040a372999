#!/usr/bin/env python3
"""Bakes a mesh with Bakelite from Python (ctypes and numpy), and shows its light map.

    examples/bake.py [--out PREFIX] [--texels N] [--show]

A floor with a red box on it, under a sun and a blue sky. Writes PREFIXlightmap.npy (irradiance in W/m2, float32, rows x
columns x 3) and PREFIXlightmap.png; --show opens a window (matplotlib). The library is found as the system's linker
finds it, or named by BAKELITE_LIBRARY.
"""

import argparse
import ctypes
import ctypes.util
import os
import struct
import sys
import zlib
from ctypes import POINTER, Structure, byref, c_char_p, c_float, c_int32, c_size_t, c_uint32, c_uint64, c_void_p

import numpy as np

NONE = 0xFFFFFFFF
LIGHT_DIRECTIONAL, LIGHT_SKY = 3, 5
LAYER_COMBINED, LAYER_DIRECT, LAYER_VALIDITY = 0, 2, 4
FORMAT_RGB32F, FORMAT_R32F = 1, 3


# The structures of bakelite.h that this program uses. `make` compares their sizes with the library's.
class MaterialDesc(Structure):
    _fields_ = [("struct_size", c_uint32), ("flags", c_uint32), ("albedo", c_float * 3), ("emission", c_float * 3),
                ("albedo_texture", c_uint32), ("alpha_cutoff", c_float), ("transmission", c_float * 3)]


class MeshDesc(Structure):
    _fields_ = [("struct_size", c_uint32), ("flags", c_uint32), ("material", c_uint32), ("positions", c_void_p),
                ("position_stride", c_size_t), ("vertex_count", c_size_t), ("indices", c_void_p),
                ("triangle_count", c_size_t), ("normals", c_void_p), ("normal_stride", c_size_t), ("uvs", c_void_p),
                ("uv_stride", c_size_t), ("lightmap_uvs", c_void_p), ("lightmap_uv_stride", c_size_t),
                ("lightmap_page", c_void_p), ("triangle_materials", c_void_p)]


class LightDesc(Structure):
    _fields_ = [("struct_size", c_uint32), ("type", c_uint32), ("position", c_float * 3), ("direction", c_float * 3),
                ("edge_u", c_float * 3), ("edge_v", c_float * 3), ("color", c_float * 3), ("cone_inner", c_float),
                ("cone_outer", c_float), ("angular_radius", c_float), ("environment", c_uint32), ("up", c_float * 3),
                ("rotation", c_float)]


class LightmapDesc(Structure):
    _fields_ = [("struct_size", c_uint32), ("texels_per_unit", c_float), ("page_size", c_uint32), ("padding", c_uint32),
                ("gather_divisor", c_uint32), ("radiance_divisor", c_uint32), ("both_sides", c_uint32),
                ("seen_from_count", c_uint32), ("seen_from", c_void_p)]


class LightmapInfo(Structure):
    _fields_ = [("struct_size", c_uint32), ("page_count", c_uint32), ("width", c_uint32), ("height", c_uint32),
                ("charts", c_uint32), ("given_charts", c_uint32), ("unwrapped_charts", c_uint32),
                ("reduced_charts", c_uint32), ("both_sided_charts", c_uint32), ("texels_per_unit", c_float),
                ("texels", c_uint64), ("gather_texels", c_uint64), ("radiance_texels", c_uint64), ("bytes", c_uint64),
                ("uv_out_of_range", c_uint64), ("uv_degenerate", c_uint64), ("uv_overlapping_texels", c_uint64),
                ("unwrap_seconds", ctypes.c_double), ("back_texels", c_uint64), ("unseen_charts", c_uint64),
                ("spared_texels", c_uint64), ("kept_charts", c_uint64)]


PROGRESS = ctypes.CFUNCTYPE(c_int32, c_void_p, c_float, c_char_p)


def load():
    """Loads the library and declares the functions that are called with more than pointers."""
    name = os.environ.get("BAKELITE_LIBRARY") or ctypes.util.find_library("bakelite") or "libbakelite.so"
    library = ctypes.CDLL(name)
    library.bk_last_error.restype = c_char_p
    library.bk_scene_create.argtypes = [c_void_p, POINTER(c_void_p)]
    for add in (library.bk_scene_add_material, library.bk_scene_add_mesh, library.bk_scene_add_light):
        add.argtypes = [c_void_p, c_void_p, POINTER(c_uint32)]
    library.bk_scene_commit.argtypes = [c_void_p, PROGRESS, c_void_p]
    library.bk_lightmap_create.argtypes = [c_void_p, c_void_p, PROGRESS, c_void_p, POINTER(c_void_p)]
    library.bk_lightmap_get_info.argtypes = [c_void_p, c_void_p]
    library.bk_bake.argtypes = [c_void_p, c_void_p, PROGRESS, c_void_p, c_void_p]
    library.bk_lightmap_read.argtypes = [c_void_p, c_uint32, c_uint32, c_uint32, c_void_p, c_size_t]
    for release in (library.bk_device_release, library.bk_scene_release, library.bk_lightmap_release):
        release.argtypes = [c_void_p]
        release.restype = None
    return library


class Baker:
    """A scene that is described, and then baked."""

    def __init__(self, library=None):
        self.library = library or load()
        self.device, self.scene, self.map = c_void_p(), c_void_p(), c_void_p()
        self.check(self.library.bk_device_create(None, byref(self.device)))
        self.check(self.library.bk_scene_create(self.device, byref(self.scene)))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.library.bk_lightmap_release(self.map)
        self.library.bk_scene_release(self.scene)
        self.library.bk_device_release(self.device)

    def check(self, result):
        if result != 0:
            raise RuntimeError(self.library.bk_last_error().decode())

    def make(self, kind, init):
        """A structure with its defaults."""
        made = kind()
        getattr(self.library, init)(byref(made))
        if made.struct_size != ctypes.sizeof(kind):
            raise RuntimeError(f"{kind.__name__} is not what the library has: {made.struct_size} bytes")
        return made

    def add_material(self, albedo):
        desc = self.make(MaterialDesc, "bk_material_desc_init")
        desc.albedo[:] = albedo
        number = c_uint32()
        self.check(self.library.bk_scene_add_material(self.scene, byref(desc), byref(number)))
        return number.value

    def add_mesh(self, positions, triangles, material):
        """positions: n x 3 floats; triangles: m x 3 vertex numbers."""
        positions = np.ascontiguousarray(positions, np.float32)
        triangles = np.ascontiguousarray(triangles, np.uint32)
        desc = self.make(MeshDesc, "bk_mesh_desc_init")
        desc.positions, desc.vertex_count = positions.ctypes.data, len(positions)
        desc.indices, desc.triangle_count = triangles.ctypes.data, len(triangles)
        desc.material = material
        number = c_uint32()
        self.check(self.library.bk_scene_add_mesh(self.scene, byref(desc), byref(number)))
        return number.value

    def add_light(self, kind, color, direction=(0, 0, 0)):
        desc = self.make(LightDesc, "bk_light_desc_init")
        desc.type = kind
        desc.color[:] = color
        desc.direction[:] = direction
        self.check(self.library.bk_scene_add_light(self.scene, byref(desc), None))

    def bake(self, page_size, progress=None):
        """progress: called with a fraction and the name of the stage; False cancels."""
        callback = PROGRESS(lambda _, fraction, stage: progress(fraction, stage.decode()) is not False) if progress else PROGRESS()
        desc = self.make(LightmapDesc, "bk_lightmap_desc_init")
        desc.page_size = page_size
        self.check(self.library.bk_scene_commit(self.scene, callback, None))
        self.check(self.library.bk_lightmap_create(self.scene, byref(desc), callback, None, byref(self.map)))
        self.check(self.library.bk_bake(self.map, None, callback, None, None))

    def read(self, layer, page=0):
        """A layer of a page: rows x columns x 3, or rows x columns for the validity."""
        info = self.make(LightmapInfo, "bk_lightmap_info_init")
        self.check(self.library.bk_lightmap_get_info(self.map, byref(info)))
        one = layer == LAYER_VALIDITY
        texels = np.empty((info.height, info.width) if one else (info.height, info.width, 3), np.float32)
        layout = FORMAT_R32F if one else FORMAT_RGB32F
        self.check(self.library.bk_lightmap_read(self.map, page, layer, layout, texels.ctypes.data, 0))
        return texels


def box(lower, upper):
    """Twelve triangles, counter-clockwise from outside."""
    corners = np.array([[(upper if i >> k & 1 else lower)[k] for k in range(3)] for i in range(8)], np.float32)
    quads = [(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.uint32)


def describe(baker):
    """A floor of 10 x 10 units with a box on it, under a sun and a sky."""
    white, red = baker.add_material((0.7, 0.7, 0.7)), baker.add_material((0.7, 0.15, 0.1))
    floor = np.array([[-5, 0, -5], [-5, 0, 5], [5, 0, 5], [5, 0, -5]], np.float32)
    baker.add_mesh(floor, [[0, 1, 2], [0, 2, 3]], white)
    baker.add_mesh(*box((-1, 0, -1), (1, 2, 1)), red)
    baker.add_light(LIGHT_DIRECTIONAL, (5, 4.5, 4), (0.5, -1, 0.3))
    baker.add_light(LIGHT_SKY, (0.2, 0.3, 0.5))


def to_srgb(irradiance):
    """8-bit sRGB, the brightest hundredth clipped."""
    linear = np.clip(irradiance / max(np.percentile(irradiance, 99), 1e-9), 0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)
    return (255 * srgb + 0.5).astype(np.uint8)


def write_png(path, pixels):
    """8-bit RGB, by the standard library alone."""
    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)))
        file.write(chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", metavar="PREFIX", default="", help="beginning of the names of the files")
    parser.add_argument("--texels", metavar="N", type=int, default=512, help="width of the light map (512)")
    parser.add_argument("--show", action="store_true", help="open a window")
    args = parser.parse_args()
    with Baker() as baker:
        describe(baker)
        baker.bake(args.texels, lambda fraction, stage: print(f"\r{fraction:4.0%} {stage:12}", end="", file=sys.stderr))
        print(file=sys.stderr)
        light = baker.read(LAYER_COMBINED)
    picture = to_srgb(light)
    np.save(f"{args.out}lightmap.npy", light)
    write_png(f"{args.out}lightmap.png", picture)
    print(f"{args.out}lightmap.png: {light.shape[1]} x {light.shape[0]} texels, up to {light.max():.2f} W/m2")
    if args.show:
        import matplotlib.pyplot as plot
        plot.imshow(picture)
        plot.show()


if __name__ == "__main__":
    main()
