#!/usr/bin/env python3
"""Error against time of Cycles, with and without Open Image Denoise, beside a bake of Bakelite on the same light map UVs.

    pip install bpy pyoidn numpy cffi           # Blender as a Python module, which has Cycles; about 400 MB
    bakelite report quality SCENE LIGHTS MAP --knobs none --view-paths 0 --seeds 1 --out report
    bakelite bake SCENE LIGHTS MAP --layers combined,indirect,normal --format exr,glb --out bake
    python3 benches/against_cycles.py bake report/quality-points.csv LIGHTS

Run by hand; nothing of the library needs it. LIGHTS are those of the bake and of the scene, of `--light point:...` and
`--light rect:...`; MAP is whatever sets the charts (`--texels-per-unit N`, `--layout FILE`). Emission comes with the scene.

Both are judged by the points and the path traced reference of the report: pages are read there as a shader reads them,
bilinearly. Each side of a face that has texels is a face in Cycles; backs lie 10^-5 of the scene's size behind fronts.
Cycles samples its lights and paths without clamps, thresholds or adaptive sampling, which would make it faster or darker
by leaving out light. Its times are those of its bake call, tree and all, and of the filter for light maps. Prints rows
of a Markdown table.
"""

import argparse
import json
import os
import struct
import sys
import time
from pathlib import Path

import bpy  # Makes the next two importable.
import addon_utils
import mathutils
import numpy as np
import pyoidn

MARGIN = 2
BOUNCES = 1000
COMPONENTS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Glb:
    """The scene that `bakelite bake` wrote: triangles with light map UVs, by material and page."""

    def __init__(self, path):
        data = path.read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        self.json = json.loads(data[20:20 + length])
        self.data = data[20 + length + 8:]

    def array(self, index):
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind, width = COMPONENTS[accessor["componentType"]], WIDTHS[accessor["type"]]
        offset = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", width * np.dtype(kind).itemsize)
        rows = np.ndarray((accessor["count"], width), kind, self.data, offset, (stride, np.dtype(kind).itemsize))
        return rows.copy()

    def primitives(self):
        """Corners, light map UVs, normals or None, albedo, emission and page of each material's triangles."""
        for primitive in (p for mesh in self.json["meshes"] for p in mesh["primitives"]):
            attributes, material = primitive["attributes"], self.json["materials"][primitive["material"]]
            order = self.array(primitive["indices"]).ravel()
            page = material.get("extras", {}).get("lightmap", {}).get("index")
            strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
            emission = strength * np.array(material.get("emissiveFactor", [0, 0, 0]), float)
            albedo = np.array(material["pbrMetallicRoughness"].get("baseColorFactor", [1, 1, 1, 1])[:3], float)
            yield (self.array(attributes["POSITION"])[order].reshape(-1, 3, 3),
                   self.array(attributes["TEXCOORD_1"])[order].reshape(-1, 3, 2) if "TEXCOORD_1" in attributes else None,
                   self.array(attributes["NORMAL"])[order].reshape(-1, 3, 3) if "NORMAL" in attributes else None,
                   albedo, emission, page)


