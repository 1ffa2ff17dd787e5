"""Determines which part of the visible surface is measured, and the standard deviation of each vertex."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.fusion.net_kernels import component_of
from pipeline.fusion.refinement import Measured
from pipeline.geometry.nearest import PointTree, nearest
from rig.mesh import Mesh, face_normals

MIN_MM = 0.05  # what no view shows: the calibration's own error, and the surface between vertices
ALONE_MM = 0.3  # of what a single view says, beside its own deviation: nobody contradicts it
EDGE_MM, SLOPE, MAX_MM = 1.5, 0.25, 15.0  # a guess at the edge of what is seen, its growth with the distance, its end
EVERY = 4  # seen vertices stand for the others
# Smaller patches that views agree on, with nothing seen about them, are often chance: without this the farthest places
# of the laboratory's `planted` are six times as far off.
ISLAND_MM2 = 100.0


def without_islands(mesh: Mesh, measured: Measured) -> Measured:
    """Returns the measurements with small patches discarded: the vertices of a connected patch of seen triangles
    smaller than ``ISLAND_MM2`` count as seen by no view."""
    seen = measured.views > 0
    faces = mesh.faces[seen[mesh.faces].all(axis=1)]
    piece = component_of(faces, len(seen))
    area = 0.5 * np.linalg.norm(face_normals(mesh.vertices, faces), axis=1)
    held = np.bincount(piece[faces[:, 0]], area, minlength=len(seen))[piece]
    return replace(measured, views=np.where(held < ISLAND_MM2, 0, measured.views).astype(np.uint8))


def deviation_mm(mesh: Mesh, measured: Measured) -> Float[np.ndarray, " v"]:
    """Returns the standard deviation (mm) of each vertex along its normal. Seen vertices have that of
    ``seen_deviation_mm``; the others a guess that grows with the distance to the nearest seen vertex."""
    seen = measured.views > 0
    return np.where(seen, seen_deviation_mm(measured), guessed_deviation_mm(mesh.vertices, seen))


def guessed_deviation_mm(vertices: Float[np.ndarray, "v 3"], seen: Bool[np.ndarray, " v"]) -> Float[np.ndarray, " v"]:
    """Returns the standard deviation (mm) of the guess at every vertex that no view sees, from its distance to those
    that one sees; 0 for these."""
    out = np.where(seen, 0.0, MAX_MM)
    if seen.any():
        far, _ = nearest(PointTree.of(vertices[seen][::EVERY]), vertices[~seen])
        out[~seen] = np.minimum(EDGE_MM + SLOPE * far, MAX_MM)
    return out


def seen_deviation_mm(measured: Measured) -> Float[np.ndarray, " v"]:
    """Returns the standard deviation (mm) along the normal of every vertex that a view sees, from the views'
    information or, if larger, their scatter; 0 for all other vertices."""
    seen = measured.views > 0
    views = measured.views[seen].astype(float)
    variance = np.maximum(1.0 / measured.information[seen], measured.scatter[seen] / np.maximum(views - 1.0, 1.0))
    variance += np.where(views < 2, ALONE_MM**2, 0.0) + MIN_MM**2
    out = np.zeros(len(seen))
    out[seen] = np.minimum(np.sqrt(variance), MAX_MM)
    return out
