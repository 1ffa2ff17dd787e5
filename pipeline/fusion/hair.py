"""Decides what counts as hair, and makes the surface of hair and clothes as smooth as pictures resolve it.

Two cameras see other strands and other threads, so that windows match chance patterns: what depth says of them scatters
over millimetres and leaves gravel with pockets and handles. That is noise, not relief. Its votes are therefore weak in
the signed distance (``firmness``), which leaves no pockets, and its vertices take the mean of those about them.

Strands are thinner than a pixel and let through what lies behind them, so that windows match the dense core of the
hair, millimetres deeper than the strands that a photograph shows. Outlines show how much is missing: where the surface
turns away from a camera, its outline lies as far inside the silhouette. Between these rims the missing thickness is
interpolated. Hair that has a surface, as a helmet has, reaches its outlines and stays as it is.
"""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.quality import EDGE_MM, guessed_deviation_mm
from pipeline.fusion.refinement import neighbours
from pipeline.fusion.refinement_kernels import blurred_over_mesh
from pipeline.fusion.skin import mean_around, skin_share
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.raster import depth_map
from pipeline.imaging.silhouette import Silhouette
from pipeline.part_labels.codes import Part
from pipeline.part_labels.votes import PartVotes
from rig.camera import Camera
from rig.mesh import Mesh, face_normals
from rig.rig import Rig

# Height (mm) over the head up to which hair is skin with hair's colour (stubble, brows, a beard), and from which on it
# is hair: the cells of beard-smile's beard lie 0.6 mm over the head in the median, those of its hair 3.5.
STUBBLE_MM = (1.0, 3.0)
CELLS = 64  # about a cell, whose mean height counts: 12 mm about it
RESOLVED_MM = 4.0  # standard deviation of the mean that a vertex of hair and clothes takes: gravel is 2 to 5 mm wide
STEP_SHARE = 0.46  # variance of one step of a mean, by the area of a vertex
OFF_HEAD_MM = 8.0  # from the head there is no skin: strands that hang before it have skin's colours in shade
# Median thickness that hair lacks at its rims, from which on it counts as strands, and counts whole: 0.14 and 0.15 mm
# of two captures of solid hair, 3.4 and 5.3 of two of strands.
STRANDS_MM = (1.0, 2.0)
SURELY = 0.5  # probability from which on a vertex of a rim counts as hair
EVERY = 4  # pixel of a rim is measured
RIM_PX = 0.5  # by which the pixels of a rim lie inside the outline
FRAME_PX = 3  # from the border of a photograph, where the outline is the photograph's
FARTHEST_MM = 30.0  # beyond that the outline is something else's
# Of the rim's places about one, this quantile counts: single hairs stand out, and outlines follow them. With the
# median, 64 % of a beard's strands lie within 2 mm, with this 73 %, with 0.2 77 %; of all hair 59, 59 and 58 %.
ABOUT, QUANTILE = 24, 0.35
NEAREST, EVEN_MM = 8, 8.0  # of them count at a vertex, and the distance within which they count alike
MIN_PLACES = 2 * ABOUT  # for a measurement
DENSE = 4  # power of hair's probability: where scalp shows between strands, the surface stays between the two
ROUNDS, SHARE = 2, 0.7  # the rim of what has been moved is another one: what is still missing is measured again
STRAND_SHARE = 0.5  # standard deviation of a moved vertex, by its way: strands lie between core and outline


def parts_over_head(votes: PartVotes, head_world: Mesh) -> PartVotes:
    """Returns the votes with the cells' heights over a head considered: hair that lies on its skin counts as skin, and
    skin that lies off it as hair."""
    skin, hair = Part.SKIN.channel, Part.HAIR.channel
    both, out = votes.probability[:, skin] + votes.probability[:, hair], votes.probability.copy()
    far, near = nearest(PointTree.of(head_world.vertices), votes.places)
    height = ((votes.places - head_world.vertices[near]) * head_world.normals()[near]).sum(axis=1)
    alike = nearest(PointTree.of(votes.places), votes.places, count=min(CELLS, len(height)))[1]
    weight = out[alike, hair] + 1e-9
    mean_mm = (weight * height[alike]).sum(axis=1) / weight.sum(axis=1)
    over = np.clip((mean_mm - STUBBLE_MM[0]) / (STUBBLE_MM[1] - STUBBLE_MM[0]), 0.0, 1.0)
    out[:, hair] = np.where(far > OFF_HEAD_MM, both, over * out[:, hair])
    out[:, skin] = both - out[:, hair]
    return replace(votes, probability=out)