def read_page(path):
    """Rows from the top, three channels."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3].copy()


def bilinear(page, uv):
    height, width = page.shape[:2]
    x, y = uv[0] * width - 0.5, uv[1] * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    at = lambda i, j: page[min(max(y0 + j, 0), height - 1), min(max(x0 + i, 0), width - 1)].astype(float)
    return (1 - fy) * ((1 - fx) * at(0, 0) + fx * at(1, 0)) + fy * ((1 - fx) * at(0, 1) + fx * at(1, 1))


class Scene:
    """All sides that have texels, as one mesh of Blender's whose faces look to the side that their texels show."""

    def __init__(self, folder):
        corners, uvs, normals, materials = [], [], [], []
        kinds = []
        pages = sorted(folder.glob("page*-normal.exr"), key=lambda p: int(p.name[4:].split("-")[0]))
        towards = [read_page(p) for p in pages]
        self.size = towards[0].shape[:2]
        self.pages = len(pages)
        for c, uv, n, albedo, emission, page in Glb(folder / "scene.glb").primitives():
            face = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
            if uv is None or page is None:
                uv, page = np.zeros((len(c), 3, 2), np.float32), None
            else:
                # What texels under the middle of a triangle and near its corners say of the side that they show.
                votes = np.zeros(len(c))
                height, width = self.size
                for weights in ([1 / 3, 1 / 3, 1 / 3], [.8, .1, .1], [.1, .8, .1], [.1, .1, .8]):
                    at = np.einsum("k,tkc->tc", weights, uv)
                    x = np.clip((at[:, 0] * width).astype(int), 0, width - 1)
                    y = np.clip((at[:, 1] * height).astype(int), 0, height - 1)
                    votes += np.sign(np.einsum("tc,tc->t", face, towards[page][y, x]))
                turned = votes < 0
                c[turned], uv[turned] = c[turned][:, ::-1], uv[turned][:, ::-1]
                if n is not None:
                    n[turned] = -n[turned][:, ::-1]
            corners.append(c), uvs.append(uv)
            normals.append(np.repeat(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])[:, None], 3, 1) if n is None else n)
            materials.append(np.full(len(c), len(kinds)))
            kinds.append((albedo, emission, page))
        self.corners, self.uvs, normals = np.concatenate(corners), np.concatenate(uvs), np.concatenate(normals)
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-30)
        self.material = np.concatenate(materials)
        self.kinds = kinds
        self.page = np.array([-1 if k[2] is None else k[2] for k in kinds])[self.material]
        self.diagonal = np.linalg.norm(self.corners.reshape(-1, 3).max(0) - self.corners.reshape(-1, 3).min(0))

    def find(self, position, normal):
        """Page and UV of a point on the side of `normal`; None if no face there has texels."""
        a, b, c = (self.corners[:, k].astype(float) for k in range(3))
        u, v, p = b - a, c - a, position - a
        n = np.cross(u, v)
        area = np.maximum(np.einsum("tc,tc->t", n, n), 1e-300)
        beta = np.einsum("tc,tc->t", np.cross(p, v), n) / area
        gamma = np.einsum("tc,tc->t", np.cross(u, p), n) / area
        off = np.abs(np.einsum("tc,tc->t", p, n)) / np.sqrt(area)
        outside = np.maximum(np.maximum(-beta, -gamma), beta + gamma - 1)
        fits = (outside < 1e-3) & (off < 1e-5 * self.diagonal) & (n @ normal > 0) & (self.page >= 0)
        if not fits.any():
            return None
        t = np.flatnonzero(fits)[np.argmin(outside[fits])]
        return self.page[t], (1 - beta[t] - gamma[t]) * self.uvs[t, 0] + beta[t] * self.uvs[t, 1] + gamma[t] * self.uvs[t, 2]

    def make(self):
        """The scene in Blender; the images that its faces are baked to."""
        bpy.ops.wm.read_factory_settings(use_empty=True)
        addon_utils.enable("cycles")
        corners = self.corners.astype(np.float32)
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-30)
        # Of faces at the same place the later ones are backs.
        key = np.sort(corners.reshape(len(corners), 3, 3).view([("", np.float32)] * 3).reshape(-1, 3), axis=1)
        _, first = np.unique(key.view([("", np.float32)] * 9).ravel(), return_index=True)
        back = np.ones(len(corners), bool)
        back[first] = False
        corners[back] += 1e-5 * self.diagonal * face[back, None]
        count = len(corners)
        mesh = bpy.data.meshes.new("scene")
        mesh.vertices.add(3 * count), mesh.loops.add(3 * count), mesh.polygons.add(count)
        mesh.vertices.foreach_set("co", corners.ravel())
        mesh.loops.foreach_set("vertex_index", np.arange(3 * count, dtype=np.int32))
        mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
        mesh.polygons.foreach_set("material_index", self.material.astype(np.int32))
        uv = self.uvs.reshape(-1, 2).copy()
        uv[:, 1] = 1 - uv[:, 1]
        mesh.uv_layers.new(name="lightmap").data.foreach_set("uv", uv.ravel().astype(np.float32))
        mesh.update(calc_edges=True)
        mesh.polygons.foreach_set("use_smooth", np.ones(count, bool))
        mesh.normals_split_custom_set(self.normals.reshape(-1, 3).tolist())
        images = [bpy.data.images.new(f"page{i}", self.size[1], self.size[0], float_buffer=True) for i in range(self.pages)]
        unused = bpy.data.images.new("unused", 4, 4, float_buffer=True)
        for albedo, emission, page in self.kinds:
            material = bpy.data.materials.new("material")
            material.use_nodes = True
            nodes, links = material.node_tree.nodes, material.node_tree.links
            nodes.clear()
            diffuse, emit = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeEmission")
            add, output, image = (nodes.new(f"ShaderNode{k}") for k in ("AddShader", "OutputMaterial", "TexImage"))
            diffuse.inputs["Color"].default_value = (*albedo, 1)
            brightest = emission.max()
            emit.inputs["Color"].default_value = (*(emission / (brightest or 1)), 1)
            emit.inputs["Strength"].default_value = brightest
            links.new(diffuse.outputs[0], add.inputs[0])
            if brightest > 0:
                links.new(emit.outputs[0], add.inputs[1])
            links.new(add.outputs[0], output.inputs["Surface"])
            image.image = unused if page is None else images[page]
            nodes.active = image
            mesh.materials.append(material)
        target = bpy.data.objects.new("scene", mesh)
        bpy.context.scene.collection.objects.link(target)
        bpy.context.view_layer.objects.active = target
        target.select_set(True)
        return images


