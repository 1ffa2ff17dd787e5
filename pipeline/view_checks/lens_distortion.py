"""Checks whether the pictures have the rig's lens distortion: they may be undistorted while the rig has coefficients,
or the reverse. The module also checks whether the principal points count pixels from 1. Outlines hardly show these
faults, since all heads' crowns are equally far from the middle of their pictures.

The faults appear in the reprojection errors of subject points in three or more views. The first estimated number, with
its standard deviation, is a factor on all distortion coefficients: 1 if they fit the pictures, 0 if the pictures are
undistorted. For a rig without coefficients the first estimated number is a radial coefficient of all cameras. The
second estimated number is a common shift of all principal points, equally to the right and down.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.scene_tracks import SceneTracks, find_tracks, misses_px
from pipeline.warnings import ReportWarning
from rig.camera import Distortion
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.rig import Rig

MIN_VIEWS, MAX_VIEWS, MIN_TRACKS = 3, 12, 60  # 12 views take 3 s of one core; three views of a head share 39 points,
# and 475 in pairs: a k1 of -0.20 that was lost is -0.193 +- 0.052, coefficients that were left are -0.11 +- 0.24 of
# theirs
MIN_EFFECT = 1e-3  # of the picture's width, at the subject's farthest pixels: less does not matter to a head
ROBUST_PX = 1.0  # of a miss (Geman and McClure)
SHARES = np.linspace(-0.5, 1.5, 9)
RADIAL = np.linspace(-0.4, 0.4, 9)  # k1: -0.3 is a wide lens
MIN_SIGMAS = 5.0  # of a radial coefficient from 0: 11 in scan-a at -0.2; right captures have 0 to 1.6
MIN_SHARE_SIGMAS = 3.5  # of the share from 1, for it must also be near 0: 3.8 to 12 in five captures of undistorted
# pictures, at most 1 in right ones
SHIFTS = np.linspace(-1.5, 1.5, 7)
MIN_SHIFT_PX, MIN_SHIFT_SIGMAS = 0.35, 5.0  # half a pixel is COLMAP's corner, one is MATLAB's count; scan-a as it is
# has 0.00 +- 0.04, a simulated capture of half the size -0.05 +- 0.12
MAX_SHARE, NEAR_SIGMAS = 0.3, 3.0  # of the coefficients, of pictures without distortion: -0.56 +- 0.21 in one


@dataclass(frozen=True, slots=True)
class Estimate:
    """Holds an estimated number and its standard deviation."""

    value: float
    deviation: float


def judge_distortion(
    images: Mapping[str, ImageRgb], silhouettes: Mapping[str, Silhouette], rig: Rig
) -> list[ReportWarning]:
    """Returns a warning if only the rig or only the pictures have distortion, or if the principal points have another
    pixel origin."""
    usable = [name for name in rig.names if name in images and silhouettes[name].quality.usable]
    seen = _around_front(rig.subset(usable))
    if len(seen) < MIN_VIEWS or any(camera.recorded is not None for camera in seen):
        return []
    flat = all(camera.intrinsics.distortion.is_zero for camera in seen)
    if not flat and _effect(seen, silhouettes) < MIN_EFFECT:
        return []
    tracks = find_tracks(images, silhouettes, seen, min_views=2 if len(seen) == MIN_VIEWS else MIN_VIEWS)
    if tracks.count < MIN_TRACKS:
        return []
    if flat:
        radial = estimate(tracks, lambda k1: _with(seen, lambda _: Distortion(k1=k1)), RADIAL)
        distorted = _with(seen, lambda _: Distortion(k1=radial.value))
        if abs(radial.value) < MIN_SIGMAS * radial.deviation or _effect(distorted, silhouettes) < MIN_EFFECT:
            return _judge_counting(tracks, seen)
        return [compose("lens-doubtful", finding=compose("pictures-distorted", k1=radial.value))]
    share = estimate(tracks, lambda share: _with(seen, lambda lens: _times(lens, share)), SHARES)
    beside_none = abs(share.value) > max(MAX_SHARE, NEAR_SIGMAS * share.deviation)
    if 1.0 - share.value < MIN_SHARE_SIGMAS * share.deviation or beside_none:
        return _judge_counting(tracks, seen)
    return [compose("lens-doubtful", finding=compose("pictures-undistorted"))]


def _judge_counting(tracks: SceneTracks, seen: Rig) -> list[ReportWarning]:
    """Returns a warning if all principal points are shifted equally to the right and down."""

    def read(shift_px: float) -> Rig:
        return seen.with_intrinsics(lambda k: replace(k, cx=k.cx - shift_px, cy=k.cy - shift_px))

    shift = estimate(tracks, read, SHIFTS)
    if abs(shift.value) < max(MIN_SHIFT_PX, MIN_SHIFT_SIGMAS * shift.deviation):
        return []
    return [compose("lens-doubtful", finding=compose("principal-points-counted", shift_px=shift.value))]


def _around_front(rig: Rig) -> Rig:
    """Returns the cameras nearest to the front camera, at most ``MAX_VIEWS``."""
    if len(rig) <= MAX_VIEWS:
        return rig
    front = rig[rig.front_camera()].centre_world
    apart = {camera.name: float(np.linalg.norm(camera.centre_world - front)) for camera in rig}
    return rig.subset(sorted(apart, key=lambda name: apart[name])[:MAX_VIEWS])


def estimate(tracks: SceneTracks, read: Callable[[float], Rig], values: Sequence[float] | np.ndarray) -> Estimate:
    """Estimates one parameter of a rig by minimising the reprojection errors of the tracks. ``read`` returns the rig
    for a value of the parameter. The search starts at the best of ``values``."""
    from scipy.optimize import fminbound  # a quarter of a second

    def missed(value: float) -> Float[np.ndarray, "n 2"]:
        return np.nan_to_num(misses_px(tracks, read(value)), nan=100.0)

    def cost(value: float) -> float:
        squared = (missed(value) ** 2).sum(axis=1) / ROBUST_PX**2
        return float((squared / (1.0 + squared)).mean())

    step = float(values[1] - values[0])
    start = min(values, key=cost)
    best = float(np.asarray(fminbound(cost, start - step, start + step)))
    misses = missed(best)
    slopes = (missed(best + 0.1 * step) - missed(best - 0.1 * step)) / (0.2 * step)
    weights = 1.0 / (1.0 + (misses**2).sum(axis=1, keepdims=True) / ROBUST_PX**2) ** 2
    equations = misses.size - 3 * tracks.count
    variance = float((weights * misses**2).sum() / weights.mean() / equations)
    return Estimate(best, float(np.sqrt(variance / max(float((weights * slopes**2).sum()), 1e-12))))


def _with(rig: Rig, lens: Callable[[Distortion], Distortion]) -> Rig:
    return rig.with_intrinsics(lambda k: replace(k, distortion=lens(k.distortion)))


def _times(lens: Distortion, share: float) -> Distortion:
    return Distortion(*(share * lens.opencv()).tolist())


def _effect(rig: Rig, silhouettes: Mapping[str, Silhouette]) -> float:
    """Returns the lens distortion of the subject's outermost pixels, as a fraction of the picture's width (median over
    the cameras)."""
    moved = []
    for camera in rig:
        k = camera.intrinsics
        rows, columns = np.nonzero(silhouettes[camera.name].mask)
        if len(rows):
            ends = np.array([(x, y) for x in (columns.min(), columns.max()) for y in (rows.min(), rows.max())], float)
            straight = camera.undistort(ends)
            off = (k.distortion.apply(straight) - straight) * (k.fx, k.fy)
            moved.append(float(np.nanmax(np.linalg.norm(off, axis=1))) / k.width)
    return float(np.median(moved)) if moved else 0.0
