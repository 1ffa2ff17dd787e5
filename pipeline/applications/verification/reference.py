"""Holds the reference scan of the mannequin (mm, in any frame) and its landmarks.

Files are checked for faults first: a scan in metres or centimetres, too few triangles (half a file), faces with
inconsistent orientation, landmarks off the surface. Holes are allowed; ``judgement`` reports which fraction of each
region the scan covers."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.applications.model_building.correspondence.scans import landmark_file, read_landmarks, weld_scan
from pipeline.geometry.surface_index import Hits, SurfaceIndex
from rig.errors import InputError
from rig.files import sha256_of
from rig.formats.meshes.mesh_file import read_mesh
from rig.mesh import Mesh, boundary_edges

MIN_TRIANGLES = 1000  # of a head; scan_checks asks the same of scans
SIZE_MM = (150.0, 1500.0)  # diagonal: from a bare face to a life-size figure down to the waist
OFF_SURFACE_MM = 5.0  # a landmark marked on this mesh lies on it; the rest is the marking program's rounding
TURNED_EDGES = 0.002  # share of edges whose triangles face opposite ways: more is no scan's noise
SPACING_MM = 2.0  # of the samples by which closest points are found
ON_EDGE = 1e-9  # a corner's share of a closest point that lies on the edge across it


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Holds a scan of the subject (mm, in any frame) with a search index for closest points. ``rim`` lists the scan's
    open edges; ``landmarks`` may be empty."""

    name: str
    sha256: str
    mesh: Mesh
    landmarks: Mapping[str, Float[np.ndarray, " 3"]]
    index: SurfaceIndex
    rim: Int[np.ndarray, " e"]  # open edges, as numbers of ``_edge_numbers``, sorted

    @classmethod
    def of(
        cls, mesh: Mesh, landmarks: Mapping[str, Float[np.ndarray, " 3"]], name: str = "reference", sha256: str = ""
    ) -> "Reference":
        """Checks a mesh and prepares it as a reference. The mesh must not contain repeated vertices. Raises InputError
        that lists every fault of the mesh."""
        faults = [*_surface_faults(mesh), *_landmark_faults(mesh, landmarks)]
        if faults:
            raise InputError(name, faults)
        rim = np.unique(_edge_numbers(boundary_edges(mesh.faces), len(mesh.vertices)))
        return cls(name, sha256, mesh, dict(landmarks), SurfaceIndex(mesh.vertices, mesh.faces, SPACING_MM), rim)

    def beside(self, hits: Hits) -> Bool[np.ndarray, " n"]:
        """Returns a mask of the closest points that lie on an open edge of the scan, so are no valid matches."""
        corners, off = self.mesh.faces[hits.triangles], hits.weights < ON_EDGE
        found = np.zeros(len(corners), bool)
        for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            numbers = _edge_numbers(corners[:, [i, j]], len(self.mesh.vertices))
            found |= off[:, k] & np.isin(numbers, self.rim)
        # A corner of the rim is also a corner of triangles without an edge on it.
        rim_corners = np.unique(np.divmod(self.rim, len(self.mesh.vertices)))
        return found | ((hits.weights > 1 - ON_EDGE) & np.isin(corners, rim_corners)).any(axis=1)


def read_reference(path: Path, landmarks: Path | None = None) -> Reference:
    """Reads a scan with its landmarks: from the file ``landmarks`` or, if None, from a file of the same name beside the
    scan, if it exists. Raises InputError that lists every fault of the file."""
    mesh, _ = weld_scan(read_mesh(path))
    landmarks_path = landmarks or landmark_file(path)
    marks = {} if landmarks_path is None else read_landmarks(landmarks_path)
    return Reference.of(mesh, marks, path.name, sha256_of(path))


def _edge_numbers(edges: Int[np.ndarray, "e 2"], count: int) -> Int[np.ndarray, " e"]:
    low, high = np.sort(edges.astype(np.int64), axis=1).T
    return low * count + high


def _surface_faults(mesh: Mesh) -> list[str]:
    if len(mesh.faces) < MIN_TRIANGLES:
        return [f"has {len(mesh.faces)} triangles; the scan of a head has thousands: is the file whole?"]
    used = mesh.vertices[np.unique(mesh.faces)]
    size = float(np.linalg.norm(np.ptp(used, axis=0)))
    if not SIZE_MM[0] <= size <= SIZE_MM[1]:
        return [f"is {size:.3g} mm from corner to corner{_likely_unit(size)}: scale it to mm"]
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).astype(np.int64)
    numbers = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    turned = len(numbers) - len(np.unique(numbers))
    if turned > TURNED_EDGES * len(numbers):
        return [
            f"{turned} edges join triangles that face opposite ways, or triangles lie twice: orient its faces alike"
        ]
    return []


def _likely_unit(size: float) -> str:
    found = [unit for unit, factor in (("cm", 10.0), ("m", 1000.0)) if SIZE_MM[0] <= size * factor <= SIZE_MM[1]]
    return f", which is a head in {' or '.join(found)}" if found else ""


def _landmark_faults(mesh: Mesh, landmarks: Mapping[str, Float[np.ndarray, " 3"]]) -> list[str]:
    if not landmarks or not len(mesh.faces):
        return []
    names, points = list(landmarks), np.array(list(landmarks.values()), float)
    away = SurfaceIndex(mesh.vertices, mesh.faces).closest(points).distances
    far = [f"{name} ({d:.0f} mm)" for name, d in zip(names, away, strict=True) if d > OFF_SURFACE_MM]
    return (
        [f"landmarks off the surface: {', '.join(far)}; are mesh and landmarks in one frame and unit?"] if far else []
    )