@traced
def smooth_hair(
    mesh_world: Mesh, hair: Float[np.ndarray, " v"], seen: Bool[np.ndarray, " v"], held: Bool[np.ndarray, " v"]
) -> Mesh:
    """Returns the mesh with the vertices of hair, and those far from all that is seen, moved to the mean of their
    surroundings.

    Args:
        mesh_world: closed, mm.
        hair: probability that a vertex shows hair.
        seen: by a view; the others are what is seen next to them.
        held: vertices that stay.
    """
    beside = neighbours(mesh_world.faces, len(seen))
    share = skin_share(beside, mesh_world.vertices, 1.0 - hair, seen)
    share *= EDGE_MM / np.maximum(guessed_deviation_mm(mesh_world.vertices, seen), EDGE_MM)
    share = np.where(held, 1.0, share)[:, None]
    area_mm2 = 0.5 * np.linalg.norm(face_normals(mesh_world.vertices, mesh_world.faces), axis=1).sum() / len(seen)
    mean = blurred_over_mesh(mesh_world.vertices, *beside, round(RESOLVED_MM**2 / (STEP_SHARE * area_mm2)))
    return Mesh(share * mesh_world.vertices + (1.0 - share) * mean, mesh_world.faces)


@traced
def grown_to_outlines(
    mesh_world: Mesh, hair: Float[np.ndarray, " v"], silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[Mesh, Float[np.ndarray, " v"]]:
    """Moves the vertices of hair outwards to where the silhouettes show the hair to end.

    Args:
        mesh_world: the fused surface, closed, mm.
        hair: probability that a vertex shows hair.
        silhouettes: by camera; those that are not usable are left out.
        rig: the cameras as calibrated, world frame.

    Returns:
        The moved mesh, and how far (mm) each vertex was moved.
    """
    sure = hair > SURELY
    rig = rig.subset(name for name in rig.names if name in silhouettes and silhouettes[name].quality.usable)
    if not sure.any() or not len(rig):
        return mesh_world, np.zeros(len(hair))
    mesh, beside, trust = mesh_world, neighbours(mesh_world.faces, len(hair)), None
    for _ in range(ROUNDS):
        places, missing_mm = rims(mesh, sure, silhouettes, rig)
        trust = strands_share(missing_mm) if trust is None else trust
        if len(places) < MIN_PLACES or trust == 0.0:
            break
        outwards = np.zeros(len(hair))
        outwards[hair > 0.0] = missing_thickness(mesh.vertices[hair > 0.0], places, missing_mm)
        way = (SHARE * trust * hair**DENSE * outwards)[:, None] * mesh.normals()
        smooth = [mean_around(beside, way[:, axis], np.ones(len(way))) for axis in range(3)]
        mesh = Mesh(mesh.vertices + np.stack(smooth, axis=1), mesh.faces)
    return mesh, np.linalg.norm(mesh.vertices - mesh_world.vertices, axis=1)


def strands_share(missing_mm: Float[np.ndarray, " n"]) -> float:
    """Returns how far hair counts as strands, 0 to 1, from the thickness that it lacks at its rims."""
    if len(missing_mm) < MIN_PLACES:
        return 0.0
    return float(np.clip((np.median(missing_mm) - STRANDS_MM[0]) / (STRANDS_MM[1] - STRANDS_MM[0]), 0.0, 1.0))


def rims(
    mesh_world: Mesh, counts: Bool[np.ndarray, " v"], silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Returns places (world, mm) where the surface turns away from a camera, and how far (mm) its outline there lies
    inside the camera's silhouette; only at vertices that ``counts``."""

    def seen_by(camera: Camera) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        depth, face = depth_map(camera, mesh_world.vertices, mesh_world.faces)
        solid = face >= 0
        inner = cv2.erode(solid.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rim = solid & ~inner
        rim[:FRAME_PX], rim[-FRAME_PX:], rim[:, :FRAME_PX], rim[:, -FRAME_PX:] = False, False, False, False
        at = np.flatnonzero(rim)[::EVERY]
        vertex = mesh_world.faces[face.flat[at], 0]
        apart_px = -silhouettes[camera.name].distance.flat[at] - RIM_PX
        apart_mm = apart_px * depth.flat[at] / camera.intrinsics.fx
        used = counts[vertex] & (np.abs(apart_mm) < FARTHEST_MM)
        return mesh_world.vertices[vertex[used]], apart_mm[used].astype(float)

    found = map_in_threads(lambda k: seen_by(rig.cameras[k]), len(rig))
    return np.concatenate([places for places, _ in found]), np.concatenate([apart for _, apart in found])


def missing_thickness(
    vertices: Float[np.ndarray, "v 3"], places: Float[np.ndarray, "n 3"], missing_mm: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " v"]:
    """Returns the thickness (mm) that is missing at each vertex: the mean of the nearest places', weighted by distance,
    each of which has the ``QUANTILE`` of those about it, and at least 0."""
    tree = PointTree.of(places)
    around = nearest(tree, places, count=ABOUT)[1]
    even_mm = np.maximum(np.quantile(missing_mm[around], QUANTILE, axis=1), 0.0)
    far, near = nearest(tree, vertices, count=NEAREST)
    weight = 1.0 / (far * far + EVEN_MM**2) ** 2
    return (weight * even_mm[near]).sum(axis=1) / weight.sum(axis=1)
