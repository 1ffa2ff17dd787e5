"""Calibrates a rig from pictures of a board: detection, lenses, pose graph, bundle adjustment and checks."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from calibration.adjustment.bundle import CAUCHY, HUBER, BundleSolution, Free, adjust, corner_sigma
from calibration.adjustment.gauge import effective_pose, gauge_projection, image_sigma, in_world_frame, subject_points
from calibration.adjustment.intrinsics import Lens, estimate_lenses
from calibration.adjustment.lens_prior import LensPrior, weak_prior
from calibration.adjustment.pose_graph import Graph, build_graph
from calibration.adjustment.state import (
    INTRINSICS,
    PER_CAMERA,
    BundleState,
    Observations,
    camera_of,
    observe_views,
    orthonormal,
    residuals,
)
from calibration.adjustment.timing import TimeOffsets, board_velocities, estimate_offsets
from calibration.board.board import Board
from calibration.board.detection import Detections, View, WrongBoard, detect_folder
from calibration.board.picture_files import list_pictures
from calibration.quality.checks import (
    check_against_previous,
    check_cheirality,
    check_determined,
    check_frame,
    check_held_out,
    check_scale,
    failed,
    measure_aspect,
)
from calibration.quality.outliers import CORNER_SIGMAS, Dropped, bad_views, drop_blurred, drop_misread, explain_shot
from calibration.result import Calibration, CalibrationRefused
from rig.formats.captures.shot_files import with_serials
from rig.geometry import RigidTransform
from rig.messages.message import Message, compose
from rig.progress import Progress, discard_progress
from rig.rig import Rig

# Time offsets are used where they explain this share of the residuals; below it they would only follow noise.
OFFSET_GAIN = 0.05
ROUNDS = 4  # of leaving out what the rest contradicts


def calibrate(
    images: Path,
    board: Board,
    *,
    front: str | None = None,
    previous: Rig | None = None,
    cache: Path | None = None,
    workers: int = 2,
    report: Progress = discard_progress,
) -> Calibration:
    """Calibrates cameras from pictures ``IMAGES/<camera>/<shot>.<ext>``. Pictures with one shot name are simultaneous.

    ``images`` is the folder IMAGES. ``front`` is the camera that the subject faces; None selects the middle camera.
    ``previous`` is the rig's last calibration, with which names, layout, scale and lenses are compared. The folder
    ``cache`` stores detected corners by the pictures' content. ``workers`` is the number of processes.

    Raises InputError for damaged pictures, and WrongBoard, PoseGraphError or CalibrationRefused with a remedy.
    """
    detections = detect_folder(images, board, cache=cache, workers=workers, report=report)
    calibration = calibrate_detections(detections, front=front, previous=previous, report=report)
    first = {name: next(iter(shots.values())) for name, shots in list_pictures(images).items()}
    return replace(calibration, rig=with_serials(calibration.rig, first))


def calibrate_detections(
    detections: Detections,
    *,
    front: str | None = None,
    previous: Rig | None = None,
    report: Progress = discard_progress,
) -> Calibration:
    """Calibrates cameras from detected corners, without reading a file."""
    detected = detections.corner_count
    report("lenses", 0.0)
    detections, dropped = drop_blurred(detections)
    _refuse_blind_cameras(detections, dropped)
    lenses = estimate_lenses(detections)
    detections, misread = drop_misread(detections, lenses)
    dropped += misread
    _refuse_blind_cameras(detections, dropped)
    report("pose graph", 0.0)
    graph = build_graph(detections, lenses)
    report("bundle", 0.0)
    fit = _adjust(graph, detections, lenses, report)
    return _judged(
        fit, detections, lenses, [*dropped, *fit.dropped], detected, front=front, previous=previous, report=report
    )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Fit:
    solution: BundleSolution
    seen: Observations
    views: tuple[View, ...]
    kept: Bool[np.ndarray, " n"]
    names: tuple[str, ...]
    prior: LensPrior
    sigma: Float[np.ndarray, " c"]
    sync_px: float
    offsets: TimeOffsets
    free: Free
    dropped: tuple[Dropped, ...]


def _refuse_blind_cameras(detections: Detections, dropped: Sequence[Dropped]) -> None:
    if len(detections.sizes) == 1:
        raise CalibrationRefused([compose("camera-alone", camera=next(iter(detections.sizes)))])
    cameras_with_board = {view.camera for view in detections.views}
    blind = [name for name in detections.sizes if name not in cameras_with_board]
    if not blind:
        return
    if len(blind) == len(detections.sizes) and not dropped:
        raise WrongBoard([compose("board-in-no-picture")])
    reasons = []
    for name in blind:
        notes = [note.message() for note in detections.notes if note.camera == name]
        lost = [drop.message() for drop in dropped if drop.camera == name]
        why = notes[0] if notes else lost[0] if lost else compose("no-picture-of-board")
        reasons.append(compose("camera-without-board", camera=name, why=why))
    raise CalibrationRefused(reasons)


def _adjust(graph: Graph, detections: Detections, lenses: dict[str, Lens], report: Progress) -> _Fit:
    """Repeats the bundle adjustment without contradictory views until no view contradicts the result."""
    names, noise = graph.names, np.array([lenses[name].noise_px for name in graph.names])
    weak = weak_prior([detections.sizes[name] for name in names])
    dropped = list(_explain(graph.strays, graph, graph.state(lenses), detections, float(np.median(noise))))
    views = _exclude(graph.views, dropped)
    state = graph.state(lenses)

    def tick() -> None:
        report("bundle", min(0.9, len(dropped) / 10))

    for attempt in range(ROUNDS):
        observed = observe_views(views, names, graph.shots, detections.board)
        if attempt == 0:
            for scale in (8.0, 2.0):
                sigma = np.sqrt(noise**2 + 0.25) * scale
                state = adjust(state, observed, weak, sigma, loss=CAUCHY, tick=tick).state
        sigma, _ = corner_sigma(state, observed, noise)
        state = adjust(state, observed, _prior(weak, names, lenses, noise, sigma), sigma, loss=CAUCHY, tick=tick).state
        bad = bad_views(state, observed)
        if not bad.any():
            break
        strange = [view for view, is_bad in zip(views, bad, strict=True) if is_bad]
        explanations = list(_explain(strange, graph, state, detections, float(np.median(sigma))))
        dropped += explanations
        views = _exclude(views, explanations)
    return _finish(state, views, graph, detections, lenses, weak, noise=noise, dropped=tuple(dropped), report=report)


def _exclude(views: Iterable[View], dropped: Iterable[Dropped]) -> tuple[View, ...]:
    """Returns the views that were not dropped. What was dropped without a camera is a whole shot."""
    gone = {(d.shot, d.camera) for d in dropped}
    return tuple(v for v in views if not {(v.shot, v.camera), (v.shot, None)} & gone)


def _finish(
    state: BundleState,
    views: tuple[View, ...],
    graph: Graph,
    detections: Detections,
    lenses: dict[str, Lens],
    weak: LensPrior,
    *,
    noise: Float[np.ndarray, " c"],
    dropped: tuple[Dropped, ...],
    report: Progress,
) -> _Fit:
    """Removes outlying corners, adjusts with Huber's loss, and adds time offsets if they reduce the residuals."""
    names = graph.names
    contradicting = _contradicting_cameras(names, views, dropped)
    if contradicting:
        raise CalibrationRefused([*contradicting, *(drop.message() for drop in dropped[:5])])
    state, shots = _take_shots(state, graph.shots, {view.shot for view in views})
    everything = observe_views(views, names, shots, detections.board)
    sigma, _ = corner_sigma(state, everything, noise)
    prior = _prior(weak, names, lenses, noise, sigma)
    offsets = estimate_offsets(state, everything, prior, sigma)
    used = offsets.rms_with_px < (1 - OFFSET_GAIN) * offsets.rms_without_px
    free = Free(offsets=used)
    retained = np.ones(len(everything.pixels), dtype=bool)
    solution = None
    for round_number in range(3):
        report("bundle", 0.9)
        if used:
            state = replace(state, velocities=board_velocities(state))
        solution = adjust(state, everything.subset(retained), prior, sigma, free=free, loss=HUBER)
        state = solution.state
        if round_number == 2:
            break
        sigma, _ = corner_sigma(state, everything.subset(retained), noise)
        prior = _prior(weak, names, lenses, noise, sigma)
        size = np.linalg.norm(residuals(state, everything), axis=1)
        retained = size < CORNER_SIGMAS * 1.1774 * sigma[everything.camera[everything.view_of]]
    assert solution is not None
    observed = everything.subset(retained)
    _, sync = corner_sigma(state, observed, noise)
    return _Fit(
        solution=solution,
        seen=observed,
        views=views,
        kept=retained,
        names=names,
        prior=prior,
        sigma=sigma,
        sync_px=sync,
        offsets=offsets,
        free=free,
        dropped=dropped,
    )