def add_light(text):
    kind, *numbers = text.split(":")
    numbers = [np.array(n.split(","), float) for n in numbers]
    color = numbers[-1]
    if kind == "point":
        light = bpy.data.lights.new("light", "POINT")
        light.shadow_soft_size = 0
        # Radiant flux of a light that shines alike in all directions.
        light.energy = 4 * np.pi * color.max()
        place = mathutils.Matrix.Translation(numbers[0])
    elif kind == "rect":
        corner, u, v = numbers[:3]
        light = bpy.data.lights.new("light", "AREA")
        light.shape = "RECTANGLE"
        light.size, light.size_y = np.linalg.norm(u), np.linalg.norm(v)
        light.energy = np.pi * color.max() * light.size * light.size_y
        # It shines along its negative z axis.
        z = -np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        axes = np.stack([u / light.size, np.cross(z, u / light.size), z, corner + (u + v) / 2], 1)
        place = mathutils.Matrix(np.concatenate([axes, [[0, 0, 0, 1]]]).tolist())
    else:
        sys.exit(f"against_cycles.py: only point and rect lights are understood, not {text}")
    light.color = color / color.max()
    thing = bpy.data.objects.new("light", light)
    thing.matrix_world = place
    bpy.context.scene.collection.objects.link(thing)


def bake(images, samples, parts, threads):
    """Irradiance of all pages, rows from the top, and the seconds that it took."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.threads_mode, scene.render.threads = "FIXED", threads
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", samples, 1
    cycles.use_adaptive_sampling = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.light_sampling_threshold = 0
    cycles.max_bounces = cycles.diffuse_bounces = BOUNCES
    start = time.perf_counter()
    bpy.ops.object.bake(type="DIFFUSE", pass_filter=parts, margin=MARGIN, use_clear=True, target="IMAGE_TEXTURES")
    seconds = time.perf_counter() - start
    pages = []
    for image in images:
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
        # The pass is light by albedo as radiance: irradiance / pi.
        pages.append(np.pi * pixels.reshape(height, width, 4)[::-1, :, :3])
    return pages, seconds


def denoised(pages):
    """The pages filtered by Open Image Denoise's filter for light maps, and the seconds that it took."""
    filtered, seconds = [], 0
    with pyoidn.Device() as device:
        device.commit()
        for page in pages:
            page = np.ascontiguousarray(page, np.float32)
            out = np.zeros_like(page)
            start = time.perf_counter()
            with pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT_LIGHTMAP) as of_page:
                of_page.set_image(pyoidn.OIDN_IMAGE_COLOR, page, pyoidn.OIDN_FORMAT_FLOAT3)
                of_page.set_image(pyoidn.OIDN_IMAGE_OUTPUT, out, pyoidn.OIDN_FORMAT_FLOAT3)
                of_page.commit()
                of_page.execute()
            seconds += time.perf_counter() - start
            filtered.append(out)
        if device.get_error() is not None:
            sys.exit(f"against_cycles.py: {device.get_error()}")
    return filtered, seconds


