"""Extrinsics from silhouettes of any subject: epipolar tangency over several captures, no model of the subject.

A plane through two camera centres that touches the subject touches both silhouettes, at the images of one frontier
point (Ramanathan, Steinbach and Girod 2000; Wong and Cipolla 2001). With centres c and rays d at the two tangent
pixels, base b = c2 - c1, the planes differ by the angle

    delta = |b| b . (d1 x d2) / (|b x d1| |b x d2|)

and, divided by the change of angle per pixel in both images, the residual is the distance in pixels of either contour
that it would take, were both equally noisy. At a tangent point the contour runs along the plane, so to first order the
pixels stay where they are as a camera moves: with x' = R(w) x + v in camera 1's frame,

    d delta ~ w . (R1 (d2 x b)) x R1 d1 + v . R1 (d1 x d2)         and likewise, signs swapped, for camera 2.

The first step uses the outer tangents of ``pipeline.drift``, which cannot be confused, the others all frontier points;
each finds them anew. With a head model, the rims of the fitted heads join in at the end (``calibration.rims``). The
calibration's covariance is the prior; the gauge is that of ``calibration.gauge``. Silhouettes do not see a rig's scale,
so that stays the board's.

Enters: silhouettes of several captures, and the rig. Leaves: the rig, refined if captures held out agree.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from jaxtyping import Float, Int

from calibration.frontier import find_frontier
from calibration.gauge import align_world, gauge_projection, image_distance, moved
from calibration.rims import Heads, rim_equations
from pipeline.drift import Tangency, find_tangencies
from pipeline.fitting.problem import camera_information
from pipeline.silhouette import Silhouette
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.layout import Rig

PRIOR_PX = 0.2  # of a camera that states no covariance
FOCAL_SPREAD = 1e-3  # of the logarithm: what a board leaves open
NOISE_LEAST_PX = 0.07  # a contour of a binary mask is not better
OUTER_STEPS = 1  # with outer tangents alone, which cannot be confused
ROBUST_SIGMAS = 3.0
STEPS, RIM_STEPS = 6, 2
SETTLED_PX = 1e-2
FOLDS = 5
GAIN_SIGMAS = 2.0  # by how many of its standard deviations the held-out residuals must shrink


class TooFewCaptures(EigenheadError):
    """Nothing would be left to refine from."""

    def __init__(self, captures: int) -> None:
        super().__init__(
            f"silhouette refinement got {captures} captures, of which some are held out as a check: "
            "take at least 2, better 5, of different subjects or head poses"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Tangency residuals (px), each with the two cameras that it is of."""

    cameras: tuple[tuple[str, str], ...]
    px: Float[np.ndarray, " n"]

    def of(self, camera: str) -> Float[np.ndarray, " k"]:
        """Those that a camera takes part in."""
        return self.px[[camera in pair for pair in self.cameras]]


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """What came of it. ``before``: residuals of all captures at the start; ``after``: of each capture where the others
    alone put the cameras; ``before_px`` and ``after_px`` their robust RMS with the noise ``noise_px``. ``change_px``:
    RMS motion (2D) per camera of the subject's region, worlds aligned, from the start to ``proposed``, the rig that all
    captures agree on and that ``rig`` is only where ``kept``."""

    rig: Rig
    proposed: Rig
    before: Residuals
    after: Residuals
    before_px: float
    after_px: float
    noise_px: float
    kept: bool
    reason: str
    change_px: Mapping[str, float]


def refine(
    captures: Sequence[Mapping[str, Silhouette]],
    rig: Rig,
    *,
    focal: bool = False,
    prior_px: float = PRIOR_PX,
    heads: Heads | None = None,
    report: Callable[[str, float], None] = lambda stage, fraction: None,
) -> Refinement:
    """Refines extrinsics, and with ``focal`` focal lengths, from all captures; kept if they agree when each is held out
    in its turn (several at a time where there are more than ``FOLDS``).

    ``prior_px``: standard deviation in the image of a camera without a covariance. ``heads``: a model whose rims speak
    as well, once the tangencies have settled. Raises TooFewCaptures.
    """
    if len(captures) < 2:
        raise TooFewCaptures(len(captures))
    folds = min(FOLDS, len(captures))
    proposed = _minimise(captures, rig, focal=focal, prior_px=prior_px, heads=heads)
    report("refine", 1 / (folds + 1))
    parts = []
    for fold in range(folds):
        others = [i for i in range(len(captures)) if i % folds != fold]
        their = None if heads is None else heads.subset(others)
        without = _minimise([captures[i] for i in others], rig, focal=focal, prior_px=prior_px, heads=their)
        held_out = captures[fold::folds]
        parts.append((residuals(held_out, rig), residuals(held_out, without)))
        report("refine", (fold + 2) / (folds + 1))
    before, after = (_joined(side) for side in zip(*parts, strict=True))
    noise = _noise(after.px)
    gain, deviation = _gain(before.px, after.px, noise)
    before_px, after_px = robust_rms(before.px, noise), robust_rms(after.px, noise)
    kept = gain > GAIN_SIGMAS * deviation
    words = "shrink" if kept else "do not shrink"
    reason = (
        f"tangency residuals of the {len(captures)} captures, each held out in its turn, {words}: "
        f"{before_px:.2f} to {after_px:.2f} px over {len(after.px)} equations, "
        f"{gain / max(deviation, 1e-9):.1f} standard deviations"
    )
    return Refinement(
        rig=proposed if kept else rig,
        proposed=proposed,
        before=before,
        after=after,
        before_px=before_px,
        after_px=after_px,
        noise_px=noise,
        kept=kept,
        reason=reason,
        change_px=dict(zip(rig.names, image_distance(proposed, rig).tolist(), strict=True)),
    )


