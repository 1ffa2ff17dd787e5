"""Writes a head as named parts: Wavefront OBJ, and USDZ (through OpenUSD, the extra ``usd``) whose parts can turn."""

import io
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rig.colour_space import linear_from_srgb
from rig.formats.meshes.pivot_glb import quaternion
from rig.formats.meshes.usdz import check_usd, define_mesh, new_stage, openusd_module, package
from rig.geometry import RigidTransform
from rig.mesh import Mesh


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPart:
    """Holds a part: its mesh about the point that it turns about, and where that point lies and how it is turned in the
    head's frame (mm)."""

    mesh: Mesh
    place: RigidTransform


def parts_obj_bytes(parts: Mapping[str, PlacedPart]) -> bytes:
    """Encodes parts as objects of a Wavefront OBJ, in mm, with vertex colours after the positions."""
    text, first = io.StringIO(), 1
    for name, part in parts.items():
        vertices, colours = part.place.apply(part.mesh.vertices), _colours(part.mesh)
        text.write(f"o {name}\n")
        np.savetxt(text, np.concatenate([vertices, colours], axis=1), fmt="v %.4f %.4f %.4f %.4f %.4f %.4f")
        np.savetxt(text, part.mesh.faces + first, fmt="f %d %d %d")
        first += len(vertices)
    return text.getvalue().encode()


def parts_usdz_bytes(parts: Mapping[str, PlacedPart]) -> bytes:
    """Encodes parts as meshes of one USDZ, y up, in metres, with vertex colours. A part's translation and orientation
    are operations of its own. Raises NoUsd."""
    check_usd()
    with tempfile.TemporaryDirectory() as scratch:
        layer = Path(scratch) / "head.usdc"
        _write_layer(layer, parts)
        return package({"head.usdc": layer.read_bytes()})


def _write_layer(path: Path, parts: Mapping[str, PlacedPart]) -> None:
    Gf, UsdGeom, Vt = map(openusd_module, ("Gf", "UsdGeom", "Vt"))
    stage = new_stage(path, "/person")
    for name, part in parts.items():
        shape = define_mesh(stage, f"/person/{name}", part.mesh, part.mesh.normals())
        colours = linear_from_srgb(_colours(part.mesh)).astype(np.float32)
        shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(colours))
        x, y, z, w = quaternion(part.place.rotation).tolist()
        shape.AddTranslateOp().Set(Gf.Vec3d(*(part.place.translation / 1000.0).tolist()))
        shape.AddOrientOp().Set(Gf.Quatf(w, x, y, z))
    stage.GetRootLayer().Save()


def _colours(mesh: Mesh) -> np.ndarray:
    """Returns sRGB colours from 0 to 1, grey where a mesh has none."""
    return np.full(mesh.vertices.shape, 200 / 255.0) if mesh.colours is None else mesh.colours / 255.0
