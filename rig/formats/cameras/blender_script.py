"""Writes a Python script that adds a rig's cameras to a Blender scene (``blender --python cameras.py``).

A camera in Blender (https://docs.blender.org/api/current/bpy.types.Camera.html) has no distortion. With ``sensor_fit``
HORIZONTAL a Blender camera's focal length in pixels is ``lens * width / sensor_width``. Blender's ``shift_x`` and
``shift_y`` move a camera's frame to the right and up, as fractions of the width. Blender's camera axes are x right, y
up and z backwards; lengths are in metres. Only undistorted photographs fit as backgrounds. A custom property of each
camera holds the displacement of the picture's corners by the lens."""

import json
from pathlib import Path

import numpy as np

from rig.camera import Camera
from rig.files import write_atomically
from rig.formats.cameras.transforms_json import opengl_pose
from rig.rig import Rig

SENSOR_MM = 36.0

_SCRIPT = '''"""The cameras of a rig, for Blender: run it in the text editor, or by `blender --python`."""

import json

import bpy
from mathutils import Matrix

CAMERAS = json.loads(r"""
{cameras}
""")

collection = bpy.data.collections.new("rig")
bpy.context.scene.collection.children.link(collection)
for entry in CAMERAS:
    data = bpy.data.cameras.new(entry["name"])
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = entry["sensor_width_mm"]
    data.lens = entry["lens_mm"]
    data.shift_x, data.shift_y = entry["shift"]
    data.clip_start, data.clip_end = 0.01, 100.0
    camera = bpy.data.objects.new(entry["name"], data)
    camera.matrix_world = Matrix(entry["matrix_world"])
    camera["width"], camera["height"] = entry["size"]
    camera["note"] = entry["note"]
    collection.objects.link(camera)
render = bpy.context.scene.render
render.resolution_x, render.resolution_y = CAMERAS[0]["size"]
render.pixel_aspect_x, render.pixel_aspect_y = CAMERAS[0]["pixel_aspect"]
bpy.context.scene.camera = bpy.data.objects[CAMERAS[0]["name"]]
'''


def write_blender(rig: Rig, path: Path) -> None:
    """Writes the Blender script for a rig to ``path``."""
    entries = ",\n".join(json.dumps(_entry(camera)) for camera in rig)
    write_atomically(path, _SCRIPT.replace("{cameras}", f"[{entries}]").encode())


def _entry(camera: Camera) -> dict[str, object]:
    k = camera.intrinsics
    shift = [(0.5 * k.width - k.cx - 0.5) / k.width, (k.cy + 0.5 - 0.5 * k.height) * (k.fx / k.fy) / k.width]
    return {
        "name": camera.name,
        "size": [k.width, k.height],
        "lens_mm": k.fx / k.width * SENSOR_MM,
        "sensor_width_mm": SENSOR_MM,
        "shift": shift,
        "pixel_aspect": [1.0, k.fx / k.fy] if k.fx >= k.fy else [k.fy / k.fx, 1.0],
        "matrix_world": opengl_pose(camera),
        "note": _note(camera),
    }


def _note(camera: Camera) -> str:
    k = camera.intrinsics
    corners = np.array([[0, 0], [k.width, 0], [0, k.height], [k.width, k.height]], float) - 0.5
    if camera.recorded is not None:
        bent = camera.recorded.distorted(corners, k.matrix()) - corners
    else:
        normalised = (corners - (k.cx, k.cy)) / (k.fx, k.fy)
        bent = (k.distortion.apply(normalised) - normalised) * (k.fx, k.fy)
    return f"no lens distortion here: it moves the corners by up to {np.linalg.norm(bent, axis=1).max():.1f} px"
