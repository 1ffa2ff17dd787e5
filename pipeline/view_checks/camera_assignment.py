"""Checks, before the fit, whether every picture is filed under the camera that took it.

Swapped cables or renamed files exchange the pictures of two cameras, or of more cameras in a cycle. A plane through two
camera centres that touches the subject is tangent to both silhouettes (Wong and Cipolla, *Structure and motion from
silhouettes*, ICCV 2001). The error of this tangency is tenths of a pixel for correct pictures, and tens of pixels for
exchanged pictures.

The module returns the picture that each camera should have, and whether this is certain. A camera that was moved, or
whose mask is bad, contradicts the others with every picture, and keeps its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.tangency import (
    BORDER_PX,
    LONGEST_SPAN,
    MIN_SLOPE,
    angle_slopes,
    epipolar_plane_axes,
    outer_hull,
    rays_about,
)
from rig.camera import Camera
from rig.messages.message import Message, compose
from rig.rig import Rig

MIN_NOISE_PX, MAX_NOISE_PX = 0.5, 1.5  # of one tangency: what masks leave, and what exchanges may not hide in
ROBUST_SIGMAS = 3.0
INSET_PX = 2.0  # hair that one camera resolves and the other does not: misses of 2.4 px become 0.9 (three quarters:
# half)
CUT_OFF_MISFIT = 0.3  # of a tangent that the border hides: neither for nor against, between right (0.03) and wrong
# (0.7)
SUSPECT_MISFIT = 0.2  # mean over a camera's tangents above which the search is worth its 0.05 s
FITTING_MISFIT = 0.28  # mean over all tangents of a camera that holds its own picture: at most 0.25 in 72 exchanges
# among 3 to 11 cameras; two knocked cameras whose pictures are tried on each other keep 0.34 and more
NAMED_GAIN = 1.5  # tangents that an exchange explains before it is named: of three cameras that share three at most
REPAIRED_GAIN = 4.0  # and before it is believed without asking: five planes, met by chance once in 10,000
MIN_CAMERAS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """Holds the exchange of pictures among cameras. For every camera that has another camera's picture, ``pictures``
    has the name under which its own picture is filed. ``overwhelming``: the exchange is certain, since the outlines'
    tangents that cameras share fit much better with it.
    """

    pictures: Mapping[str, str]
    overwhelming: bool = False


NOTHING = Assignment({})


def find_assignment(silhouettes: Mapping[str, Silhouette], rig: Rig) -> Assignment:
    """Finds the exchange of pictures among cameras of the same image size that makes the tangent planes of the
    silhouettes agree.

    Args:
        silhouettes: by camera; views without a mask are ignored.
        rig: the cameras as calibrated.

    Returns:
        An empty assignment if every camera holds its own picture, or if no exchange explains the disagreement.
    """
    seen, hulls = outlined(silhouettes, rig)
    if len(seen) < MIN_CAMERAS:
        return NOTHING
    if not (mean_misfit(tangency_errors_px(hulls, seen)) > SUSPECT_MISFIT).any():  # more than good masks do
        return NOTHING
    misfit = _misfit_tensor(hulls, seen)
    return _judged(_least_misfit(misfit, seen), misfit, seen)


def own_misfit(silhouettes: Mapping[str, Silhouette], rig: Rig) -> dict[str, float]:
    """Returns, for each camera, the mean robust misfit of its tangent planes with the other cameras. The misfit is
    about 0.2 for the right picture, 0.5 and more for another camera's picture."""
    seen, hulls = outlined(silhouettes, rig)
    if len(seen) < MIN_CAMERAS:
        return dict.fromkeys(seen.names, CUT_OFF_MISFIT)
    return dict(zip(seen.names, mean_misfit(tangency_errors_px(hulls, seen), CUT_OFF_MISFIT).tolist(), strict=True))


def rings(pictures: Mapping[str, str]) -> list[tuple[str, ...]]:
    """Returns the cycles of an exchange. In (a, b, c) camera a's picture is filed under b, b's under c, c's under a."""
    left, found = dict(pictures), []
    while left:
        first = min(left)
        ring, at = [first], left.pop(first)
        while at != first:
            ring.append(at)
            at = left.pop(at)
        found.append(tuple(ring))
    return found


def ring_messages(pictures: Mapping[str, str], what: Message) -> list[Message]:
    """Returns one message for each cycle of an exchange; ``what`` names the things that were exchanged."""
    return [_ring_message(ring, what) for ring in rings(pictures)]


def _ring_message(ring: tuple[str, ...], what: Message) -> Message:
    names, last = ring[:-1], ring[-1]
    if len(ring) == 2:
        return compose("exchanged-pair", names=names, last=last, what=what)
    filed = [
        compose("filed-under", owner=name, what=what, name=ring[(k + 1) % len(ring)]).text
        for k, name in enumerate(ring)
    ]
    return compose("exchanged-ring", names=names, last=last, what=what, filed=filed)