def _joined(parts: Sequence[Residuals]) -> Residuals:
    cameras = tuple(pair for part in parts for pair in part.cameras)
    return Residuals(cameras, np.concatenate([part.px for part in parts]))


def residuals(captures: Sequence[Mapping[str, Silhouette]], rig: Rig) -> Residuals:
    """Residuals of all captures' outer tangencies: the same ones whatever the rig, so that two rigs compare."""
    found = [_tangencies(capture, rig, outer=True) for capture in captures]
    misses = [_equations(tangencies, rig, focal=False)[1] for tangencies in found]
    return Residuals(tuple(t.cameras for tangencies in found for t in tangencies), np.concatenate(misses))


def robust_rms(misses: Float[np.ndarray, " n"], noise_px: float) -> float:
    """RMS where a residual beyond three standard deviations counts ever less (Geman-McClure)."""
    return float(np.sqrt(np.mean(_forgiven(misses, noise_px)))) if len(misses) else float("nan")


def _forgiven(misses: Float[np.ndarray, " n"], noise_px: float) -> Float[np.ndarray, " n"]:
    return misses**2 / (1.0 + (misses / (ROBUST_SIGMAS * noise_px)) ** 2)


def _noise(misses: Float[np.ndarray, " n"]) -> float:
    return max(NOISE_LEAST_PX, 1.4826 * float(np.median(np.abs(misses)))) if len(misses) else NOISE_LEAST_PX


def _gain(before: np.ndarray, after: np.ndarray, noise: float) -> tuple[float, float]:
    """By how much the mean robust cost falls, and the standard deviation of that."""
    one, two = _forgiven(before, noise), _forgiven(after, noise)
    if len(one) != len(two):  # a tangency at the image's border came or went
        spread = np.hypot(one.std() / np.sqrt(max(1, len(one))), two.std() / np.sqrt(max(1, len(two))))
        return float(one.mean() - two.mean()), float(spread)
    fall = one - two
    return float(fall.mean()), float(fall.std() / np.sqrt(max(1, len(fall))))


def _minimise(
    captures: Sequence[Mapping[str, Silhouette]],
    start: Rig,
    *,
    focal: bool,
    prior_px: float,
    heads: Heads | None,
) -> Rig:
    """Gauss-Newton on the tangencies of all captures, found anew at each step, with the start as prior; then on these
    and the rims of the heads. The result's covariances are those of the last step, in the subject's gauge."""
    prior = _prior(start, focal=focal, prior_px=prior_px)
    projection = _projection(start, focal=focal)
    total, rig, matrix = np.zeros(len(prior)), start, prior
    for k in range(STEPS):
        outer = k < OUTER_STEPS
        matrix, gradient, rows = _tangency_system(captures, rig, outer=outer, focal=focal)
        matrix += prior
        step = projection @ -scipy.linalg.solve(matrix, gradient + prior @ total, assume_a="pos")
        total = total + step
        rig = _apply(start, total, focal=focal)
        if not outer and np.sqrt(np.mean((rows @ step) ** 2)) < SETTLED_PX:
            break
    for _ in range(RIM_STEPS if heads is not None else 0):
        assert heads is not None
        matrix, gradient, _ = _tangency_system(captures, rig, outer=False, focal=focal)
        matrix += prior
        poses = _pose_places(rig, focal=focal)
        for capture, place in zip(captures, heads.starts, strict=True):
            more, slope = rim_equations(capture, rig, heads, place)
            matrix[np.ix_(poses, poses)] += more
            gradient[poses] += slope
        total = total + projection @ -scipy.linalg.solve(matrix, gradient + prior @ total, assume_a="pos")
        rig = _apply(start, total, focal=focal)
    covariance = projection @ np.linalg.inv(matrix) @ projection.T
    return _with_covariances(align_world(rig, start), covariance, focal=focal)


