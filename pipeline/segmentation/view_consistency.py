"""Checks whether the silhouettes of all cameras agree (by the idea of the visual hull, figure 1).

On a coarse grid of voxels every camera votes: a voxel that falls clearly outside its silhouette is empty. A view can be
wrong in two ways. *Strange* area is mask where every voxel on the ray is empty for at least two of the others: a chair
that was moved, a person walking by. *Missing* area is where all other cameras keep voxels that this one alone rejects:
hair or a coat in the colour of the backdrop. One bad view must not make the others look bad, so that a voxel counts as
empty only with two votes. Voxels outside an image have no vote there, and may be what a view shows.

A hull contains more than the subject, the more so the fewer and the farther apart the cameras are: the hull of three
others shows up to 11 % more than a true fourth mask. Missing area is therefore believed only if the view also
*contradicts* the others: there is mask of theirs behind which it alone leaves no voxel. True masks contradict no other,
however few they are.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.visual_hull import depth_of, hull_extent
from rig.camera import Camera
from rig.messages.message import compose
from rig.rig import Rig

MAX_STRANGE_SHARE = 0.003  # of the mask: area that the other cameras call empty; 0 in 22 good views
MAX_STRANGE_SHARE_USABLE = 0.01  # of the mask
MAX_MISSING_SHARE = 0.005  # of the mask: area deep inside all the others; 0 in 22 good views
MAX_MISSING_SHARE_USABLE = 0.02  # of the mask
GRID = 32  # voxels a side: 12 mm on a subject of 400 mm
REDUCTION = 16  # of the image in which areas are counted
MIN_CAMERAS = 4  # with fewer, one camera's word stands against another's
MIN_CONTRADICTED = 1e-3  # of the others' masks, mean: 0 in 150 true views of 4 to 24 cameras; 0.0013 and more where a
# crown is missing, and up to 0.0016 then in a good view beside it ...
MAX_CONTRADICTED = 0.5  # ... which contradicts less than this share of what the worst view does


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Holds, for each camera and voxel, whether the camera sees the voxel and whether it lies outside its
    silhouette."""

    pixels: Float[np.ndarray, "k n 2"]
    radius_px: Float[np.ndarray, " k"]  # of a voxel in each camera
    seen: Bool[np.ndarray, "k n"]
    empty: Bool[np.ndarray, "k n"]
    depth: Float[np.ndarray, "k n"]  # distance outside the silhouette, px


def voxel_grid(centre: Float[np.ndarray, " 3"], edge: float, count: int) -> Float[np.ndarray, "n 3"]:
    """Returns the centres (world frame, mm) of a cube's voxels, ``count`` along each side."""
    line = (np.arange(count) + 0.5) / count - 0.5
    return centre + edge * np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)


def cast_votes(silhouettes: Mapping[str, Silhouette], rig: Rig, count: int = GRID) -> Votes:
    """Projects the voxels of a coarse grid around the subject into every camera. Returns which of them each camera
    sees, and which lie outside its silhouette."""
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

    votes = map_in_threads(lambda k: vote(rig.cameras[k]), len(rig))
    return Votes(*(np.array(values) for values in zip(*votes, strict=True)))


@traced
def judge_agreement(
    silhouettes: Mapping[str, Silhouette], rig: Rig, *, ready: Collection[str] = ()
) -> dict[str, Silhouette]:
    """Compares each silhouette with those of the other cameras. Returns the same silhouettes with the disagreement
    added to their quality.

    Args:
        silhouettes: by camera; those that are not usable are ignored.
        rig: the cameras as calibrated.
        ready: cameras whose mask was given by the operator; they get warnings, but stay usable.
    """
    trusted = [name for name in rig.names if silhouettes[name].quality.usable]
    if len(trusted) < MIN_CAMERAS:
        return dict(silhouettes)
    believed = rig.subset(trusted)
    votes = cast_votes(silhouettes, believed)
    judged = dict(silhouettes)
    masks = [silhouettes[name].mask for name in trusted]
    shares = map_in_threads(lambda k: _shares(votes, k, masks[k]), len(trusted))
    suspects = [k for k, (_, missing) in enumerate(shares) if missing > MAX_MISSING_SHARE]
    found = map_in_threads(lambda i: _contradicted(votes, suspects[i], masks), len(suspects))
    contradicted = dict(zip(suspects, found, strict=True))
    limit = max(MIN_CONTRADICTED, MAX_CONTRADICTED * max(contradicted.values(), default=0.0))
    culprits = [k for k, share in contradicted.items() if share >= limit]
    for k, (name, (strange, missing)) in enumerate(zip(trusted, shares, strict=True)):
        if strange > MAX_STRANGE_SHARE and culprits:
            # What a view that lacks something calls empty speaks against nobody.
            heard = replace(votes, empty=votes.empty & ~np.isin(np.arange(len(trusted)), culprits)[:, None])
            strange, _ = _shares(heard, k, masks[k])
        missing = missing if k in culprits else 0.0
        judged[name] = _judged(silhouettes[name], strange, missing, ready=name in ready)
    return judged


