"""What makes a mesh the surface of a body."""

import numpy as np
import trimesh

from pipeline.fusion.crossings import crossing_faces
from rig.mesh import Mesh


def check_closed(mesh: Mesh) -> None:
    """Two faces at every edge, once either way, one fan about every vertex, outwards, nowhere through itself."""
    vertices, faces = mesh.vertices, mesh.faces
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth = edges[:, 0].astype(np.int64) * len(vertices) + edges[:, 1]
    back = edges[:, 1].astype(np.int64) * len(vertices) + edges[:, 0]
    assert len(np.unique(forth)) == len(forth)
    assert np.array_equal(np.sort(forth), np.sort(back))
    assert one_fan_a_vertex(faces, len(vertices))
    made = trimesh.Trimesh(vertices, faces, process=False)
    assert made.body_count == 1
    assert made.volume > 0
    assert np.isfinite(vertices).all()
    assert not crossing_faces(vertices, faces).any()


def one_fan_a_vertex(faces: np.ndarray, count: int) -> bool:
    """Walking from face to face about a vertex meets all of its faces."""
    corners = np.stack([faces, np.roll(faces, -1, 1), np.roll(faces, 1, 1)], axis=2).reshape(-1, 3)
    after = {(v, a): b for v, a, b in corners.tolist()}
    first = dict(zip(corners[:, 0].tolist(), corners[:, 1].tolist(), strict=True))
    degree = np.bincount(faces.ravel(), minlength=count)
    for vertex, start in first.items():
        steps, at = 1, after[vertex, start]
        while at != start:
            steps, at = steps + 1, after[vertex, at]
        if steps != degree[vertex]:
            return False
    return True
