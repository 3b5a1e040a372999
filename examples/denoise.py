#!/usr/bin/env python3
"""A denoiser of one's own between bake and read (ctypes and numpy): reads two halves with independent noise, filters
within charts, and hands the light back.

    examples/denoise.py [--texels N] [--rays N]

A room with a box and a lamp, baked with few rays. Prints the error of its indirect light, against a bake with many, before
and after. To try another denoiser, such as Open Image Denoise, replace `denoise`.
"""

import argparse
import ctypes
from ctypes import c_float, c_size_t, c_uint32, c_uint64, c_void_p

import bake
import numpy as np

LIGHT_POINT = 1
LAYER_INDIRECT, LAYER_CHART = 1, 17
FIRST_HALF, SECOND_HALF = 256, 512
FORMAT_R32U = 4
NONE = 0xFFFFFFFF

# Distance of the texels that take part, in texels, and of those that are looked at in between: neighbours are interpolated
# between the same texels of the gather map, so that their noise is much the same.
RADIUS, STEP = 8, 2


class BakeParams(ctypes.Structure):
    _fields_ = [("struct_size", c_uint32), ("max_bounces", c_uint32), ("photon_count", c_uint64), ("gather_rays", c_uint32),
                ("radius", c_float), ("near_hits", c_float), ("blur_radius", c_uint32), ("direct_samples", c_uint32),
                ("seed", c_uint64), ("memory_budget", c_uint64), ("texel_begin", c_uint64), ("texel_end", c_uint64),
                ("stitch", c_uint32), ("checkpoint_seconds", c_float), ("checkpoint", c_void_p),
                ("directional_indirect", c_uint32), ("directional_direct", c_uint32), ("passes", c_uint32),
                ("target_error", c_float), ("interpolation_error", c_float), ("interpolation_contrast", c_float), ("own_rays", c_uint32),
                ("share_count", c_uint32), ("shares", c_void_p)]


class Denoiser(bake.Baker):
    def layout(self, page_size):
        desc = self.make(bake.LightmapDesc, "bk_lightmap_desc_init")
        desc.page_size = page_size
        self.check(self.library.bk_scene_commit(self.scene, bake.PROGRESS(), None))
        self.check(self.library.bk_lightmap_create(self.scene, ctypes.byref(desc), bake.PROGRESS(), None, ctypes.byref(self.map)))

    def bake_with(self, **fields):
        params = self.make(BakeParams, "bk_bake_params_init")
        for name, value in fields.items():
            setattr(params, name, value)
        self.check(self.library.bk_bake(self.map, ctypes.byref(params), bake.PROGRESS(), None, None))

    def pages(self):
        info = self.make(bake.LightmapInfo, "bk_lightmap_info_init")
        self.check(self.library.bk_lightmap_get_info(self.map, ctypes.byref(info)))
        return info.page_count

    def all(self, layer):
        """A layer of all pages."""
        return np.stack([self.read(layer, page) for page in range(self.pages())])

    def charts(self, page):
        """The number of each texel's chart, in the padding too."""
        info = self.make(bake.LightmapInfo, "bk_lightmap_info_init")
        self.check(self.library.bk_lightmap_get_info(self.map, ctypes.byref(info)))
        charts = np.empty((info.height, info.width), np.uint32)
        self.check(self.library.bk_lightmap_read(self.map, page, LAYER_CHART, FORMAT_R32U, charts.ctypes.data, 0))
        return charts

    def write(self, layer, pages):
        """Hands the light of a layer back, pages x rows x columns x 3."""
        pages = np.ascontiguousarray(pages, np.float32)
        call = self.library.bk_lightmap_write
        call.argtypes = [c_void_p, c_void_p, c_size_t, c_uint32, c_void_p, bake.PROGRESS, c_void_p]
        layers = (c_uint32 * 1)(layer)
        self.check(call(self.map, layers, 1, bake.FORMAT_RGB32F, pages.ctypes.data, bake.PROGRESS(), None))


