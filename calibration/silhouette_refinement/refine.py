"""Refines camera poses with silhouettes of any subject, by epipolar tangency over several captures.

``tangency_term`` computes the residual and its derivatives by the cameras. Each Levenberg-Marquardt step searches the
tangencies again. The first step uses only the outer tangencies of ``pipeline.multiview.tangency``, whose assignment is
unambiguous. Later steps use all frontier points. With a head model, the rims of fitted heads are added at the end. The
covariance of the board calibration is the prior. Silhouettes do not determine a rig's scale, so the scale does not
change.

A frontier point is a point where an epipolar plane touches the subject. Consider the angle of a contour's rays about
the line through two camera centres. At a local extremum of this angle the epipolar plane touches the subject. Unless
the touching point is hidden, the other camera's contour has an extremum at the same angle.
``pipeline.multiview.tangency`` uses only the smallest and the largest angle of two cameras; a head with hair and
shoulders has several more extrema. Concave extrema are ignored: where two parts of an outline cross (a T-junction), the
contour has a concave corner that is no point of the subject. Extrema of two contours are paired by their angles, so the
cameras must already be accurate to about ``GATE_PX``.

The rims of a head fitted to one capture give normal equations for the head's shape, the head's pose and the cameras
(the paper's section 4.4, ``pipeline.contour_fit.contour``). The Schur complement eliminates shape and pose, so that
their uncertainty is taken into account. The remaining equations for the cameras are added over all captures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import cv2
import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from calibration.adjustment.gauge import align_world, gauge_projection, image_distance
from calibration.silhouette_refinement.tangency_term import (
    ROBUST_SIGMAS,
    PackedTangencies,
    TangencyTerm,
    corrected,
    per_camera,
    tangency_residuals,
)
from pipeline.contour_fit.contour import solve_contour
from pipeline.contour_fit.head_problem import build_head_problem
from pipeline.contour_fit.problem import PER_CAMERA, camera_information
from pipeline.estimation.levenberg_marquardt import MIN_DAMPING, Limits, Solution, minimise
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import NormalEquations, Problem, Quadratic, Term
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.tangency import (
    BORDER_PX,
    LONGEST_SPAN,
    MIN_SLOPE,
    Tangency,
    angle_slopes,
    epipolar_plane_axes,
    find_tangencies,
    on_contour,
    rays_about,
    tangency,
)
from pipeline.settings import FittingSettings
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.geometry import Similarity
from rig.messages.message import Message, compose
from rig.progress import Progress, discard_progress
from rig.rig import Rig

PRIOR_PX = 0.2  # standard deviation in the image, of a camera that states no covariance
FOCAL_SPREAD = 1e-3  # standard deviation of the focal length's logarithm after a calibration with a board
NOISE_LEAST_PX = 0.07  # no contour of a binary mask is more accurate
OUTER_STEPS = 1  # steps with outer tangents alone, whose pairing is certain
STEPS, RIM_STEPS = 6, 2
# One almost undamped step for each set of tangencies: the start is near, and its covariance bounds the step.
ONE_STEP = Limits(steps=1, first_damping=MIN_DAMPING)
SETTLED_PX = 1e-2  # image motion of a step below which the cameras have converged
FOLDS = 5
GAIN_SIGMAS = 2.0  # the mean cost of held-out residuals must fall by so many of its standard deviations

Pairs = Callable[[tuple[str, str]], bool]  # whether the tangencies of two cameras take part
GATE_PX = 2.5  # largest distance of two extremes that count as one frontier point
REACH = 15  # contour pixels to either side among which an extreme must be the largest
PROMINENCE_PX = 0.3  # by so much: an outline straighter than a radius of 400 px does not locate an extreme
SMOOTH_PX = 1.0  # smoothing along the contour; it shifts a bend of radius r by 1 / (2 r) px
INSIDE_PX = 4.0  # at this distance behind a convex extreme the mask must show the subject
HELD_PX = 0.01  # prior that keeps cameras fixed in the fit: a tenth of the errors sought


class TooFewCaptures(EigenheadError):
    """Reports that there are too few captures to refine the cameras and to check the result."""

    def __init__(self, captures: int) -> None:
        super().__init__(compose("refinement-too-few-captures", count=captures))


@dataclass(frozen=True, slots=True, eq=False)
class Heads:
    """Holds a head model, and for each capture the pose ``world_from_head`` from which the fit of its head starts."""

    model: HeadModel
    starts: Sequence[Similarity]
    settings: FittingSettings = field(default_factory=FittingSettings)

    def subset(self, chosen: Sequence[int]) -> "Heads":
        """Returns the heads of the captures with the indices ``chosen``."""
        return replace(self, starts=[self.starts[i] for i in chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Holds the residuals (px) of tangencies, each with the names of its two cameras."""

    cameras: tuple[tuple[str, str], ...]
    px: Float[np.ndarray, " n"]

    def of(self, camera: str) -> Float[np.ndarray, " k"]:
        """Returns the residuals (px) of all tangencies of one camera."""
        return self.px[[camera in pair for pair in self.cameras]]


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Holds the result of a refinement.

    Attributes:
        rig: ``proposed`` if the refinement is ``kept``, otherwise the start.
        proposed: the refined rig.
        before: residuals of all captures in the rig before the refinement.
        after: residuals of each capture with cameras refined by the other captures alone.
        before_px: robust RMS of ``before``.
        after_px: robust RMS of ``after``.
        noise_px: the noise assumed for ``before_px`` and ``after_px``.
        kept: whether the held-out captures agree better.
        reason: why the refined rig was kept or not.
        change_px: for each camera, the RMS motion (2D) of its image of the subject's region by the refinement.
    """

    rig: Rig
    proposed: Rig
    before: Residuals
    after: Residuals
    before_px: float
    after_px: float
    noise_px: float
    kept: bool
    reason: Message
    change_px: Mapping[str, float]


def refine(
    captures: Sequence[Mapping[str, Silhouette]],
    rig: Rig,
    *,
    focal: bool = False,
    heads: Heads | None = None,
    report: Progress = discard_progress,
) -> Refinement:
    """Refines camera poses, and with ``focal`` also focal lengths, from the silhouettes of all captures.

    In a cross-validation with at most ``FOLDS`` folds, each capture is compared with cameras refined by other captures.
    The refined rig is kept if the captures agree better with the refined cameras. With ``heads``, the rims of fitted
    heads are also used once the tangencies have converged. Raises TooFewCaptures."""
    if len(captures) < 2:
        raise TooFewCaptures(len(captures))
    folds = min(FOLDS, len(captures))
    proposed = minimise_tangencies(captures, rig, focal=focal, heads=heads)
    report("refine", 1 / (folds + 1))
    parts = []
    for fold in range(folds):
        others = [i for i in range(len(captures)) if i % folds != fold]
        other_heads = None if heads is None else heads.subset(others)
        without = minimise_tangencies([captures[i] for i in others], rig, focal=focal, heads=other_heads)
        held_out = captures[fold::folds]
        parts.append((residuals(held_out, rig), residuals(held_out, without)))
        report("refine", (fold + 2) / (folds + 1))
    before, after = (_joined(side) for side in zip(*parts, strict=True))
    noise = noise_of(after.px)
    gain, deviation = gain_of(before.px, after.px, noise)
    before_px, after_px = robust_rms(before.px, noise), robust_rms(after.px, noise)
    accepted = gain > GAIN_SIGMAS * deviation
    reason = compose(
        "refinement-captures-shrink" if accepted else "refinement-captures-stay",
        captures=len(captures),
        before_px=before_px,
        after_px=after_px,
        equations=len(after.px),
        sigmas=gain / max(deviation, 1e-9),
    )
    return Refinement(
        rig=proposed if accepted else rig,
        proposed=proposed,
        before=before,
        after=after,
        before_px=before_px,
        after_px=after_px,
        noise_px=noise,
        kept=accepted,
        reason=reason,
        change_px=dict(zip(rig.names, image_distance(proposed, rig).tolist(), strict=True)),
    )


def _joined(parts: Sequence[Residuals]) -> Residuals:
    cameras = tuple(pair for part in parts for pair in part.cameras)
    return Residuals(cameras, np.concatenate([part.px for part in parts]))


def residuals(captures: Sequence[Mapping[str, Silhouette]], rig: Rig, pairs: Pairs | None = None) -> Residuals:
    """Returns the residuals of all captures' outer tangencies, or of those between the given ``pairs`` of cameras.

    Every rig has the same outer tangencies, so residuals of two rigs can be compared."""
    found = [_tangencies(capture, rig, pairs, outer=True) for capture in captures]
    misses = [tangency_residuals(PackedTangencies.of(tangencies, rig), rig) for tangencies in found]
    return Residuals(tuple(t.cameras for tangencies in found for t in tangencies), np.concatenate(misses))


def robust_rms(misses: Float[np.ndarray, " n"], noise_px: float) -> float:
    """Returns the RMS of residuals (px) with reduced weights beyond three standard deviations (Geman-McClure)."""
    return float(np.sqrt(np.mean(_forgiven(misses, noise_px)))) if len(misses) else float("nan")


def _forgiven(misses: Float[np.ndarray, " n"], noise_px: float) -> Float[np.ndarray, " n"]:
    return noise_px**2 * GemanMcClure(ROBUST_SIGMAS).cost((misses / noise_px) ** 2)


def noise_of(misses: Float[np.ndarray, " n"]) -> float:
    """Returns the robust standard deviation of residuals, px."""
    return max(NOISE_LEAST_PX, 1.4826 * float(np.median(np.abs(misses)))) if len(misses) else NOISE_LEAST_PX


def gain_of(before: np.ndarray, after: np.ndarray, noise: float) -> tuple[float, float]:
    """Returns the decrease of the mean robust cost from ``before`` to ``after``, and its standard deviation."""
    one, two = _forgiven(before, noise), _forgiven(after, noise)
    if len(one) != len(two):  # a tangency at the image's border appeared or disappeared
        spread = np.hypot(one.std() / np.sqrt(max(1, len(one))), two.std() / np.sqrt(max(1, len(two))))
        return float(one.mean() - two.mean()), float(spread)
    fall = one - two
    return float(fall.mean()), float(fall.std() / np.sqrt(max(1, len(fall))))


def minimise_tangencies(
    captures: Sequence[Mapping[str, Silhouette]],
    start: Rig,
    *,
    focal: bool,
    heads: Heads | None,
    pairs: Pairs | None = None,
) -> Rig:
    """Returns the cameras that minimise the tangency cost over all captures, with ``start`` as the prior. With
    ``heads``, the cost of the heads' rims is added at the end.

    ``pairs`` restricts the tangencies to certain pairs of cameras. The last step gives the covariances of the result,
    in the subject's gauge (``calibration.adjustment.gauge``)."""
    here = _Refining(captures, start, focal, pairs)
    correction = here.prior.centre
    solution = None
    for k in range(STEPS):
        outer = k < OUTER_STEPS
        term = here.tangency_term(correction, outer=outer)
        solution = here.step(correction, (term,))
        motion_px = term.at(solution.value).residual - term.at(correction).residual
        correction = solution.value
        if not outer and term.noise_px * np.sqrt(np.mean(motion_px**2)) < SETTLED_PX:
            break
    for _ in range(RIM_STEPS if heads is not None else 0):
        assert heads is not None
        terms = (here.tangency_term(correction, outer=False), *here.rim_terms(correction, heads))
        solution = here.step(correction, terms)
        correction = solution.value
    assert solution is not None
    equations = NormalEquations.empty(len(correction))
    solution.at.add_to(equations)
    covariance = here.projection @ np.linalg.inv(equations.matrix) @ here.projection.T
    return _with_covariances(align_world(here.rig(correction), start), covariance, focal=focal)


