"""Alignment without feature points, which the paper leaves open (section 6).

Enters: silhouettes, the rig, which camera the subject faces. Leaves: world_from_head of the mean head.

The subject's crown and the middle of its head come from the visual hull, up and front from the cameras; nothing leans
on the axes of the world frame. From there the contour solver is started at several turns of the head with pose and a
few modes on the coarsest mesh, the best few go on with a finer one, and the one that all eigenheads explain most
closely wins: under thick hair 15 modes cannot tell the right pose from one that is 50 degrees off. A start 10 mm off
ends in a local minimum under hair (docs/results.md), so the robust scale begins at 40 px.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float

from pipeline.eigenheads.model import HeadModel
from pipeline.fitting.contour import run_stage
from pipeline.fitting.head_problem import head_problem
from pipeline.fitting.photo.depth_search import pixels_per_mm
from pipeline.fitting.problem import ContourProblem, Stage, State, first_evidence, make_problem, start_state
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import Settings
from rig.errors import EigenheadError
from rig.geometry import Similarity, nearest_rotation, rotation_from_vector
from rig.progress import Progress
from rig.rig import Rig

SPACING_MM, REACH_MM = 12.0, 264.0  # hull grid about the middle of the rig
HEAD_SLAB_MM = (30.0, 150.0)  # below the crown: cranium and face, above any shoulder
HAIR_MM = 12.0  # what hair adds to the crown, in the middle of what people wear
YAWS_DEG, PITCHES_DEG = (-40.0, -20.0, 0.0, 20.0, 40.0), (-15.0, 0.0, 15.0)
FINALISTS = 4
COARSE = Stage("p99", 6, False, (40.0, 20.0, 10.0), False, True, 4)
FINE = Stage("p95", 15, False, (20.0, 10.0, 6.0), False, True, 4)
DEEP = Stage("p95", 60, True, (6.0, 4.0, 2.0), False, True, 4)
SEEN_SHARE = 0.6  # of the cameras that see the best seen point; above the frame of most, nothing carves the hull
RANKED_PX = 6.0  # robust scale at which coarse fits are compared
JUDGED_PX, JUDGED_MM = 2.0, 1.0  # and finalists, whichever is the larger: a right pose explains much of the outline
# closely, a wrong one nearly all of it badly, which 6 px took for better in one of fifty draws
REFERENCE_PX = 3000.0  # outline length that costs are scaled to, so that hiding the rim wins nothing


class NoSubject(EigenheadError):
    """The silhouettes have no common volume near the middle of the rig."""

    def __init__(self) -> None:
        super().__init__(
            "the silhouettes do not meet in the middle of the rig: check that the calibration belongs to these images "
            "and that cameras are not swapped, or give feature points"
        )


def search_alignment(
    model: HeadModel,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: Settings,
    *,
    front: str,
    report: Progress,
) -> Similarity:
    """world_from_head of the mean head, found from the silhouettes alone. Raises NoSubject."""
    axes = subject_axes(rig, front)
    origin = head_origin(model, silhouettes, rig, axes)
    first = Similarity(1.0, axes, origin)
    problem = make_problem(model, first, silhouettes, rig, settings.fitting, {}, levels=("p99", "p95"))
    starts = [turned(first, yaw, pitch) for yaw, pitch in product(YAWS_DEG, PITCHES_DEG)]
    found = []
    for i, start in enumerate(starts):
        report("alignment", 0.7 * i / len(starts))
        found.append(_descended(problem, start_state(problem, start), COARSE))
    finalists = [state for _, state in sorted(found, key=lambda pair: pair[0])[:FINALISTS]]
    close = max(JUDGED_PX, JUDGED_MM * float(pixels_per_mm(tuple(problem.rig), origin).mean()))
    judged = []
    for i, state in enumerate(finalists):
        report("alignment", 0.7 + 0.3 * i / len(finalists))
        _, fine = _descended(problem, state, FINE)
        cost, _ = _descended(problem, fine, replace(DEEP, modes=min(DEEP.modes, len(model.modes))), close)
        judged.append((cost, fine))
    return min(judged, key=lambda pair: pair[0])[1].world_from_head


def subject_axes(rig: Rig, front: str) -> Float[np.ndarray, "3 3"]:
    """world_from_head rotation of a subject who sits upright and looks at the front camera.

    Up is the mean of the images' up: cameras around a head are mounted alike, or in mirrored pairs.
    """
    up = -np.mean([camera.camera_from_world.rotation[1] for camera in rig], axis=0)
    forward = rig[front].centre_world - rig.centre_world()
    up -= forward * (up @ forward) / (forward @ forward)
    y, z = up / np.linalg.norm(up), forward / np.linalg.norm(forward)
    return nearest_rotation(np.stack([np.cross(y, z), y, z], axis=1))


def head_origin(
    model: HeadModel, silhouettes: Mapping[str, Silhouette], rig: Rig, axes: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, " 3"]:
    """Where the origin of the mean head is, so that its crown and the middle of its head meet the visual hull's."""
    line = np.arange(-REACH_MM, REACH_MM + 1, SPACING_MM)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)  # along the head's axes
    points = rig.centre_world() + grid @ axes.T
    inside, seen = np.ones(len(points), bool), np.zeros(len(points), int)
    for camera in rig:
        silhouette = silhouettes.get(camera.name)
        if silhouette is None or not silhouette.quality.usable:
            continue
        pixels = camera.project(points)
        k = camera.intrinsics
        with np.errstate(invalid="ignore"):
            framed = ((pixels >= 0) & (pixels <= (k.width - 1, k.height - 1))).all(axis=1)
        at = np.rint(pixels[framed]).astype(int)
        inside[framed] &= silhouette.distance[at[:, 1], at[:, 0]] < 0
        seen += framed
    hull = grid[inside & (seen >= max(2.0, SEEN_SHARE * seen.max()))]
    if len(hull) < 10:
        raise NoSubject
    mean = model.vertices(np.zeros(0), "p95")
    crown = hull[:, 1].max()
    in_slab = (hull[:, 1] < crown - HEAD_SLAB_MM[0]) & (hull[:, 1] > crown - HEAD_SLAB_MM[1])
    slab = hull[in_slab] if in_slab.any() else hull
    model_slab = mean[
        (mean[:, 1] < mean[:, 1].max() - HEAD_SLAB_MM[0]) & (mean[:, 1] > mean[:, 1].max() - HEAD_SLAB_MM[1])
    ]
    middle = (slab.min(axis=0) + slab.max(axis=0)) / 2 - (model_slab.min(axis=0) + model_slab.max(axis=0)) / 2
    height = crown + SPACING_MM / 2 - HAIR_MM - mean[:, 1].max()
    return rig.centre_world() + axes @ np.array([middle[0], height, middle[2]])


def turned(start: Similarity, yaw_deg: float, pitch_deg: float) -> Similarity:
    """The head turned about its own origin, first nodding and then about the upright axis."""
    turn = rotation_from_vector(np.radians([0.0, yaw_deg, 0.0])) @ rotation_from_vector(
        np.radians([pitch_deg, 0.0, 0.0])
    )
    return replace(start, rotation=start.rotation @ turn)


def _descended(
    problem: ContourProblem, state: State, stage: Stage, judged_px: float = RANKED_PX
) -> tuple[float, State]:
    evidence = first_evidence(problem.settings)
    state, _, _ = run_stage(problem, evidence, state, stage, lambda fraction: None)
    return head_problem(problem, evidence, stage, judged_px, REFERENCE_PX).at(state).cost, state
