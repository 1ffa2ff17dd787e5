"""Draws a small picture of a result, by which people and heads are told apart at a glance: of the bust if there is
one."""

import json
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from pipeline.results.clay import clay
from rig.formats.meshes.mesh_file import read_mesh
from rig.geometry import RigidTransform
from rig.mesh import Mesh
from server.console.comparison import ply_property

PANEL = (240, 300)  # width, height
PAPER = (23, 27, 33)
AZIMUTH_DEG = 22.0
DARKEST = 0.55
MARGIN = 1.12  # of the head's box, for hair


def portrait(result: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Draws a small picture (RGB) of a result's bust, or else its head, turned by ``AZIMUTH_DEG``, in the colours of
    the photographs. Raises FileNotFoundError if there is no head."""
    name = "bust.ply" if (result / "bust.ply").is_file() else "head.ply"
    head_from_world = placed(result)
    head = head_from_world.apply(read_mesh(result / "head.ply").vertices)
    mesh = read_mesh(result / name)
    colours = np.stack([ply_property(result / name, part) for part in ("red", "green", "blue")], axis=1)
    middle, half = (head.min(axis=0) + head.max(axis=0)) / 2, MARGIN * (head.max(axis=0) - head.min(axis=0)) / 2
    shown = Mesh(head_from_world.apply(mesh.vertices), mesh.faces)
    box = (middle - half, middle + half)
    rgb = colours.astype(np.uint8)
    return clay(shown, colours=rgb, azimuth_deg=AZIMUTH_DEG, panel=PANEL, box=box, paper=PAPER, darkest=DARKEST)


def placed(result: Path) -> RigidTransform:
    """Returns the rigid transform head_from_world of a result's report; the identity if the report has none."""
    try:
        pose = json.loads((result / "report.json").read_text())["world_from_head"]
    except (FileNotFoundError, KeyError):
        return RigidTransform(np.eye(3), np.zeros(3))
    shift = np.array(pose["translation"]) * pose["scale"]
    return RigidTransform(np.array(pose["rotation"]), shift).inverse()