class _Refining:
    """Holds the data of a refinement that do not change between its steps."""

    def __init__(
        self, captures: Sequence[Mapping[str, Silhouette]], start: Rig, focal: bool, pairs: Pairs | None
    ) -> None:
        self.captures, self.start, self.focal, self.pairs = captures, start, focal, pairs
        self.projection = _projection(start, focal=focal)
        information = gauge_free(_prior(start, focal=focal), self.projection)
        self.prior = Quadratic.prior(information, np.zeros(len(information)))

    def rig(self, correction: Float[np.ndarray, " p"]) -> Rig:
        return corrected(self.start, correction, focal=self.focal)

    def step(
        self, correction: Float[np.ndarray, " p"], terms: tuple[Term[Float[np.ndarray, " p"]], ...]
    ) -> Solution[Float[np.ndarray, " p"]]:
        """Takes one Levenberg-Marquardt step on the cost of ``terms`` and the prior."""
        return minimise(Problem((*terms, self.prior), len(correction), np.add), correction, ONE_STEP)

    def tangency_term(self, correction: Float[np.ndarray, " p"], *, outer: bool) -> TangencyTerm:
        """Finds the tangencies of all captures in the corrected cameras. Returns the tangencies' cost, with robustly
        estimated noise."""
        rig = self.rig(correction)
        tangencies = [t for capture in self.captures for t in _tangencies(capture, rig, self.pairs, outer=outer)]
        packed = PackedTangencies.of(tangencies, rig)
        return TangencyTerm(packed, self.start, self.focal, noise_of(tangency_residuals(packed, rig)))

    def rim_terms(self, correction: Float[np.ndarray, " p"], heads: Heads) -> list[Quadratic]:
        """Returns each capture's rim cost as a quadratic function of the corrections of all cameras."""
        rig, poses = self.rig(correction), _pose_places(self.start, focal=self.focal)
        terms = []
        for capture, start in zip(self.captures, heads.starts, strict=True):
            matrix, gradient = np.zeros((len(correction),) * 2), np.zeros(len(correction))
            matrix[np.ix_(poses, poses)], gradient[poses] = rim_equations(capture, rig, heads, start)
            terms.append(Quadratic(matrix, correction, -gradient))
        return terms


