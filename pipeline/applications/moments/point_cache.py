"""Writes a moving mesh as a point cache of OpenUSD (package extra ``usd``), with the points of every frame in one
layer.

https://openusd.org/release/api/class_usd_geom_point_based.html"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int32

from rig.files import write_atomically
from rig.formats.meshes.scene import Part, Scene
from rig.formats.meshes.usdz import ROOT, check_usd, openusd_module, vectors, write_layer
from rig.mesh import Mesh, vertex_normals


def write_point_cache(
    path: Path, frames: Sequence[Float[np.ndarray, "v 3"]], faces: Int32[np.ndarray, "f 3"], times_s: np.ndarray
) -> None:
    """Writes the vertices (mm) of ``frames`` to ``path`` (.usdc), y up, in metres. The frames' times are ``times_s``;
    the unit of USD's time codes is the median interval. Raises NoUsd and OSError."""
    check_usd()
    Usd, UsdGeom = map(openusd_module, ("Usd", "UsdGeom"))
    codes = (times_s - times_s[0]) / np.median(np.diff(times_s))
    with tempfile.TemporaryDirectory() as scratch:
        layer = Path(scratch) / path.name
        write_layer(layer, Scene([Part("head", Mesh(frames[0], faces))]))
        stage = Usd.Stage.Open(str(layer))
        head = UsdGeom.Mesh(stage.GetPrimAtPath(f"{ROOT}/head"))
        attributes = head.GetPointsAttr(), head.GetNormalsAttr(), head.GetExtentAttr()
        for code, vertices in zip(codes.tolist(), frames, strict=True):
            points = vertices / 1000.0
            box = np.stack([points.min(axis=0), points.max(axis=0)])
            for attribute, values in zip(attributes, (points, vertex_normals(vertices, faces), box), strict=True):
                attribute.Set(vectors("Vec3fArray", values), code)
        stage.SetTimeCodesPerSecond(1.0 / float(np.median(np.diff(times_s))))
        stage.SetStartTimeCode(codes[0])
        stage.SetEndTimeCode(codes[-1])
        stage.GetRootLayer().Save()
        write_atomically(path, layer.read_bytes())