def _take_shots(state: BundleState, shots: Sequence[str], used: set[str]) -> tuple[BundleState, tuple[str, ...]]:
    """Returns the state without shots other than ``used``, and the names of these shots in order."""
    at = [index for index, shot in enumerate(shots) if shot in used]
    boards = state.board_rotations[at], state.board_translations[at]
    state = replace(state, board_rotations=boards[0], board_translations=boards[1], velocities=state.velocities[at])
    return state, tuple(shots[index] for index in at)


def _contradicting_cameras(names: Sequence[str], views: Sequence[View], dropped: Sequence[Dropped]) -> list[Message]:
    """Returns a message for each camera with more excluded views than valid views. A mirrored camera may have many
    excluded views, because it can agree with other cameras in any single shot."""
    left, lost = Counter(view.camera for view in views), Counter(drop.camera for drop in dropped)
    return [
        compose("views-contradict", camera=name, count=lost[name], all=lost[name] + left[name])
        for name in names
        if left[name] < max(lost[name], 1)
    ]


def _prior(
    weak: LensPrior, names: Sequence[str], lenses: dict[str, Lens], noise: Float[np.ndarray, " c"], sigma: np.ndarray
) -> LensPrior:
    """Returns the prior of each camera's lens: ``weak`` combined with the estimate from that camera's views alone. If
    cameras were not simultaneous, all corners of a view share an error, which the joint fit would explain by wrong
    lenses. The weight of the separate estimate is the fraction of the noise that the corners of one view share."""
    share = 1.0 - noise**2 / sigma**2
    mean = np.stack([lenses[name].intrinsics.values() for name in names])
    information = np.stack([np.linalg.inv(lenses[name].covariance) for name in names])
    return weak.combine(mean, information * share[:, None, None])


