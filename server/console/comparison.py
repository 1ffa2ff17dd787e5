"""Computes the numbers by vertex with which the 3D view colours a head, in the order of the vertices of head.ply and
head.glb."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from pipeline.geometry.registration.rigid import rigid_procrustes
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.meshes.ply import read_vertex_numbers
from rig.mesh import Mesh
from rig.messages.message import compose
from server.errors import NotFound
from server.services.truth import surface_distance

ROUNDS = 12  # of nearest points, where two heads do not share their vertices
TRIMMED = 0.8  # share of the nearest pairs that a round uses: necks end at different heights


def vertex_numbers(path: Path, name: str) -> Float[np.ndarray, " v"]:
    """Reads one number for each vertex of a result's surface. Raises NotFound if the file has no such number, and
    InputError for another program's file."""
    values = read_vertex_numbers(path, name)
    if values is None:
        raise NotFound(compose("thing-vertex-number"), name, compose("hint-other-numbers", file=path.name))
    return values


def to_surface(result: Path, other: Path, *, align: bool = False) -> Float[np.ndarray, " v"]:
    """Computes the distance (mm) of every vertex of a result's head to the surface of the mesh ``other``.

    With ``align`` the result's head is first moved rigidly onto the other one, since each capture has its own world
    frame. Raises FileNotFoundError.
    """
    mine, theirs = read_mesh(result / "head.ply"), read_mesh(other)
    points = moved_onto(mine, theirs) if align else mine.vertices
    return surface_distance(points, theirs)


def moved_onto(mine: Mesh, theirs: Mesh) -> Float[np.ndarray, "v 3"]:
    """Returns the vertices of ``mine`` after the rigid motion that brings them closest to ``theirs``. Heads with
    equally many vertices are compared vertex by vertex. Others are compared by nearest points, without the farthest
    fifth."""
    if len(mine.vertices) == len(theirs.vertices):
        return rigid_procrustes(mine.vertices, theirs.vertices).apply(mine.vertices)
    points = mine.vertices - mine.vertices.mean(0) + theirs.vertices.mean(0)
    tree = KDTree(theirs.vertices)
    for _ in range(ROUNDS):
        distance, nearest = (np.asarray(part) for part in tree.query(points))
        near = distance <= np.quantile(distance, TRIMMED)
        points = rigid_procrustes(points[near], theirs.vertices[nearest[near]]).apply(points)
    return points
