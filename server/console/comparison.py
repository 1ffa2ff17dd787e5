"""Computes the numbers by vertex with which the 3D view colours a head, in the order of the vertices of head.ply and
head.glb."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rig.formats.meshes.mesh_file import read_mesh
from rig.mesh import Mesh
from rig.messages.message import compose
from server.errors import NotFound
from server.services.truth import surface_distance

TYPES = {"float": "<f4", "uchar": "u1", "int": "<i4", "double": "<f8", "short": "<i2", "ushort": "<u2", "uint": "<u4"}
ROUNDS = 12  # of nearest points, where two heads do not share their vertices
TRIMMED = 0.8  # share of the nearest pairs that a round uses: necks end at different heights


def ply_property(path: Path, name: str) -> Float[np.ndarray, " v"]:
    """Reads one number for each vertex from a binary little-endian PLY file, whose first element must be the vertices.
    Raises NotFound if the file has no such property."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    count, fields, element = 0, [], ""
    for line in data[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[0] == "element":
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[0] == "property" and element == "vertex":
            fields.append((words[2], TYPES[words[1]]))
    if name not in dict(fields):
        raise NotFound(compose("thing-vertex-number"), name, compose("hint-other-numbers", file=path.name))
    return np.frombuffer(data, np.dtype(fields), count, end)[name].astype(np.float32)


def to_surface(result: Path, other: Path, *, align: bool = False) -> Float[np.ndarray, " v"]:
    """Computes the distance (mm) of every vertex of a result's head to the surface of the mesh ``other``.

    With ``align`` the result's head is first moved rigidly onto the other one, since heads of different captures stand
    in different places. Raises FileNotFoundError.
    """
    mine, theirs = read_mesh(result / "head.ply"), read_mesh(other)
    points = moved_onto(mine, theirs) if align else mine.vertices
    return surface_distance(points, theirs)


def moved_onto(mine: Mesh, theirs: Mesh) -> Float[np.ndarray, "v 3"]:
    """Returns the vertices of ``mine`` after the rigid motion that brings them closest to ``theirs``. Heads with
    equally many vertices are compared vertex by vertex. Others are compared by nearest points, without the farthest
    fifth."""
    if len(mine.vertices) == len(theirs.vertices):
        return _rigid(mine.vertices, theirs.vertices, mine.vertices)
    points = mine.vertices - mine.vertices.mean(0) + theirs.vertices.mean(0)
    tree = KDTree(theirs.vertices)
    for _ in range(ROUNDS):
        distance, nearest = (np.asarray(part) for part in tree.query(points))
        near = distance <= np.quantile(distance, TRIMMED)
        points = _rigid(points[near], theirs.vertices[nearest[near]], points)
    return points


def _rigid(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v 3"]:
    here, there = source.mean(0), target.mean(0)
    rotation = Rotation.align_vectors(target - there, source - here)[0]
    return rotation.apply(points - here) + there
