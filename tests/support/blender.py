"""Does Blender open a result's files, with texture, scale and the head upright? Not a test: Blender's module is no
dependency of this project (GPL, 350 MB) and stands in an environment of its own:

    uv run --no-project --python 3.11 --with bpy==4.2.0 python tests/support/blender.py heads/one --pictures out/blender

for a result of ``eigenhead reconstruct ... --formats glb,obj,usdz,stl``, with ``--template NAME --morphs`` its shapes,
too. Prints a line a file and ends with status 1 where something is wrong; each file is drawn as it stands in the
scene, to be looked at.
"""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np

bpy: Any = importlib.import_module("bpy")
SIZE_PX, SAMPLES = 360, 8
OPENED = {
    ".glb": lambda path: bpy.ops.import_scene.gltf(filepath=path),
    ".obj": lambda path: bpy.ops.wm.obj_import(filepath=path),
    ".usdz": lambda path: bpy.ops.wm.usd_import(filepath=path),
    ".stl": lambda path: bpy.ops.wm.stl_import(filepath=path),
}
TEXTURED = (".glb", ".obj", ".usdz")
UNITS_A_METRE = {".glb": 1.0, ".usdz": 1.0, ".obj": 1000.0, ".stl": 1000.0}
PIVOTS = ("neck", "head", "jaw", "eye_right", "eye_left")
HEIGHT_M = (0.2, 0.4)  # of a head with its neck


def opened(path: Path) -> tuple[str, list[str]]:
    """What a file is as Blender opens it, and what is wrong with it; the scene is left open."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    OPENED[path.suffix](str(path))
    corners = vertices()
    extent_m = np.ptp(corners, axis=0) / UNITS_A_METRE[path.suffix]
    images = [tuple(image.size) for image in bpy.data.images]
    found = []
    if not HEIGHT_M[0] <= extent_m[2] <= HEIGHT_M[1]:
        found.append(f"{path.name}: {extent_m[2]:.3f} m high")
    if path.suffix != ".obj" and extent_m.argmax() != 2:  # head.obj lies in the capture's world frame, as head.ply
        found.append(f"{path.name}: not upright, {np.round(extent_m, 3)} m")
    if path.suffix in TEXTURED and not any(min(size) > 1 for size in images):
        found.append(f"{path.name}: no texture")
    return f"{path.name}: {len(corners)} vertices, {np.round(extent_m, 3)} m, textures {images}", found


def played(path: Path) -> tuple[str, list[str]]:
    """What a template's mesh with shapes is in Blender, and what is wrong with it: every shape key must move what its
    morph target says, and every pivot must be an object."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    OPENED[path.suffix](str(path))
    head = bpy.data.objects["head"]
    keys = head.data.shape_keys.key_blocks
    found = [f"{path.name}: no object {name}" for name in PIVOTS if name not in bpy.data.objects]
    found += [] if "jawOpen" in keys else [f"{path.name}: no shape key jawOpen"]
    rest = np.array([point.co for point in keys[0].data])
    moved_mm = {key.name: 1000.0 * np.linalg.norm(np.array([p.co for p in key.data]) - rest, axis=1) for key in keys}
    for key in keys:
        key.value = 0.0
    still = shown(head)
    for name in moved_mm.keys() & {"jawOpen", "eyeBlinkLeft"}:
        keys[name].value = 0.5
        played_mm = 1000.0 * np.linalg.norm(shown(head) - still, axis=1)
        keys[name].value = 0.0
        if not np.allclose(played_mm, 0.5 * moved_mm[name], atol=0.01):
            found.append(f"{path.name}: {name} does not play")
    open_mm = moved_mm.get("jawOpen", np.zeros(1)).max()
    return f"{path.name}: {len(keys) - 1} shape keys, jawOpen moves {open_mm:.1f} mm", found


def shown(thing: Any) -> np.ndarray:
    """(n, 3), the vertices of an object as its shape keys have them now."""
    bpy.context.view_layer.update()
    mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    return np.array([vertex.co for vertex in mesh.vertices])


def vertices() -> np.ndarray:
    """(n, 3) of every mesh in the scene, in its units; z is up."""
    meshes = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    return np.array([thing.matrix_world @ vertex.co for thing in meshes for vertex in thing.data.vertices])


def draw(path: Path) -> None:
    """The scene from the front, by Cycles."""
    corners, scene = vertices(), bpy.context.scene
    middle, reach = (corners.min(axis=0) + corners.max(axis=0)) / 2, float(np.ptp(corners, axis=0).max())
    lens = bpy.data.cameras.new("front")
    lens.clip_start, lens.clip_end = 0.01 * reach, 100.0 * reach
    camera = bpy.data.objects.new("front", lens)
    camera.location = middle + reach * np.array([0.5, -2.2, 0.1])
    towards = type(camera.location)(middle) - camera.location
    camera.rotation_euler = towards.to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    world = bpy.data.worlds.new("white")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
    scene.world, scene.camera = world, camera
    scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", SAMPLES, "CPU"
    scene.render.resolution_x = scene.render.resolution_y = SIZE_PX
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("--pictures", type=Path)
    arguments = parser.parse_args()
    paths = [path for path in sorted(arguments.result.glob("*head.*")) if path.suffix in OPENED]
    animated = sorted(arguments.result.glob("head-*.glb"))
    found = [] if paths or animated else [f"{arguments.result}: no head in it"]
    for path in animated:
        line, wrong = played(path.resolve())
        sys.stdout.write(line + "\n")
        found += wrong
    for path in paths:
        line, wrong = opened(path.resolve())
        sys.stdout.write(line + "\n")
        found += wrong
        if arguments.pictures is not None:
            draw(arguments.pictures.resolve() / f"{path.stem}-{path.suffix[1:]}.png")
    (sys.stderr if found else sys.stdout).write(("\n".join(found) or "nothing wrong") + "\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