def _with_covariances(rig: Rig, covariance: Float[np.ndarray, "p p"], *, focal: bool) -> Rig:
    size = per_camera(focal=focal)
    blocks = [covariance[size * k : size * k + 6, size * k : size * k + 6] for k in range(len(rig))]
    cameras = (replace(c, covariance=0.5 * (b + b.T)) for c, b in zip(rig, blocks, strict=True))
    return replace(rig, cameras=tuple(cameras))


def _tangencies(capture: Mapping[str, Silhouette], rig: Rig, pairs: Pairs | None, *, outer: bool) -> list[Tangency]:
    usable = rig.subset(name for name in rig.names if name in capture and capture[name].quality.usable)
    tangencies = find_tangencies(capture, usable) if outer else find_frontier(capture, usable)
    return tangencies if pairs is None else [tangency for tangency in tangencies if pairs(tangency.cameras)]


def _pose_places(rig: Rig, *, focal: bool) -> Int[np.ndarray, " q"]:
    """Returns the indices of each camera's six pose parameters among all parameters."""
    return np.concatenate([per_camera(focal=focal) * k + np.arange(6) for k in range(len(rig))])


def _prior(rig: Rig, *, focal: bool) -> Float[np.ndarray, "p p"]:
    """Returns the prior information matrix of all camera poses and, with ``focal``, logarithms of focal lengths."""
    centre = rig.centre_world()[None]
    blocks = []
    for camera in rig:
        depth = float(camera.camera_from_world.apply(centre)[0, 2])
        block = np.zeros((per_camera(focal=focal),) * 2)
        block[:6, :6] = camera_information(camera, depth, PRIOR_PX)
        block[6:, 6:] = FOCAL_SPREAD**-2
        blocks.append(block)
    return np.asarray(scipy.linalg.block_diag(*blocks))


