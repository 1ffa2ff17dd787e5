"""Work that writes a ball for a head, where the pages around a result are tested: every colour and outline is known."""

import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from rig.files import write_atomically
from rig.formats.meshes.ply import write_ply
from rig.mesh import Mesh
from rig.progress import Progress
from server.tasks.child import WorkerContext
from tests.support.glb import glb_bytes

RADIUS_MM = 90.0
QUALITY_MOST_MM = 2.0  # at the top of the ball; 1.0 at the bottom


def work(context: WorkerContext, report: Progress, *, result: str, **others: object) -> dict[str, Any]:
    """A grey ball about the world's origin; its standard deviation grows with its height; the upper half of the bust is
    hair. It takes ``EIGENHEAD_BALL_S`` seconds longer than it must."""
    time.sleep(float(os.environ.get("EIGENHEAD_BALL_S", "0")))
    folder, round_mesh = Path(result), trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_MM)
    ball = Mesh(np.asarray(round_mesh.vertices), np.asarray(round_mesh.faces, np.int32))
    normals = ball.vertices / RADIUS_MM
    colours = np.full((len(ball.vertices), 3), 128, np.uint8)
    height = (normals[:, 1] + 1) / 2
    views = np.ones(len(ball.vertices), np.uint8)
    quality = (1 + (QUALITY_MOST_MM - 1) * height).astype(np.float32)
    for name in ("head", "bust"):
        part = None if name == "head" else np.where(normals[:, 1] > 0, 2, 1).astype(np.uint8)
        values = {"normals": normals, "colours": colours, "quality": quality, "views": views, "part": part}
        write_ply(folder / f"{name}.ply", ball, comments=["unit mm"], **values)
        (folder / f"{name}.glb").write_bytes(glb_bytes(Mesh(ball.vertices, ball.faces, colours), normals=normals))
    place = {"scale": 1.0, "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]}
    document = {"model": {"name": "ball", "sha256": "0"}, "method": "contour", "world_from_head": place}
    write_atomically(folder / "report.json", json.dumps(document).encode())
    return {}
