"""Reads a scan: a triangle mesh in the file's unit and axes, with vertices joined along seams, and its colours."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int, UInt8
from trimesh.remesh import subdivide

from pipeline.applications.model_building.correspondence.scans import weld_scan
from rig.errors import InputError
from rig.formats.meshes.mesh_file import TexturedMesh, read_textured_mesh
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import compose

MIN_TRIANGLES = 1000  # of a head; scan_checks asks the same of scans
MAX_TRIANGLES = 4_000_000  # about 4 GB while closest points are searched
DRAWN_TRIANGLES = 100_000  # with fewer, a texture read at the vertices would be too coarse for the face finder
GREY = 190  # of a scan without colours


@dataclass(frozen=True, slots=True, eq=False)
class RawScan:
    """Holds a scan in the unit and axes of its file. Triangles of ``mesh`` and ``painted`` have the same order."""

    name: str
    mesh: Mesh  # vertices joined along seams, no colours
    painted: TexturedMesh  # as the file has it

    @property
    def is_coloured(self) -> bool:
        """Returns whether the file contains a texture or vertex colours."""
        return self.painted.image is not None or self.painted.mesh.colours is not None

    def turned_over(self) -> "RawScan":
        """Returns the scan with all triangles flipped."""
        painted = replace(self.painted, mesh=_reversed(self.painted.mesh))
        return RawScan(self.name, _reversed(self.mesh), painted)

    def colours_at(
        self, triangles: Int[np.ndarray, " n"], weights: Float[np.ndarray, "n 3"]
    ) -> UInt8[np.ndarray, "n 3"]:
        """Returns the sRGB colours of points on the surface, given by triangle and barycentric weights; grey if the
        file has no colours."""
        rows = self.painted.mesh.faces[triangles]
        if self.painted.image is not None and self.painted.uv is not None:
            return _texels(self.painted.image, np.einsum("nk,nkx->nx", weights, self.painted.uv[rows]))
        if self.painted.mesh.colours is None:
            return np.full((len(triangles), 3), GREY, np.uint8)
        mixed = np.einsum("nk,nkc->nc", weights, self.painted.mesh.colours[rows].astype(float))
        return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)

    def drawable(self) -> Mesh:
        """Returns the scan with vertex colours, subdivided so that vertex colours do not blur the texture."""
        mesh = self.painted.mesh
        if self.painted.image is None or self.painted.uv is None:
            return mesh
        vertices, faces, painted = mesh.vertices, mesh.faces, {"uv": self.painted.uv}
        while len(faces) < DRAWN_TRIANGLES:
            vertices, faces, painted = cast(Any, subdivide)(vertices, faces, vertex_attributes=painted)
        return Mesh(vertices, faces.astype(np.int32), _texels(self.painted.image, painted["uv"]))


def read_raw_scan(path: Path) -> RawScan:
    """Reads a scan with its colours. Raises InputError that states the file's fault."""
    painted = read_textured_mesh(path)
    count = len(painted.mesh.faces)
    if count < MIN_TRIANGLES:
        raise InputError(path.name, [compose("scan-coarse", count=count, least=MIN_TRIANGLES)])
    if count > MAX_TRIANGLES:
        raise InputError(path.name, [compose("scan-huge", count=count, most=MAX_TRIANGLES)])
    if not np.ptp(painted.mesh.vertices[painted.mesh.faces], axis=(0, 1)).min() > 0.0:
        raise InputError(path.name, [compose("scan-flat")])
    return raw_scan(painted, path.name)


def raw_scan(painted: TexturedMesh, name: str) -> RawScan:
    """Joins the mesh's vertices that lie at the same position, and removes degenerate triangles."""
    mesh, (whole, proper) = painted.mesh, weld_scan(painted.mesh)
    return RawScan(name, whole, replace(painted, mesh=Mesh(mesh.vertices, mesh.faces[proper], mesh.colours)))


def _reversed(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), mesh.colours)


def _texels(image: ImageRgb, uv: Float[np.ndarray, "n 2"]) -> UInt8[np.ndarray, "n 3"]:
    """Reads a texture bilinearly at texture coordinates (v upwards), which repeat outside the unit square."""
    size = np.array(image.shape[1::-1])
    shares = np.where((uv >= 0.0) & (uv <= 1.0), uv, uv % 1.0)
    at = np.clip(np.stack([shares[:, 0], 1.0 - shares[:, 1]], axis=1) * size - 0.5, 0.0, size - 1.0)
    first = np.minimum(at.astype(int), np.maximum(size - 2, 0))
    (left, top), (right, bottom) = first.T, np.minimum(first + 1, size - 1).T
    across, down = (at - first).T[:, :, None]
    upper = (1.0 - across) * image[top, left] + across * image[top, right]
    lower = (1.0 - across) * image[bottom, left] + across * image[bottom, right]
    return np.rint((1.0 - down) * upper + down * lower).astype(np.uint8)