def outlined(silhouettes: Mapping[str, Silhouette], rig: Rig) -> tuple[Rig, list[Float[np.ndarray, "_ 2"]]]:
    """Returns the cameras whose mask is thicker than a few pixels, and the convex hulls (px) of their outlines."""
    seen = rig.subset(
        name for name in rig.names if name in silhouettes and silhouettes[name].distance.min() < -INSET_PX
    )
    return seen, [outer_hull(silhouettes[name], INSET_PX) for name in seen.names]


def tangency_errors_px(hulls: Sequence[Float[np.ndarray, "_ 2"]], rig: Rig) -> Float[np.ndarray, "n n 2"]:
    """Returns the error (px, in both images together) of each tangent plane, two planes for each pair of cameras, with
    all pictures as filed. ``hulls`` are the outlines' convex hulls, px."""
    cameras = list(rig)
    touches = [_touches(camera, hulls[i : i + 1], i, cameras) for i, camera in enumerate(cameras)]
    angle, step = (np.stack([touch[k][0] for touch in touches]) for k in range(2))
    return _miss_px(angle - angle.swapaxes(0, 1), np.hypot(step, step.swapaxes(0, 1)))


def _miss_px(gap: Float[np.ndarray, "*n"], step: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Converts differences in angle to pixels: divides by the change of angle per pixel. Returns NaN if this change is
    undefined, as for two cameras at the same place."""
    return np.divide(gap, step, out=np.full(gap.shape, np.nan), where=step > MIN_SLOPE)


def mean_misfit(errors_px: Float[np.ndarray, "n n 2"], cut_off: float | None = None) -> Float[np.ndarray, " n"]:
    """Returns the mean robust misfit of each camera's tangent planes. Planes beyond the image border count as
    ``cut_off``; None leaves them out."""
    there = np.isfinite(errors_px)
    of_each = np.where(there, _robust(errors_px, ROBUST_SIGMAS * _noise_px(errors_px[there])), cut_off or 0.0)
    count = there.sum(axis=(1, 2)) if cut_off is None else 2 * (len(errors_px) - 1)
    return (of_each.sum(axis=(1, 2)) - (0 if cut_off is None else 2 * cut_off)) / np.maximum(count, 1)


def _judged(held: Int[np.ndarray, " n"], misfit: Float32[np.ndarray, "n n n n"], rig: Rig) -> Assignment:
    """Converts the permutation ``held`` to an assignment. Returns an empty assignment if the permutation hardly reduces
    the misfit, or if an exchanged picture still contradicts the others."""
    identity = np.arange(len(rig))
    displaced = np.flatnonzero(held != identity)
    if not len(displaced):
        return NOTHING
    before, after = (_rows(misfit, pictures)[identity, pictures] for pictures in (identity, held))
    mean_after = after / (2 * (len(rig) - 1))
    gain = float(_cost(misfit, identity) - _cost(misfit, held))
    if gain < NAMED_GAIN or (mean_after[displaced] > FITTING_MISFIT).any() or (after > before)[displaced].any():
        return NOTHING
    pictures = {rig.names[i]: rig.names[held[i]] for i in displaced.tolist()}
    return Assignment(pictures, gain >= REPAIRED_GAIN)


def _noise_px(errors_px: Float[np.ndarray, " n"]) -> float:
    """Estimates the standard deviation (px) of a tangent plane's error from the best quarter of all planes, since half
    of them may belong to exchanged pictures."""
    quarter = float(np.quantile(np.abs(errors_px), 0.25)) if len(errors_px) else 0.0
    return float(np.clip(quarter / 0.3186, MIN_NOISE_PX, MAX_NOISE_PX))


def _robust(miss_px: np.ndarray, scale_px: float) -> np.ndarray:
    """Returns the robust misfit of each tangent plane, 0 to 1 (Geman and McClure)."""
    return miss_px**2 / (miss_px**2 + scale_px**2)


def _misfit_tensor(hulls: Sequence[Float[np.ndarray, "_ 2"]], rig: Rig) -> Float32[np.ndarray, "n n n n"]:
    """Returns, for all i, a, j, b, the robust misfit of the two tangent planes of cameras i and j if camera i took
    picture a and camera j took picture b.

    A picture with another size than the camera's counts as cut off.
    """
    cameras, count = list(rig), len(rig)
    angle, step = np.full((2, count, count, count, 2), np.nan)  # camera i, picture a, the other camera j; top, bottom
    for i, camera in enumerate(cameras):
        held = [a for a in range(count) if _size(cameras[a]) == _size(camera)]
        angle[i, held], step[i, held] = _touches(camera, [hulls[a] for a in held], i, cameras)
    errors_px = tangency_errors_px(hulls, rig)
    scale = ROBUST_SIGMAS * _noise_px(errors_px[np.isfinite(errors_px)])
    misfit = np.zeros((count,) * 4, np.float32)
    for i, j in permutations(range(count), 2):
        gap = angle[i, :, j, None, :] - angle[j, None, :, i, :]
        miss = _miss_px(gap, np.hypot(step[i, :, j, None, :], step[j, None, :, i, :]))
        misfit[i, :, j] = np.where(np.isfinite(miss), _robust(miss, scale), CUT_OFF_MISFIT).sum(axis=-1)
    return misfit


def _touches(
    camera: Camera, hulls: Sequence[Float[np.ndarray, "_ 2"]], index: int, cameras: Sequence[Camera]
) -> tuple[Float[np.ndarray, "h n 2"], Float[np.ndarray, "h n 2"]]:
    """Computes, for each silhouette in this camera, the angles (rad) of the two planes through this and each other
    camera's centre that are tangent to the silhouette. The function also returns the change of angle per pixel. The
    values are NaN for a tangent beyond the image border."""
    pixels, ends = np.concatenate(hulls), np.cumsum([0, *map(len, hulls)])
    rays = camera.rays_world(pixels)
    k = camera.intrinsics
    border = np.minimum(pixels, (k.width - 1, k.height - 1) - pixels).min(axis=1) < BORDER_PX
    angles = np.full((len(hulls), len(cameras), 2), np.nan)
    touched = np.zeros((len(hulls), len(cameras), 2), int)
    frames = {j: _pencil(cameras, index, j) for j in range(len(cameras)) if j != index}
    for j, (u, v) in frames.items():
        angle = np.arctan2(rays @ v, rays @ u)
        for h, (low, high) in enumerate(pairwise(ends)):
            part = angle[low:high]
            top, bottom = low + int(np.argmax(part)), low + int(np.argmin(part))
            touched[h, j] = top, bottom
            if not angle[top] - angle[bottom] > LONGEST_SPAN:  # else there is no outer tangent
                angles[h, j] = [np.nan if border[at] else angle[at] for at in (top, bottom)]
    around = rays_about(camera, pixels[touched])
    steps = np.full(angles.shape, np.nan)
    for j, (u, v) in frames.items():
        steps[:, j] = np.linalg.norm(angle_slopes(around[:, j], u, v), axis=-1)
    return angles + steps * (INSET_PX, -INSET_PX), steps


def _pencil(cameras: Sequence[Camera], i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ``epipolar_plane_axes`` of two cameras, which are the same for (i, j) and (j, i)."""
    one, two = cameras[min(i, j)], cameras[max(i, j)]
    return epipolar_plane_axes(one, two, one.axis_world + two.axis_world)


def _size(camera: Camera) -> tuple[int, int]:
    return camera.intrinsics.width, camera.intrinsics.height


def _least_misfit(misfit: Float32[np.ndarray, "n n n n"], rig: Rig) -> Int[np.ndarray, " n"]:
    """Finds the permutation of least misfit by exchanging two pictures at a time, starting with the pictures as filed.
    If all file names are shifted by the same number, no single exchange helps, so the search also starts with shifted
    names."""
    count = len(rig)
    sizes = [_size(camera) for camera in rig]
    allowed = np.array([[one == two for two in sizes] for one in sizes])
    identity = np.arange(count)
    starts = [identity]
    if allowed.all():
        starts += [np.roll(identity, shift) for shift in range(1, count)]
    least = _cost(misfit, identity)
    starts = [start for start in starts if _cost(misfit, start) <= least]
    return min((_descended(misfit, start, allowed) for start in starts), key=lambda found: _cost(misfit, found))


def _descended(
    misfit: Float32[np.ndarray, "n n n n"], start: Int[np.ndarray, " n"], allowed: np.ndarray
) -> Int[np.ndarray, " n"]:
    held, every = start.copy(), np.arange(len(start))
    while True:
        rows = _rows(misfit, held)
        current = rows[every, held]
        p, q = np.ix_(every, every)
        a, b = held[p], held[q]
        before = current[:, None] + current[None, :] - misfit[p, a, q, b]
        crossed = rows[p, b] - misfit[p, b, q, b] + rows[q, a] - misfit[q, a, p, a] + misfit[p, b, q, a]
        gain = np.where(allowed, before - crossed, -np.inf)
        np.fill_diagonal(gain, -np.inf)
        one, two = np.unravel_index(int(np.argmax(gain)), gain.shape)
        if not gain[one, two] > 1e-3:
            return held
        held[[one, two]] = held[[two, one]]


def _rows(misfit: Float32[np.ndarray, "n n n n"], held: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Returns the misfit of camera i with each picture a, while all other cameras have the pictures ``held``."""
    every = np.arange(len(held))
    return misfit[:, :, every, held].sum(axis=2, dtype=float)


def _cost(misfit: Float32[np.ndarray, "n n n n"], held: Int[np.ndarray, " n"]) -> float:
    every = np.arange(len(held))
    return float(_rows(misfit, held)[every, held].sum()) / 2.0