def _explain(
    strange: Iterable[View], graph: Graph, state: BundleState, detections: Detections, noise_px: float
) -> Iterable[Dropped]:
    boards = {
        shot: RigidTransform(rotation, translation)
        for shot, rotation, translation in zip(
            graph.shots, state.board_rotations, state.board_translations, strict=True
        )
    }
    strange = list(strange)
    for shot in sorted({view.shot for view in strange}):
        inside = [view for view in (*graph.views, *graph.strays) if view.shot == shot]
        bad = [view for view in strange if view.shot == shot]
        yield from explain_shot(
            shot, inside, bad, detections, state, names=graph.names, boards=boards, noise_px=noise_px
        )


def _judged(
    fit: _Fit,
    detections: Detections,
    lenses: dict[str, Lens],
    dropped: Sequence[Dropped],
    detected: int,
    *,
    front: str | None,
    previous: Rig | None,
    report: Progress,
) -> Calibration:
    report("checks", 0.0)
    state = orthonormal(fit.solution.state)
    bare = Rig(tuple(camera_of(state, i, name, detections.sizes[name]) for i, name in enumerate(fit.names)))
    rig = in_world_frame(bare, front)
    covariance, intrinsics_sigma, pose_sigma = _covariances(fit, rig)
    blocks = [covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(rig))]
    rig = Rig(tuple(replace(camera, covariance=block) for camera, block in zip(rig, blocks, strict=True)))
    aspect, aspect_sigma = measure_aspect(fit.solution.state, fit.seen, fit.prior, fit.sigma, fit.free)
    frame = check_frame(rig, detections.board)
    checks = [
        check_cheirality(state, fit.seen, detections.board),
        check_held_out(fit.solution.state, fit.seen, fit.prior, fit.sigma, fit.free),
        check_scale(detections.board, aspect, aspect_sigma),
        frame,
        *([check_determined(rig, pose_sigma)] if frame.passed else []),  # at a subject of a head's size
        *check_against_previous(rig, previous),
    ]
    report("checks", 1.0)
    offsets = fit.offsets if np.isfinite(fit.offsets.sigma).all() else None
    calibration = Calibration(
        rig=rig,
        board=detections.board,
        front=front or rig.front_camera(),
        intrinsics_sigma=intrinsics_sigma,
        pose_sigma_px=dict(zip(rig.names, pose_sigma.tolist(), strict=True)),
        misses=_misses(fit),
        detected=detected,
        lenses=lenses,
        sync_px=fit.sync_px,
        offsets=offsets,
        offsets_used=fit.free.offsets,
        dropped=tuple(dropped),
        checks=tuple(checks),
        warnings=(*detections.remarks, *_warnings(fit, lenses, dropped)),
    )
    bad = failed(checks)
    if bad:
        raise CalibrationRefused(
            [compose("check-failed", check=c.name, detail=c.detail, advice=c.advice or "") for c in bad], calibration
        )
    return calibration


