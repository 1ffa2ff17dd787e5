"""Guesses the surface where no camera sees it: the fitted head, with hair as thick as where it is seen."""

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.normals import normals_of
from rig.mesh import Mesh, boundary_edges

THICKEST_MM = 60.0  # of hair: farther out a point belongs to something else
RIM_MM = 12.0  # about the open rim of a model the head goes on in a way that it does not know
EVERY = 4  # vertices of the head stand for the others: 3 mm apart is enough for a guess
MIN_POINTS = 3  # of the surface near a vertex, for a thickness
NEAREST, EVEN_MM = 64, 5.0  # vertices that a mean is taken of, and the distance within which they count alike


def distance_to_head(
    places: Float[np.ndarray, "n 3"], head_world: Mesh, seen: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, " n"]:
    """Returns the signed distance (mm, positive outside) of points to the outside of the head's hair; -inf near the
    open border where the model ends. The thickness of the hair above each vertex is measured from the ``seen`` points
    of the surface, and interpolated where there are none."""
    vertices, normals = head_world.vertices[::EVERY], normals_of(head_world)[::EVERY]
    tree = PointTree.of(vertices)
    thickness = _thickness(tree, normals, seen)
    far, near = nearest(tree, places)
    height = ((places - vertices[near]) * normals[near]).sum(axis=1)
    signed = np.copysign(far, height) - thickness[near]
    return np.where(near_rim(head_world, vertices)[near], -np.inf, signed)


def _thickness(
    tree: PointTree, normals: Float[np.ndarray, "v 3"], seen: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, " v"]:
    """Returns the thickness of the hair (mm) over each vertex: the mean height of the seen points above it. Vertices
    with too few points take the mean of the nearest others, weighted by the inverse square of the distance."""
    vertices = tree.points
    far, near = nearest(tree, seen, within=THICKEST_MM)
    near, points = near[np.isfinite(far)], seen[np.isfinite(far)]
    height = np.maximum(((points - vertices[near]) * normals[near]).sum(axis=1), 0.0)
    count = np.bincount(near, minlength=len(vertices))
    thickness = np.bincount(near, height, len(vertices)) / np.maximum(count, 1)
    known = np.flatnonzero(count >= MIN_POINTS)
    if len(known) < NEAREST:
        return np.zeros(len(vertices))
    blank = np.flatnonzero(count < MIN_POINTS)
    far, near = nearest(PointTree.of(vertices[known]), vertices[blank], count=NEAREST)
    share = 1.0 / (far * far + EVEN_MM**2)
    thickness[blank] = (share * thickness[known[near]]).sum(axis=1) / share.sum(axis=1)
    return thickness


def near_rim(head_world: Mesh, places: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Tells which points lie within ``RIM_MM`` of the head's open border, at the neck."""
    rim = np.unique(boundary_edges(head_world.faces))
    if not len(rim):
        return np.zeros(len(places), bool)
    return nearest(PointTree.of(head_world.vertices[rim]), places, within=RIM_MM)[0] < RIM_MM
