"""Checks properties of a calibration that a low reprojection error does not imply. A calibration that fails a check is
refused with a remedy. The verdict on a calibration also lists missing shots, even if all checks pass.

The limits of the verdict were chosen on simulated sessions of 4 to 30 shots (``tests.support.board_sessions``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from calibration.adjustment.bundle import HUBER, Free, adjust
from calibration.adjustment.gauge import align_world, image_distance
from calibration.adjustment.lens_prior import LensPrior
from calibration.adjustment.state import BundleState, Observations, residuals
from calibration.board.board import Board
from rig.geometry import rigid_fit, second_difference, vertex_offset
from rig.messages.message import Message, compose
from rig.plausibility import FRAME_LEAST_MM, frame_mm
from rig.rig import Rig

Word = Literal["good", "usable", "poor"]

VIEWS_LEAST, VIEWS_GOOD = 3, 6  # Zhang's method needs three; from six on its lenses hardly gain
FOCAL_POOR, FOCAL_GOOD = 0.03, 0.01  # standard deviation of the focal length, as a share of it
POSE_POOR_PX, POSE_GOOD_PX = 1.0, 0.5  # of a pose, seen at the subject
COVERED_GOOD = 0.25  # share of the picture's twelfths that hold a corner: lenses are guessed beyond
HELD_OUT_EVERY = 5  # every fifth shot is held out once
HELD_OUT_RATIO, HELD_OUT_LEAST_PX = 1.5, 0.3
SCALE_SHARE = 0.005  # a ruler on a printed board is read to 0.5 mm in 200
FOCAL_CHANGE = 0.02
LOOSE_PX = 2.0  # a camera whose pose is looser than this, seen at the subject, is not calibrated


@dataclass(frozen=True, slots=True)
class Check:
    """Holds the result of one check. ``passed`` is None if the data for the check were missing; ``advice`` is the
    remedy for a failure."""

    name: str
    passed: bool | None
    detail: Message
    advice: Message | None = None


def check_cheirality(state: BundleState, observed: Observations, board: Board) -> Check:
    """Checks that corners lie in front of cameras, that boards show their front, and that no pose is a reflection."""
    camera, shot = observed.camera[observed.view_of], observed.shot[observed.view_of]
    world = np.einsum("nij,nj->ni", state.board_rotations[shot], observed.points) + state.board_translations[shot]
    points = np.einsum("nij,nj->ni", state.camera_rotations[camera], world) + state.camera_translations[camera]
    normals = np.einsum("nij,nj->ni", state.camera_rotations[camera], state.board_rotations[shot][:, :, 2])
    behind = int((points[:, 2] <= 0).sum())
    backs = len(np.unique(observed.view_of[(normals * points).sum(axis=1) <= 0]))
    rotations = np.concatenate([state.camera_rotations, state.board_rotations])
    proper = bool((np.linalg.det(rotations) > 0).all())
    code = "cheirality-chiral" if board.is_chiral else "cheirality-symmetric"
    detail = compose(code, corners=behind, views=backs)
    advice = compose("advice-cheirality")
    return Check("cheirality", behind == 0 and backs == 0 and proper, detail, advice)


def check_held_out(
    state: BundleState, observed: Observations, prior: LensPrior, sigma: Float[np.ndarray, " c"], free: Free
) -> Check:
    """Checks that cameras estimated without every fifth shot also fit the omitted shots."""
    several = np.flatnonzero(np.bincount(observed.shot, minlength=len(state.board_rotations)) >= 2)
    held = several[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY]
    if len(held) < 2 or len(several) - len(held) < 4:
        return Check("held-out shots", None, compose("held-out-too-few", shots=len(several)))
    out = np.isin(observed.shot[observed.view_of], held)
    trained = adjust(state, observed.subset(~out), prior, sigma, free=free, loss=HUBER, steps=25).state
    boards = replace(free, intrinsics=False, poses=False, offsets=False)
    rest = observed.subset(out)
    none = LensPrior(trained.intrinsics, np.zeros((len(trained.intrinsics), 9, 9)))  # the lenses are fixed
    tested = adjust(trained, rest, none, sigma, free=boards, loss=HUBER).state
    inside, outside = (
        float(np.sqrt((residuals(s, o) ** 2).sum(axis=1).mean())) for s, o in ((state, observed), (tested, rest))
    )
    detail = compose("held-out", outside_px=outside, shots=len(held), inside_px=inside)
    passed = outside < max(HELD_OUT_RATIO * inside, inside + HELD_OUT_LEAST_PX)
    return Check("held-out shots", passed, detail, compose("advice-held-out"))


def check_scale(board: Board, aspect: float, aspect_sigma: float) -> Check:
    """Compares the squares' size with the user's measurement of the print, and the squares' ratio of height to width
    with the cameras' measurement."""
    pairs = [("width", board.measured_width_mm, board.columns), ("height", board.measured_height_mm, board.rows)]
    ratios = {name: value / (count * board.square_mm) for name, value, count in pairs if value is not None}
    off = [
        compose("print-off", side=name, percent=100 * (ratio - 1))
        for name, ratio in ratios.items()
        if abs(ratio - 1) > SCALE_SHARE
    ]
    skewed = abs(aspect - 1) > max(SCALE_SHARE, 5 * aspect_sigma)
    notes = off if ratios else [compose("print-unmeasured")]
    detail = compose("print-aspect", aspect=aspect, sigma=aspect_sigma)
    if notes:
        detail = compose("print-aspect-off", aspect=aspect, sigma=aspect_sigma, off=notes)
    advice = compose("advice-scale")
    return Check("scale", not off and not skewed, detail, advice)