def _tangency_system(
    captures: Sequence[Mapping[str, Silhouette]], rig: Rig, *, outer: bool, focal: bool
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"], Float[np.ndarray, "n p"]]:
    """Normal matrix and gradient of the robust cost of all captures' tangencies, and the Jacobian."""
    systems = [_equations(_tangencies(capture, rig, outer=outer), rig, focal=focal) for capture in captures]
    rows, misses = np.concatenate([s[0] for s in systems]), np.concatenate([s[1] for s in systems])
    noise = _noise(misses)
    weight = 1.0 / (1.0 + (misses / (ROBUST_SIGMAS * noise)) ** 2) ** 2 / noise**2
    weighted = (rows * weight[:, None]).T
    return weighted @ rows, weighted @ misses, rows


def _with_covariances(rig: Rig, covariance: Float[np.ndarray, "p p"], *, focal: bool) -> Rig:
    size = _per_camera(focal=focal)
    blocks = [covariance[size * k : size * k + 6, size * k : size * k + 6] for k in range(len(rig))]
    return Rig(tuple(replace(c, covariance=0.5 * (b + b.T)) for c, b in zip(rig, blocks, strict=True)))


def _tangencies(capture: Mapping[str, Silhouette], rig: Rig, *, outer: bool) -> list[Tangency]:
    usable = rig.subset(name for name in rig.names if name in capture and capture[name].quality.usable)
    return find_tangencies(capture, usable) if outer else find_frontier(capture, usable)


def _per_camera(*, focal: bool) -> int:
    return 7 if focal else 6


def _pose_places(rig: Rig, *, focal: bool) -> Int[np.ndarray, " q"]:
    """Where the six pose parameters of every camera stand among all parameters."""
    return np.concatenate([_per_camera(focal=focal) * k + np.arange(6) for k in range(len(rig))])


def _prior(rig: Rig, *, focal: bool, prior_px: float) -> Float[np.ndarray, "p p"]:
    """Information of the start: the board's covariance per camera, and of the focal length's logarithm."""
    centre = rig.centre_world()[None]
    blocks = []
    for camera in rig:
        depth = float(camera.camera_from_world.apply(centre)[0, 2])
        block = np.zeros((_per_camera(focal=focal),) * 2)
        block[:6, :6] = camera_information(camera, depth, prior_px)
        block[6:, 6:] = FOCAL_SPREAD**-2
        blocks.append(block)
    return np.asarray(scipy.linalg.block_diag(*blocks))


def _projection(rig: Rig, *, focal: bool) -> Float[np.ndarray, "p p"]:
    """Takes the world's own motion out of a step."""
    poses = _pose_places(rig, focal=focal)
    matrix = np.eye(_per_camera(focal=focal) * len(rig))
    matrix[np.ix_(poses, poses)] = gauge_projection(rig)
    return matrix


def _apply(rig: Rig, total: Float[np.ndarray, " p"], *, focal: bool) -> Rig:
    cameras = []
    for camera, step in zip(rig, total.reshape(len(rig), -1), strict=True):
        cameras.append(_zoomed(moved(camera, step[:6]), float(step[6])) if focal else moved(camera, step))
    return Rig(tuple(cameras))


def _zoomed(camera: Camera, log_scale: float) -> Camera:
    lens, scale = camera.intrinsics, float(np.exp(log_scale))
    return replace(camera, intrinsics=replace(lens, fx=lens.fx * scale, fy=lens.fy * scale))


def _equations(
    tangencies: Sequence[Tangency], rig: Rig, *, focal: bool
) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, " n"]]:
    """Jacobian by all cameras' parameters and residuals (px)."""
    size = _per_camera(focal=focal)
    index = {name: k for k, name in enumerate(rig.names)}
    rows, misses = np.zeros((len(tangencies), len(rig), size)), np.zeros(len(tangencies))
    for row, (n, tangency) in zip(rows, enumerate(tangencies), strict=True):
        one, two = (rig[name] for name in tangency.cameras)
        misses[n], by_one, by_two = _equation(tangency, one, two, focal=focal)
        row[index[one.name]], row[index[two.name]] = by_one, by_two
    return rows.reshape(len(tangencies), -1), misses


def _equation(
    tangency: Tangency, one: Camera, two: Camera, *, focal: bool
) -> tuple[float, Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    """The module's residual (px) and its derivative by both cameras."""
    ray_one, ray_two = (c.rays_world(p[None])[0] for c, p in zip((one, two), tangency.pixels, strict=True))
    base = two.centre_world - one.centre_world
    plane_one, plane_two = np.cross(base, ray_one), np.cross(base, ray_two)
    # angle differences per unit of the triple product, then pixels per angle with both contours equally noisy
    steep = np.hypot(*tangency.steepness)
    gain = np.linalg.norm(base) / (np.linalg.norm(plane_one) * np.linalg.norm(plane_two) * steep)
    across = np.cross(ray_one, ray_two)
    sides = ((one, ray_one, -plane_two, across), (two, ray_two, plane_one, -across))
    slopes = []
    for (camera, ray, by_ray, by_centre), pixel in zip(sides, tangency.pixels, strict=True):
        rotation = camera.camera_from_world.rotation
        slope = [np.cross(rotation @ by_ray, rotation @ ray), rotation @ by_centre]
        if focal:
            zoom = 1e-4
            wider = _zoomed(camera, zoom).rays_world(pixel[None])[0] - _zoomed(camera, -zoom).rays_world(pixel[None])[0]
            slope.append(np.array([by_ray @ wider / (2 * zoom)]))
        slopes.append(gain * np.concatenate(slope))
    return float(gain * (base @ across)), slopes[0], slopes[1]