def _covariances(
    fit: _Fit, rig: Rig
) -> tuple[Float[np.ndarray, "p p"], dict[str, Float[np.ndarray, " 9"]], Float[np.ndarray, " c"]]:
    """Returns the poses' joint covariance in the subject's gauge, standard deviations of the intrinsics, and the effect
    of both on the subject's image (px). The covariance of the poses includes the uncertainty of the lenses
    (``effective_pose``), because a later fit treats the intrinsics as exact.

    Corners of one view share an error if cameras were not simultaneous or the board bends. The covariance for
    independent corners is therefore multiplied by the factor ``_design_effect``."""
    full = fit.solution.covariance() * _design_effect(fit)
    cameras = len(fit.names)
    block = full[: cameras * PER_CAMERA, : cameras * PER_CAMERA].reshape(cameras, PER_CAMERA, cameras, PER_CAMERA)
    points = subject_points(rig)
    into = np.stack([effective_pose(camera, points) for camera in rig])
    poses = np.einsum("cik,ckdl,djl->cidj", into, block, into).reshape(6 * cameras, 6 * cameras)
    projection = gauge_projection(rig)
    joint = projection @ poses @ projection.T
    spread = np.sqrt(np.einsum("cici->ci", block)[:, : len(INTRINSICS)])
    return 0.5 * (joint + joint.T), dict(zip(fit.names, spread, strict=True)), image_sigma(rig, block)


def _design_effect(fit: _Fit) -> float:
    """Returns the variance of the views' mean residuals divided by its value for independent corners, at least 1."""
    misses = residuals(fit.solution.state, fit.seen)
    counts = np.bincount(fit.seen.view_of, minlength=len(fit.seen.camera))
    filled = counts > 0
    sums = np.stack([np.bincount(fit.seen.view_of, misses[:, k], minlength=len(counts)) for k in range(2)], axis=1)
    sigma = fit.sigma[fit.seen.camera]
    ratios = (sums[filled] ** 2).mean(axis=1) / counts[filled] / sigma[filled] ** 2
    return max(1.0, float(ratios.mean()))


def _misses(fit: _Fit) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Returns the numbers, pixels and residuals (px) of the used corners of each view."""
    every = residuals(fit.solution.state, fit.seen)
    table, first = {}, 0
    for index, view in enumerate(fit.views):
        retained = fit.kept[first : first + len(view.found.ids)]
        first += len(view.found.ids)
        if retained.any():
            span = slice(fit.seen.starts[index], fit.seen.starts[index + 1])
            table[view.camera, view.shot] = (view.found.ids[retained], view.found.corners[retained], every[span])
    return table


def _warnings(fit: _Fit, lenses: dict[str, Lens], dropped: Sequence[Dropped]) -> tuple[Message, ...]:
    remarks = [lens.weakness for lens in lenses.values() if lens.weakness]
    remarks += [compose("left-out", what=drop.message()) for drop in dropped]
    if fit.sync_px > 0.3:
        remarks.append(compose("cameras-out-of-step", px=fit.sync_px))
    if fit.free.offsets:
        moments = zip(fit.names, fit.solution.state.offsets, strict=True)
        offsets = [compose("camera-offset", camera=name, shots=offset).text for name, offset in moments]
        remarks.append(compose("offsets-used", offsets=offsets))
    return tuple(remarks)
