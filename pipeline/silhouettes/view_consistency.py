"""Do the cameras agree? Each silhouette is asked whether the others allow it (the idea of the visual hull, figure 1).

On a coarse grid of voxels every camera votes: a voxel that falls clearly outside its silhouette is empty. Two things
can be wrong with a view. *Strange* area is mask where every voxel behind it is empty for at least two of the others: a
chair that was moved, a person walking by. *Missing* area is where all other cameras keep voxels that this one alone
rejects, beyond what a hull always keeps too much: hair or a coat in the colour of the backdrop. One bad view must not
make the others look bad, hence the second vote before a voxel counts as empty. Voxels outside an image have no vote
there.
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.visual_hull import depth_of, hull_extent
from pipeline.parallel_for import thread_count
from pipeline.settings import SegmentationSettings
from rig.camera import Camera
from rig.rig import Rig

GRID = 32  # voxels a side: 12 mm on a subject of 400 mm
REDUCTION = 16  # of the image in which areas are counted
LEAST_CAMERAS = 4  # with fewer, one camera's word stands against another's


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """What each camera says of each voxel."""

    pixels: Float[np.ndarray, "k n 2"]
    radius_px: Float[np.ndarray, " k"]  # of a voxel in each camera
    seen: Bool[np.ndarray, "k n"]
    empty: Bool[np.ndarray, "k n"]
    depth: Float[np.ndarray, "k n"]  # distance outside the silhouette, px


def voxel_grid(centre: Float[np.ndarray, " 3"], edge: float, count: int) -> Float[np.ndarray, "n 3"]:
    """Centres of ``count`` voxels a side, world frame."""
    line = (np.arange(count) + 0.5) / count - 0.5
    return centre + edge * np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)


def cast_votes(silhouettes: Mapping[str, Silhouette], rig: Rig, count: int = GRID) -> Votes:
    """Every camera's vote on every voxel of a coarse grid around the subject."""
    centre, edge = hull_extent(silhouettes, rig)
    voxels = voxel_grid(centre, edge, count)

    def vote(camera: Camera) -> tuple:
        where = camera.project(voxels)
        k = camera.intrinsics
        radius = 0.87 * edge / count * k.fx / depth_of(camera, centre)  # half the diagonal of a voxel
        inside = np.logical_and(where >= 0, where <= (k.width - 1, k.height - 1)).all(axis=1)  # NaN is not
        at = np.rint(np.where(inside.reshape(-1, 1), where, 0.0)).astype(int)
        depth = np.where(inside, silhouettes[camera.name].distance[at[:, 1], at[:, 0]], -np.inf)
        return where, radius, inside, depth > radius, depth

    with ThreadPoolExecutor(thread_count()) as pool:  # NumPy releases the interpreter lock
        return Votes(*(np.array(values) for values in zip(*pool.map(vote, rig), strict=True)))


def judge_agreement(
    silhouettes: Mapping[str, Silhouette], rig: Rig, settings: SegmentationSettings
) -> dict[str, Silhouette]:
    """The same silhouettes with what the other cameras say of each in its quality."""
    trusted = [name for name in rig.names if silhouettes[name].quality.usable]
    if len(trusted) < LEAST_CAMERAS:
        return dict(silhouettes)
    believed = rig.subset(trusted)
    votes = cast_votes(silhouettes, believed)
    judged = dict(silhouettes)
    with ThreadPoolExecutor(thread_count()) as pool:
        shares = pool.map(lambda k: _shares(votes, k, silhouettes[trusted[k]].mask), range(len(trusted)))
        for name, (strange, missing) in zip(trusted, shares, strict=True):
            judged[name] = _judged(silhouettes[name], strange, missing, settings)
    return judged


def _shares(votes: Votes, k: int, mask: Bool[np.ndarray, "h w"]) -> tuple[float, float]:
    """Strange and missing area of camera k, by the area of its mask."""
    size = (-(-mask.shape[1] // REDUCTION), -(-mask.shape[0] // REDUCTION))
    small = cv2.resize(mask.view(np.uint8) * np.float32(1), size, interpolation=cv2.INTER_AREA)
    area = max(float(small.sum()), 1.0)
    others = np.delete(np.arange(len(votes.seen)), k)
    witnesses, against = votes.seen[others].sum(axis=0), votes.empty[others].sum(axis=0)
    allowed = 1 if len(others) >= 5 else 0
    known = votes.seen[k] & (witnesses >= 2)
    explained = _splat(votes, k, known & (against <= allowed), size)
    strange = float(small[_splat(votes, k, known, size) & ~explained].sum()) / area
    # Well inside for all others: a hull's natural excess is slivers along their contours.
    solid = (~votes.seen[others] | (votes.depth[others] < -votes.radius_px[others, None])).all(axis=0)
    wanted = known & (witnesses >= 0.5 * len(others)) & solid & (votes.depth[k] > 2 * votes.radius_px[k])
    missing = float((_splat(votes, k, wanted, size, grow=False) & (small < 0.5)).sum()) / area
    return strange, missing


def _splat(
    votes: Votes, k: int, chosen: Bool[np.ndarray, " n"], size: tuple[int, int], *, grow: bool = True
) -> Bool[np.ndarray, "h w"]:
    """The reduced image's pixels that a chosen voxel covers."""
    drawn = np.zeros((size[1], size[0]), np.uint8)
    at = (votes.pixels[k][chosen] / REDUCTION).astype(int)
    drawn[np.clip(at[:, 1], 0, size[1] - 1), np.clip(at[:, 0], 0, size[0] - 1)] = 1
    reach = int(np.ceil(votes.radius_px[k] / REDUCTION)) if grow else 0
    return cv2.dilate(drawn, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)).view(bool)


def _judged(silhouette: Silhouette, strange: float, missing: float, settings: SegmentationSettings) -> Silhouette:
    quality = silhouette.quality
    warnings, usable = list(quality.warnings), quality.usable
    left_out = "; the view is left out"
    if strange > settings.strange_share_warned:
        bad = strange > settings.strange_share_unusable
        usable &= not bad
        text = f"{strange:.1%} of the mask is where the other cameras see nothing: did something move since the plate?"
        warnings.append(text + (left_out if bad else ""))
    if missing > settings.missing_share_warned:
        bad = missing > settings.missing_share_unusable
        usable &= not bad
        text = f"the mask lacks {missing:.1%} of what the other cameras show: hair or clothes in the backdrop's colour?"
        warnings.append(text + (left_out if bad else ""))
    figures = {**quality.figures, "strange_share": round(strange, 4), "missing_share": round(missing, 4)}
    return replace(silhouette, quality=replace(quality, usable=usable, warnings=tuple(warnings), figures=figures))