class Points:
    def __init__(self, path, scene):
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        places = [scene.find(row[3:6], row[6:9]) for row in rows]
        kept = [i for i, place in enumerate(places) if place is not None]
        self.places, rows = [places[i] for i in kept], rows[kept]
        self.left_out = len(places) - len(kept)
        halves = rows[:, 12:].reshape(len(rows), 4, 3)
        self.indirect, self.all = halves[:, 0:2], halves[:, 2:4]

    def read(self, pages):
        return np.array([bilinear(pages[page], uv) for page, uv in self.places])

    def error(self, light, halves):
        """Relative MSE, in which the noise of the reference cancels (its halves are independent), without the worst
        hundredth of the points, and the sum of light by that of the reference; as `bakelite report quality` has them."""
        truth = halves.mean(1)
        weight = 1 / (truth ** 2 + (0.1 * truth.mean()) ** 2)
        squares = (weight * (light - halves[:, 0]) * (light - halves[:, 1])).mean(1)
        best = np.sort(squares)[:len(squares) - -(-len(squares) // 100)]
        return squares.mean(), best.mean(), light.sum() / truth.sum()


def scientific(value):
    return f"{value:.1e}".replace("e-0", "e-").replace("e+00", "").replace("e+0", "e")


def row(name, seconds, points, indirect, everything):
    texts = []
    for light, truth in ((indirect, points.indirect), (everything, points.all)):
        mse, trimmed, sigma = points.error(light, truth)
        texts += [f"{scientific(mse)} ({scientific(trimmed)})", f"{sigma:.3f}"]
    print(f"| {name} | {seconds} | " + " | ".join(texts) + " |", flush=True)


def main():
    options = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    options.add_argument("bake", type=Path), options.add_argument("points", type=Path)
    options.add_argument("--also", action="append", default=[], type=Path, help="another bake of the scene")
    options.add_argument("--light", action="append", default=[], metavar="point:X,Y,Z:R,G,B")
    options.add_argument("--samples", default="1,4,16,64", help="samples per texel [%(default)s]")
    options.add_argument("--threads", type=int, default=os.cpu_count())
    options = options.parse_args()

    scene = Scene(options.bake)
    points = Points(options.points, scene)
    print(f"{len(scene.corners)} sides of triangles, {scene.pages} pages, {len(points.places)} points "
          f"({points.left_out} on no side that is shown)\n")
    print("| | seconds | indirect light: MSE (without the worst 1 %) | sum | all light | sum |\n|---|---|---|---|---|---|")
    for folder in [options.bake, *options.also]:
        its_scene = scene if folder == options.bake else Scene(folder)
        its_points = Points(options.points, its_scene)
        pages = {layer: [read_page(folder / f"page{i}-{layer}.exr") for i in range(its_scene.pages)]
                 for layer in ("indirect", "combined")}
        seconds = json.loads((folder / "report.json").read_text())["bake"]["seconds"]
        row(f"Bakelite, `{folder.name}`", f"{seconds:.2f}", its_points, *(its_points.read(p) for p in pages.values()))
    images = scene.make()
    for light in options.light:
        add_light(light)
    for samples in options.samples.split(","):
        indirect, seconds = bake(images, int(samples), {"INDIRECT"}, options.threads)
        both, seconds_both = bake(images, int(samples), {"DIRECT", "INDIRECT"}, options.threads)
        seconds = min(seconds, seconds_both)
        name = f"Cycles, {samples} samples"
        row(name, f"{seconds:.1f}", points, points.read(indirect), points.read(both))
        (indirect, _), (both, more) = denoised(indirect), denoised(both)
        row(name + ", denoised", f"{seconds + more:.1f}", points, points.read(indirect), points.read(both))


main()