def check_frame(rig: Rig, board: Board) -> Check:
    """Checks that the cameras see an area large enough for a head. A wrong unit of ``square_mm`` fails this check."""
    frame = frame_mm(rig)
    advice = compose("advice-square-unit", square_mm=board.square_mm)
    return Check("frame", frame >= FRAME_LEAST_MM, compose("frame-shown", frame_mm=frame), advice)


def check_determined(rig: Rig, pose_sigma_px: Float[np.ndarray, " c"]) -> Check:
    """Checks that the uncertainty of each camera's pose moves the subject's image by less than ``LOOSE_PX`` pixels."""
    loose = [name for name, value in zip(rig.names, pose_sigma_px, strict=True) if not value < LOOSE_PX]
    worst = int(np.argmax(pose_sigma_px))
    detail = compose("poses-determined", px=pose_sigma_px.max(), camera=rig.names[worst])
    advice = compose("advice-determined", cameras=loose) if loose else None
    return Check("determined", not loose, detail, advice)


def check_against_previous(rig: Rig, previous: Rig | None) -> list[Check]:
    """Compares the layout, scale and lenses of the cameras that are also in the previous calibration."""
    names = [name for name in rig.names if previous is not None and name in previous]
    if previous is None or len(names) < 3:
        return [
            Check("known layout", None, compose("no-earlier-calibration")),
            Check("lens stability", None, compose("no-earlier-calibration")),
        ]
    now, then = rig.subset(names), Rig(tuple(previous[name] for name in names if name in rig))
    now = Rig(tuple(now[name] for name in names))
    return [_check_layout(now, then), _check_lenses(now, then)]


