"""Combines the label probabilities of all views on the surface, which is divided into small cubic cells: the views of a
cell are averaged.

A single pixel may show a freckle or a gap between strands, and a label from an oblique view is less reliable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.projection import project_points
from pipeline.part_labels.codes import Part, codes_from_channels
from pipeline.part_labels.labelling import PartMap
from pipeline.stereo.depth_map import DepthMap, points_world
from rig.camera import Camera
from rig.rig import Rig

PART_NAMES = tuple(part.name.lower() for part in Part)  # by code, in the report
CELL_MM = 4.0  # edge of a cell


@dataclass(frozen=True, slots=True, eq=False)
class PartVotes:
    """Holds small cubic cells of the visible surface, each with its mean point (world frame, mm) and the mean
    probabilities of skin, hair and clothes."""

    corner: Float[np.ndarray, " 3"]
    size: Int[np.ndarray, " 3"]  # cells along each axis
    keys: Int[np.ndarray, " g"]  # ascending
    places: Float[np.ndarray, "g 3"]
    probability: Float[np.ndarray, "g 3"]


@traced
def vote_parts(depth_maps: Sequence[DepthMap], parts: Mapping[str, PartMap], rig: Rig) -> PartVotes | None:
    """Averages the label probabilities of all views' pixels in cubic cells of ``CELL_MM``, where depth and labels are
    known.

    Args:
        depth_maps: the depth map of each view.
        parts: the part map of each view by camera, in pixels of the photograph.
        rig: the cameras as calibrated.

    Returns:
        The mean point and mean probabilities of each cell in which a pixel lies, or None if no view has both a depth
        map and a part map.
    """
    voting = [each for each in depth_maps if each.camera.name in parts and each.known.any()]
    if not voting:
        return None

    def cloud(k: int) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        points = points_world(voting[k])
        return points, parts_shown(points, parts[voting[k].camera.name], rig[voting[k].camera.name])

    points, shown = (np.concatenate(part) for part in zip(*map_in_threads(cloud, len(voting)), strict=True))
    corner = points.min(axis=0)
    cell = np.floor((points - corner) / CELL_MM).astype(np.int64)
    size = cell.max(axis=0) + 1
    group = _keys(cell, size)
    count = np.bincount(group)  # a body has a few million such cells: counted sooner than sorted
    keys = np.flatnonzero(count)
    group = (np.cumsum(count > 0) - 1)[group]  # of the cells in which anything lies
    count = count[keys, None]

    def mean(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "g 3"]:
        return np.stack([np.bincount(group, values[:, k]) for k in range(3)], axis=1) / count

    return PartVotes(corner, size, keys, mean(points), mean(shown))


def parts_shown(points: Float[np.ndarray, "n 3"], part: PartMap, camera: Camera) -> Float[np.ndarray, "n 3"]:
    """Returns the probabilities of skin, hair and clothes at the pixel of each point (world frame, mm); 0 outside the
    picture."""
    height, width = part.of_255.shape[:2]
    column, row = np.rint(np.nan_to_num(project_points(camera, points), nan=-1.0)).astype(int).T
    framed = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return part.of_255[np.where(framed, row, 0), np.where(framed, column, 0)] * (framed / 255.0)[:, None]


def _keys(cell: Int[np.ndarray, "n 3"], size: Int[np.ndarray, " 3"]) -> Int[np.ndarray, " n"]:
    return (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]


def part_codes(votes: PartVotes, points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
    """Returns the code of the most probable label (``Part``) at each point, from the cell that contains the point or
    else the nearest cell."""
    return codes_from_channels(part_shares(votes, points).argmax(axis=1))


def part_shares(votes: PartVotes, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns the probabilities of skin, hair and clothes at each point, from the cell that contains the point or else
    the nearest cell."""
    cell = np.floor((points - votes.corner) / CELL_MM).astype(np.int64)
    inside = ((cell >= 0) & (cell < votes.size)).all(axis=1)
    keys = np.where(inside, _keys(cell, votes.size), -1)
    row = np.minimum(np.searchsorted(votes.keys, keys), len(votes.keys) - 1)
    lost = np.flatnonzero(votes.keys[row] != keys)
    if len(lost):
        row[lost] = nearest(PointTree.of(votes.places), points[lost])[1]
    return votes.probability[row]
