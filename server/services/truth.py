"""Compares a result with the true head of a simulated capture on disk.

<capture>.truth/  cameras.json  head.ply  face_mask.npy  colour_mask.npy  silhouettes/  head_silhouettes/  meta.json
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from rig.formats.meshes.mesh_file import read_mesh
from rig.mesh import Mesh


def measure_error_mm(truth: Path, result: Path) -> dict[str, float]:
    """Computes the distance (mm) from the true face region to the surface of ``result``, without aligning the two.
    Returns mean, median and maximum, weighted by area."""
    from pipeline.head_model.subdivision import vertex_areas

    head, face = read_mesh(truth / "head.ply"), np.load(truth / "face_mask.npy")
    distances = measure_distance(head.vertices[face], read_mesh(result))
    weights = vertex_areas(head.vertices, head.faces)[face]
    order = np.argsort(distances)
    share = np.cumsum(weights[order]) / weights.sum()
    return {
        "mean": float(np.average(distances, weights=weights)),
        "median": float(distances[order][np.searchsorted(share, 0.5)]),
        "max": float(distances.max()),
    }


def measure_distance(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> Float[np.ndarray, " n"]:
    """Computes the distance (mm) of each point to the mesh's nearest triangle."""
    from pipeline.geometry.surface_index import SurfaceIndex  # its compiled loops take a second to load

    return SurfaceIndex(mesh.vertices, mesh.faces).closest(points).distances