def _check_layout(now: Rig, then: Rig) -> Check:
    order, cost, identity = _assignment(now, then)
    here, there = (np.stack([camera.centre_world for camera in rig]) for rig in (now, then))
    plain, mirrored = _misfit_mm(here, there, False), _misfit_mm(here, there, True)
    spread = float(np.sqrt(((there - there.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if mirrored < 0.2 * min(plain, cost) and plain > 0.05 * spread:
        advice = compose("advice-mirrored")
        return Check("known layout", False, compose("layout-mirrored"), advice)
    if cost < 0.5 * identity and any(i != j for i, j in enumerate(order)):
        swaps = [
            compose("camera-in-place-of", camera=now.names[i], other=then.names[j])
            for i, j in enumerate(order)
            if i != j
        ]
        return Check("known layout", False, compose("several", messages=swaps), compose("advice-swapped"))
    ratio = float(np.linalg.norm(here - here.mean(axis=0)) / np.linalg.norm(there - there.mean(axis=0)))
    distances = image_distance(now, then)
    moved = [
        compose("camera-by-px", camera=name, px=px).text
        for name, px in zip(now.names, distances, strict=True)
        if px > 3.0
    ]
    detail = compose("layout-moved", ratio=ratio, moved=moved) if moved else compose("layout-same", ratio=ratio)
    # Cameras move, all of them in step with a scale they do not: that is a board of another size.
    rescaled = image_distance(now, then, scale=True)
    same_shape = float(np.median(rescaled)) < 0.3 * float(np.median(distances))
    passed = not (abs(ratio - 1) > SCALE_SHARE and same_shape)
    return Check("known layout", passed, detail, compose("advice-rescaled"))


def _assignment(now: Rig, then: Rig) -> tuple[list[int], float, float]:
    """Returns, for each camera, the camera of the previous rig at the same position. Also returns the mean distance
    (mm) of this assignment and of the assignment by names."""
    here, there = (np.stack([camera.centre_world for camera in rig]) for rig in (now, then))
    best: tuple[list[int], float] | None = None
    for camera, other in ((c, o) for c in now for o in then):
        motion = camera.camera_from_world.inverse() @ other.camera_from_world  # now's world from then's
        distance = np.linalg.norm(here[:, None] - motion.apply(there)[None], axis=2)
        rows, columns = linear_sum_assignment(distance)
        cost = float(distance[rows, columns].mean())
        if best is None or cost < best[1]:
            best = (columns.tolist(), cost)
    assert best is not None
    aligned = align_world(now, then)
    named = np.stack([camera.centre_world for camera in aligned])
    return best[0], best[1], float(np.linalg.norm(named - there, axis=1).mean())


def _misfit_mm(here: Float[np.ndarray, "c 3"], there: Float[np.ndarray, "c 3"], mirrored: bool) -> float:
    """Returns the RMS distance (mm) after the best rigid motion; ``mirrored`` adds a reflection."""
    points = here * (-1.0, 1.0, 1.0) if mirrored else here
    return float(np.sqrt(((rigid_fit(points, there).apply(points) - there) ** 2).sum(axis=1).mean()))


def _check_lenses(now: Rig, then: Rig) -> Check:
    changes = {
        camera.name: camera.intrinsics.fx / then[camera.name].intrinsics.fx - 1
        for camera in now
        if camera.intrinsics.width == then[camera.name].intrinsics.width
    }
    off = [
        compose("camera-by-percent", camera=name, percent=100 * change).text
        for name, change in changes.items()
        if abs(change) > FOCAL_CHANGE
    ]
    largest = max((abs(change) for change in changes.values()), default=0.0)
    same = compose("focal-lengths-same", percent=100 * largest)
    detail = compose("focal-lengths-changed", changes=off) if off else same
    advice = compose("advice-lenses")
    return Check("lens stability", not off, detail, advice)


def measure_aspect(
    state: BundleState, observed: Observations, prior: LensPrior, sigma: Float[np.ndarray, " c"], free: Free
) -> tuple[float, float]:
    """Measures the ratio of height to width of the board's squares, and its standard deviation. The ratio is the
    minimum of a parabola through the costs of three solutions with stretched boards."""
    step = 0.003
    costs = []
    for stretch in (-step, 0.0, step):
        stretched = replace(observed, points=observed.points * [1.0, 1.0 + stretch, 1.0])
        costs.append(adjust(state, stretched, prior, sigma, free=free, loss=HUBER, steps=12).cost)
    low, middle, high = costs
    curvature = second_difference(low, middle, high)
    if curvature <= 0:
        return 1.0, float("inf")
    return 1.0 + vertex_offset(low, high, curvature) * step, float(np.sqrt(2.0 / (curvature / step**2)))


def failed(checks: Sequence[Check]) -> list[Check]:
    """Returns the failed checks, without checks that could not be judged."""
    return [check for check in checks if check.passed is False]


@dataclass(frozen=True, slots=True)
class CameraEvidence:
    """Holds how well one camera is calibrated. ``focal_share`` is the relative standard deviation of the focal length.
    The picture is divided into twelve equal parts; ``covered`` is the fraction of parts with corners."""

    views: int
    focal_share: float
    pose_sigma_px: float
    covered: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Holds the verdict on a calibration: good, usable or poor. ``missing`` lists remedies, most urgent first."""

    word: Word
    missing: tuple[Message, ...]


def judge(cameras: Mapping[str, CameraEvidence], checks: Sequence[Check]) -> Verdict:
    """Judges a calibration by its worst camera, and by whether held-out shots were available for a check."""
    severe, mild = [], []

    def of(test: str, least: float, most: float) -> list[str]:
        return [name for name, camera in cameras.items() if least < getattr(camera, test) <= most]

    infinite = float("inf")
    if blind := [name for name, camera in cameras.items() if camera.views < VIEWS_LEAST]:
        severe.append(compose("views-too-few", cameras=blind, views=VIEWS_LEAST))
    if vague := of("focal_share", FOCAL_POOR, infinite):
        severe.append(compose("focal-poor", cameras=vague, percent=100 * FOCAL_POOR))
    if loose := of("pose_sigma_px", POSE_POOR_PX, infinite):
        severe.append(compose("pose-loose", cameras=loose, px=POSE_POOR_PX))
    if few := [name for name, camera in cameras.items() if VIEWS_LEAST <= camera.views < VIEWS_GOOD]:
        mild.append(compose("views-too-few", cameras=few, views=VIEWS_GOOD))
    if vague := of("focal_share", FOCAL_GOOD, FOCAL_POOR):
        mild.append(compose("focal-poor", cameras=vague, percent=100 * FOCAL_GOOD))
    if loose := of("pose_sigma_px", POSE_GOOD_PX, POSE_POOR_PX):
        mild.append(compose("pose-loose", cameras=loose, px=POSE_GOOD_PX))
    if bare := [name for name, camera in cameras.items() if camera.covered < COVERED_GOOD]:
        mild.append(compose("rim-uncovered", cameras=bare))
    if any(check.name == "held-out shots" and check.passed is None for check in checks):
        mild.append(compose("held-out-missing"))
    return Verdict("poor" if severe else "usable" if mild else "good", (*severe, *mild))