def _shares(votes: Votes, k: int, mask: Bool[np.ndarray, "h w"]) -> tuple[float, float]:
    """Returns two areas of camera k as shares of its mask: the part that other cameras exclude (strange), and what they
    all contain but the mask lacks (missing)."""
    small = _reduced(mask)
    size, area = small.shape[::-1], max(float(small.sum()), 1.0)
    others = np.delete(np.arange(len(votes.seen)), k)
    witnesses, against = votes.seen[others].sum(axis=0), votes.empty[others].sum(axis=0)
    known = votes.seen[k] & (witnesses >= 2)
    explained = _splat(votes, k, votes.seen[k] & (against <= _allowed(len(others))), size)
    strange = float(small[_splat(votes, k, known, size) & ~explained].sum()) / area
    # Well inside for all others: a hull's natural excess is slivers along their contours.
    solid = (~votes.seen[others] | (votes.depth[others] < -votes.radius_px[others, None])).all(axis=0)
    wanted = known & (witnesses >= 0.5 * len(others)) & solid & (votes.depth[k] > 2 * votes.radius_px[k])
    missing = float((_splat(votes, k, wanted, size, grow=False) & (small < 0.5)).sum()) / area
    return strange, missing


def _contradicted(votes: Votes, k: int, masks: Sequence[Bool[np.ndarray, "_ _"]]) -> float:
    """Returns, as a mean over the other cameras, the share of their mask that camera k alone leaves without any
    voxel."""
    shares = []
    for j in range(len(votes.seen)):
        others = np.delete(np.arange(len(votes.seen)), [j, k])
        if j == k or not len(others):
            continue
        small = _reduced(masks[j])
        size = small.shape[::-1]
        possible = votes.seen[j] & (votes.empty[others].sum(axis=0) <= _allowed(len(others)))
        witnessed = possible & votes.seen[k] & votes.seen[others].any(axis=0)
        explained = _splat(votes, j, possible & ~votes.empty[k], size)
        lost = _splat(votes, j, witnessed, size, grow=False) & ~explained
        shares.append(float(small[lost].sum()) / max(float(small.sum()), 1.0))
    return float(np.mean(shares)) if shares else 0.0


def _allowed(others: int) -> int:
    """Returns how many of the other cameras may wrongly exclude a voxel: one if there are five or more, else none."""
    return 1 if others >= 5 else 0


def _reduced(mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "r c"]:
    size = (-(-mask.shape[1] // REDUCTION), -(-mask.shape[0] // REDUCTION))
    return cv2.resize(mask.view(np.uint8) * np.float32(1), size, interpolation=cv2.INTER_AREA)


def _splat(
    votes: Votes, k: int, chosen: Bool[np.ndarray, " n"], size: tuple[int, int], *, grow: bool = True
) -> Bool[np.ndarray, "h w"]:
    """Returns the pixels of camera k's reduced image that the chosen voxels cover."""
    drawn = np.zeros((size[1], size[0]), np.uint8)
    at = (votes.pixels[k][chosen] / REDUCTION).astype(int)
    drawn[np.clip(at[:, 1], 0, size[1] - 1), np.clip(at[:, 0], 0, size[0] - 1)] = 1
    reach = int(np.ceil(votes.radius_px[k] / REDUCTION)) if grow else 0
    return cv2.dilate(drawn, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)).view(bool)


def _judged(silhouette: Silhouette, strange: float, missing: float, *, ready: bool) -> Silhouette:
    quality = silhouette.quality
    warnings, usable = list(quality.warnings), quality.usable
    if strange > MAX_STRANGE_SHARE:
        bad = strange > MAX_STRANGE_SHARE_USABLE and not ready
        usable &= not bad
        text = compose("mask-alone-ready" if ready else "mask-alone", share=strange)
        warnings.append(compose("view-unused", remark=text) if bad else text)
    if missing > MAX_MISSING_SHARE:
        bad = missing > MAX_MISSING_SHARE_USABLE and not ready
        usable &= not bad
        text = compose("mask-incomplete-ready" if ready else "mask-incomplete", share=missing)
        warnings.append(compose("view-unused", remark=text) if bad else text)
    figures = {**quality.figures, "strange_share": round(strange, 4), "missing_share": round(missing, 4)}
    return replace(silhouette, quality=replace(quality, usable=usable, warnings=tuple(warnings), figures=figures))