def moved(image, dy, dx, border):
    """The image moved by whole texels."""
    out = np.full_like(image, border)
    height, width = image.shape[:2]
    y, x = slice(max(dy, 0), height + min(dy, 0)), slice(max(dx, 0), width + min(dx, 0))
    from_y, from_x = slice(max(-dy, 0), height + min(-dy, 0)), slice(max(-dx, 0), width + min(-dx, 0))
    out[y, x] = image[from_y, from_x]
    return out


def filtered(values, guide, variance, charts):
    """Means of values within charts; texels count as far as they differ in the guide by no more than noise."""
    total, weights = np.zeros_like(values), np.zeros(charts.shape, np.float32)
    steps = range(-RADIUS, RADIUS + 1, STEP)
    for dy, dx in ((dy, dx) for dy in steps for dx in steps):
        difference = ((moved(guide, dy, dx, 0) - guide) ** 2).sum(axis=2)
        noise = variance + moved(variance, dy, dx, 0) + 1e-12
        weight = np.exp(-np.maximum(difference - noise, 0) / noise - (dx * dx + dy * dy) / (0.5 * RADIUS**2))
        weight *= (moved(charts, dy, dx, NONE) == charts) & (charts != NONE)
        total += weight[..., None] * moved(values, dy, dx, 0)
        weights += weight
    return total / np.maximum(weights, 1e-12)[..., None]


def denoise(first, second, charts, valid):
    """Filters each half by what the other one shows, whose noise is another (Rousselle, Knaus and Zwicker 2012)."""
    charts = np.where(valid, charts, NONE)
    # The variance of a half, smoothed.
    square = (0.5 * (first - second) ** 2).sum(axis=2, keepdims=True)
    even = np.zeros_like(square[..., 0])
    variance = filtered(square, np.zeros_like(square), even + 1, charts)[..., 0]
    return 0.5 * (filtered(first, second, variance, charts) + filtered(second, first, variance, charts))


def describe(baker):
    """A room with a box in it, and a lamp below the ceiling."""
    white, red = baker.add_material((0.7, 0.7, 0.7)), baker.add_material((0.7, 0.15, 0.1))
    corners, triangles = bake.box((-3, 0, -3), (3, 3, 3))
    baker.add_mesh(corners, triangles[:, ::-1], white)
    baker.add_mesh(*bake.box((-1, 0, -1), (0.5, 1.2, 0.5)), red)
    lamp = baker.make(bake.LightDesc, "bk_light_desc_init")
    lamp.type, lamp.position[:], lamp.color[:] = LIGHT_POINT, (1.5, 2.7, 1), (20, 20, 20)
    baker.check(baker.library.bk_scene_add_light(baker.scene, ctypes.byref(lamp), None))


def error(light, truth, valid):
    """The root of the mean square of relative differences."""
    return np.sqrt((((light - truth) / truth.mean())[valid] ** 2).mean())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--texels", metavar="N", type=int, default=256, help="width of the light map (256)")
    parser.add_argument("--rays", metavar="N", type=int, default=8, help="gather rays of each of two passes (8)")
    args = parser.parse_args()
    with Denoiser() as baker:
        describe(baker)
        baker.layout(args.texels)
        baker.bake_with(gather_rays=2048, blur_radius=0)
        truth, valid = baker.all(LAYER_INDIRECT), baker.all(bake.LAYER_VALIDITY) == 1
        baker.bake_with(gather_rays=args.rays, passes=2, blur_radius=0, seed=7)
        before = baker.all(LAYER_INDIRECT)
        first, second = (baker.all(LAYER_INDIRECT | half) for half in (FIRST_HALF, SECOND_HALF))
        light = [denoise(a, b, baker.charts(page), valid[page]) for page, (a, b) in enumerate(zip(first, second))]
        baker.write(LAYER_INDIRECT, light)
        after = baker.all(LAYER_INDIRECT)
    errors = [error(light, truth, valid) for light in (before, after)]
    print(f"error of indirect light: {errors[0]:.4f} before, {errors[1]:.4f} after denoising")


if __name__ == "__main__":
    main()