def gauge_free(information: Float[np.ndarray, "p p"], projection: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """Removes from a prior the information on the choice of the world frame, which no image determines. Returns the
    information matrix of N(0, information^-1) restricted to the range of ``projection``, plus a term that holds motions
    of the world at zero.

    With S the projection, I - S = A B of rank 6, and M the information, the minimum of (x - A t)^T M (x - A t) over all
    motions t of the world is x^T (M - M A (A^T M A)^-1 A^T M) x. Neither this minimum nor the tangency cost changes if
    the whole rig moves. The term ``(I - S)^T M (I - S)`` fixes the world frame without an effect on any image.
    """
    world = np.eye(len(projection)) - projection
    motions = scipy.linalg.orth(world, rcond=1e-9)
    pulled = information @ motions
    free = information - pulled @ np.linalg.solve(motions.T @ pulled, pulled.T)
    whole = free + world.T @ information @ world
    return 0.5 * (whole + whole.T)


def _projection(rig: Rig, *, focal: bool) -> Float[np.ndarray, "p p"]:
    """Returns the projection that removes a motion of the whole rig from a step."""
    poses = _pose_places(rig, focal=focal)
    matrix = np.eye(per_camera(focal=focal) * len(rig))
    matrix[np.ix_(poses, poses)] = gauge_projection(rig)
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class Contour:
    """Holds the longest closed outline of a silhouette: ordered sub-pixel positions and unit rays in the world frame.
    ``whole`` marks pixels away from the picture's border."""

    camera: Camera
    mask: Bool[np.ndarray, "h w"]
    pixels: Float[np.ndarray, "n 2"]
    rays: Float[np.ndarray, "n 3"]
    whole: Bool[np.ndarray, " n"]

    @classmethod
    def of(cls, camera: Camera, silhouette: Silhouette) -> "Contour":
        """Extracts the longest outline of a silhouette, smoothed by ``SMOOTH_PX``."""
        outlines, _ = cv2.findContours(silhouette.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        chain = max(outlines, key=len).reshape(-1, 2).astype(float)
        pixels = gaussian_filter1d(on_contour(chain, silhouette.distance), SMOOTH_PX, axis=0, mode="wrap")
        far = np.array([camera.intrinsics.width, camera.intrinsics.height]) - 1.0
        margin = np.minimum(chain, far - chain).min(axis=1)
        whole = -maximum_filter1d(-margin, 2 * REACH + 1, mode="wrap") >= BORDER_PX
        return cls(camera, silhouette.mask, pixels, camera.rays_world(pixels), whole)


@dataclass(frozen=True, slots=True, eq=False)
class _Extremes:
    """Holds the local extrema of the epipolar plane's angle along one contour: angle (rad), kind (+1 maximum, -1
    minimum), pixel, and the angle's change per pixel."""

    angle: Float[np.ndarray, " e"]
    side: Float[np.ndarray, " e"]
    pixels: Float[np.ndarray, "e 2"]
    slopes: Float[np.ndarray, "e 2"]


def find_frontier(silhouettes: Mapping[str, Silhouette], rig: Rig) -> list[Tangency]:
    """Returns the unambiguous frontier points of every pair of cameras. Every camera of ``rig`` must have a usable
    silhouette."""
    contours = [Contour.of(camera, silhouettes[camera.name]) for camera in rig]
    return [point for one, two in combinations(contours, 2) for point in _pair(one, two)]


def _pair(one: Contour, two: Contour) -> list[Tangency]:
    u, v = epipolar_plane_axes(one.camera, two.camera, one.rays.mean(axis=0) + two.rays.mean(axis=0))
    angles = [np.arctan2(contour.rays @ v, contour.rays @ u) for contour in (one, two)]
    if max(np.ptp(angle) for angle in angles) > LONGEST_SPAN:
        return []
    first, second = (_extremes(c, angle, u, v) for c, angle in zip((one, two), angles, strict=True))
    if not len(first.angle) or not len(second.angle):
        return []
    steepness, other_steepness = (np.linalg.norm(each.slopes, axis=1) for each in (first, second))
    gap = np.abs(first.angle[:, None] - second.angle[None, :])
    apart = gap / np.hypot(steepness[:, None], other_steepness[None, :]) * np.sqrt(2.0)
    apart[first.side[:, None] != second.side[None, :]] = np.inf
    frontier = []
    for i, j in zip(*np.nonzero(apart < GATE_PX), strict=True):
        rivals = np.concatenate([np.delete(apart[i], j), np.delete(apart[:, j], i)])
        if len(rivals) and rivals.min() < 2.0 * GATE_PX:
            continue
        names, pixels = (one.camera.name, two.camera.name), (first.pixels[i], second.pixels[j])
        difference = float(first.angle[i] - second.angle[j])
        frontier.append(tangency(names, pixels, (first.slopes[i], second.slopes[j]), difference, float(first.side[i])))
    return frontier


def _extremes(contour: Contour, angle: Float[np.ndarray, " n"], u: np.ndarray, v: np.ndarray) -> _Extremes:
    tops = maximum_filter1d(angle, 2 * REACH + 1, mode="wrap") == angle
    bottoms = maximum_filter1d(-angle, 2 * REACH + 1, mode="wrap") == -angle
    at = np.flatnonzero((tops | bottoms) & contour.whole)
    side = np.where(tops[at], 1.0, -1.0)
    pixels = contour.pixels[at]
    slopes = angle_slopes(rays_about(contour.camera, pixels), u, v)
    steep = np.linalg.norm(slopes, axis=1)
    ends = np.maximum(side * angle[at - REACH], side * angle[(at + REACH) % len(angle)])
    behind = pixels - INSIDE_PX * (side / np.maximum(steep, 1e-12))[:, None] * slopes
    height, width = contour.mask.shape
    x, y = np.rint(np.clip(behind, 0, [width - 1, height - 1])).astype(int).T
    good = (steep > MIN_SLOPE) & (side * angle[at] - ends > PROMINENCE_PX * steep) & contour.mask[y, x]
    return _Extremes(angle[at][good], side[good], pixels[good], slopes[good])


def rim_equations(
    silhouettes: Mapping[str, Silhouette], rig: Rig, heads: Heads, start: Similarity
) -> tuple[Float[np.ndarray, "c6 c6"], Float[np.ndarray, " c6"]]:
    """Returns the normal matrix and gradient of one capture's rim cost over the left pose perturbations (rad, mm) of
    all cameras.

    The entries of cameras without a usable silhouette are zero. Raises ValueError if no silhouette is usable."""
    bare = Rig(tuple(replace(camera, covariance=None) for camera in rig))  # the caller adds the prior
    solved = solve_contour(heads.model, start, silhouettes, bare, replace(heads.settings, calibration_px=HELD_PX))
    problem = replace(solved.problem, camera_information=np.zeros_like(solved.problem.camera_information))
    stage = replace(solved.stage, cameras=True)
    scale_px = max(stage.scales_px[-1], solved.evidence.noise.floor_px)
    whole = build_head_problem(problem, solved.evidence, stage, scale_px)
    equations = whole.equations(whole.at(solved.state))
    matrix, gradient = equations.matrix, equations.gradient
    head_size = len(gradient) - PER_CAMERA * len(problem.views.names)
    head = scipy.linalg.cho_factor(matrix[:head_size, :head_size])
    across = matrix[head_size:, :head_size]
    reduced = matrix[head_size:, head_size:] - across @ scipy.linalg.cho_solve(head, across.T)
    slope = gradient[head_size:] - across @ scipy.linalg.cho_solve(head, gradient[:head_size])
    at = np.concatenate([PER_CAMERA * rig.names.index(name) + np.arange(PER_CAMERA) for name in problem.views.names])
    full, full_slope = np.zeros((PER_CAMERA * len(rig),) * 2), np.zeros(PER_CAMERA * len(rig))
    full[np.ix_(at, at)], full_slope[at] = 0.5 * (reduced + reduced.T), slope
    return full, full_slope
