"""Aligns the head without feature points or a detected face, which the paper leaves open (section 6).

The input is silhouettes, the rig, and the camera that the subject probably faces. The output is world_from_head of the
mean head, and how much higher the cost of the best other pose is.

The crown and the centre of the subject's head are estimated from the visual hull. The downward direction is where the
body leaves the pictures. If the body leaves no picture, or the views disagree, every quarter turn about the line of
sight is tried. If the cameras surround the subject, the camera in front of the face is unknown, and every direction is
tried. The search does not depend on the axes of the world frame. From each start the contour solver fits the pose and a
few modes on the coarsest mesh, and the best few poses continue on a finer mesh. The chosen pose is the one with the
least cost after all eigenheads are fitted: under thick hair, 15 modes cannot distinguish the right pose from one with
an error of 50 degrees. Under hair, a start with an error of 10 mm would end in a local minimum
(tests/laboratory/notes/robustness.md), so the scale of the robust loss begins at 40 px."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.contour import run_stage
from pipeline.contour_fit.head_problem import build_head_problem
from pipeline.contour_fit.problem import ContourProblem, Stage, State, first_evidence, make_problem, start_state
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.photometric_fit.depth_search import pixels_per_mm
from pipeline.settings import Settings
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.geometry import Similarity, nearest_rotation, rotation_from_vector
from rig.messages.message import compose
from rig.progress import Progress
from rig.rig import Rig

SPACING_MM, REACH_MM = 12.0, 264.0  # step and half width of the hull's grid about the rig's centre
HEAD_SLAB_MM = (30.0, 150.0)  # below the crown: cranium and face, above any shoulder
HAIR_MM = 12.0  # height that typical hair adds to the crown
YAWS_DEG, PITCHES_DEG = (-40.0, -20.0, 0.0, 20.0, 40.0), (-15.0, 0.0, 15.0)
YAWS_AROUND_DEG = tuple(np.arange(-180.0, 180.0, 30.0).tolist())
ROLLS_DEG = (0.0, 90.0, 180.0, -90.0)
FINALISTS, MANY_FINALISTS = 4, 8  # of starts about one guess, and of starts all around
SAME_POSE_DEG, OTHER_POSE_DEG = 10.0, 20.0  # poses nearer than the first are one, beyond the second they are rivals
MIN_AGREEMENT = 0.5  # of the borders where the body leaves the pictures: 1 where all say the same
MIN_FAN = 0.3  # fan strength: a full ring of cameras has 0, half a circle 0.64
COARSE = Stage("p99", 6, False, (40.0, 20.0, 10.0), False, True, 4)
FINE = Stage("p95", 15, False, (20.0, 10.0, 6.0), False, True, 4)
DEEP = Stage("p95", 60, True, (6.0, 4.0, 2.0), False, True, 4)
SEEN_SHARE = 0.6  # of the cameras that see the best seen point: with fewer cameras, the hull is not carved
RANKED_PX = 6.0  # robust scale at which coarse fits are compared
JUDGED_PX, JUDGED_MM = 2.0, 1.0  # and finalists, whichever is the larger: a right pose explains much of the outline
# closely, a wrong one nearly all of it badly, which 6 px took for better in one of fifty draws
REFERENCE_PX = 3000.0  # outline length to which costs are scaled, so that a hidden rim does not lower them


class NoSubject(EigenheadError):
    """Reports that the silhouettes have no common volume near the centre of the rig."""

    def __init__(self) -> None:
        super().__init__(compose("no-subject"))


@dataclass(frozen=True, slots=True)
class FoundPose:
    """Holds the pose that the search chose. ``rival`` is the additional cost of the best pose in another direction,
    relative to the chosen pose's cost; None if there is no other pose."""

    world_from_head: Similarity
    rival: float | None


def search_alignment(
    model: HeadModel,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: Settings,
    *,
    front: str,
    stated: bool = False,
    report: Progress,
) -> FoundPose:
    """Finds the pose of the mean head from the silhouettes alone. ``stated`` means that the user named the ``front``
    camera. Raises NoSubject if the silhouettes have no common volume."""
    starts = list(start_poses(model, silhouettes, rig, front, stated=stated))
    problem = make_problem(model, starts[0], silhouettes, rig, settings.fitting, {}, levels=("p99", "p95"))
    found = []
    for i, start in enumerate(starts):
        report("alignment", 0.7 * i / len(starts))
        found.append(_descended(problem, start_state(problem, start), COARSE))
    finalists = [state for _, state in sorted(found, key=lambda pair: pair[0])[:FINALISTS]]
    if len(starts) > len(YAWS_DEG) * len(PITCHES_DEG):
        finalists = _differently_turned([state for _, state in sorted(found, key=lambda pair: pair[0])])
    close = max(JUDGED_PX, JUDGED_MM * float(pixels_per_mm(tuple(problem.rig), starts[0].translation).mean()))
    judged = []
    for i, state in enumerate(finalists):
        report("alignment", 0.7 + 0.3 * i / len(finalists))
        _, fine = _descended(problem, state, FINE)
        cost, _ = _descended(problem, fine, replace(DEEP, modes=min(DEEP.modes, len(model.modes))), close)
        judged.append((cost, fine.world_from_head))
    least, best = min(judged, key=lambda pair: pair[0])
    others = [cost for cost, pose in judged if turn_between_deg(pose, best) > OTHER_POSE_DEG]
    return FoundPose(best, min(others) / least - 1.0 if others and least > 0 else None)


def moved_to_hull(
    pose: Similarity, camera: Camera, model: HeadModel, silhouettes: Mapping[str, Silhouette], rig: Rig
) -> Similarity:
    """Returns the pose moved along the camera's line of sight into the visual hull, and scaled so that its image in the
    camera does not change. The function serves poses whose distance from the camera is unknown. Raises NoSubject."""
    origin = head_origin(model, silhouettes, rig, pose.rotation)
    along = pose.translation - camera.centre_world
    share = float((origin - camera.centre_world) @ along / (along @ along))
    return Similarity(share * pose.scale, pose.rotation, camera.centre_world + share * along)


def start_poses(
    model: HeadModel, silhouettes: Mapping[str, Silhouette], rig: Rig, front: str, *, stated: bool
) -> Iterator[Similarity]:
    """Yields the poses from which the search starts: upright, or in quarter turns if the upward direction is unknown;
    facing the front camera, or in all directions if this camera is unknown."""
    forward = rig[front].centre_world - rig.centre_world()
    up = body_up(silhouettes, rig)
    pictures_up = -np.mean([camera.camera_from_world.rotation[1] for camera in rig], axis=0)
    axes = upright_axes(pictures_up if up is None else up, forward)
    surrounded = not stated and fan_strength(rig) < MIN_FAN
    rolls = (0.0,) if up is not None else ROLLS_DEG
    for roll in rolls:
        turn = rotation_from_vector(np.radians([0.0, 0.0, roll]))
        rolled = axes @ turn
        first = Similarity(1.0, rolled, head_origin(model, silhouettes, rig, rolled))
        for yaw, pitch in product(YAWS_AROUND_DEG if surrounded else YAWS_DEG, PITCHES_DEG):
            yield turned(first, yaw, pitch)


def upright_axes(up_world: Float[np.ndarray, " 3"], forward_world: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Returns the world_from_head rotation of a subject who sits upright and looks forward."""
    up = up_world - forward_world * (up_world @ forward_world) / (forward_world @ forward_world)
    y, z = up / np.linalg.norm(up), forward_world / np.linalg.norm(forward_world)
    return nearest_rotation(np.stack([np.cross(y, z), y, z], axis=1))


def body_up(silhouettes: Mapping[str, Silhouette], rig: Rig) -> Float[np.ndarray, " 3"] | None:
    """Returns the upward direction (unit vector, world frame), opposite to the direction in which the body leaves the
    pictures. Returns None if the body leaves no picture, or if the views disagree."""
    total, weight = np.zeros(3), 0.0
    for camera in rig:
        silhouette = silhouettes.get(camera.name)
        if silhouette is None or not silhouette.quality.usable:
            continue
        mask = silhouette.mask
        crossed = {(-1.0, 0.0): mask[:, 0], (1.0, 0.0): mask[:, -1], (0.0, -1.0): mask[0], (0.0, 1.0): mask[-1]}
        for (right, down), border in crossed.items():
            share = float(border.mean())
            total += share * (np.array([right, down, 0.0]) @ camera.camera_from_world.rotation)
            weight += share
    if weight == 0.0 or np.linalg.norm(total) < MIN_AGREEMENT * weight:
        return None
    return -total / np.linalg.norm(total)


def fan_strength(rig: Rig) -> float:
    """Returns how one-sided the cameras surround the subject: 1 if all are on the same side, 0 if they are evenly
    distributed."""
    directions = np.stack([camera.centre_world for camera in rig]) - rig.centre_world()
    return float(np.linalg.norm((directions / np.linalg.norm(directions, axis=1, keepdims=True)).mean(axis=0)))


def turn_between_deg(one: Similarity, other: Similarity) -> float:
    """Returns the angle (degrees) between the rotations of two poses."""
    cosine = (np.trace(one.rotation.T @ other.rotation) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _differently_turned(states: Sequence[State]) -> list[State]:
    """Returns at most ``MANY_FINALISTS`` states, best first, whose rotations differ from each other by more than
    ``SAME_POSE_DEG``."""
    chosen: list[State] = []
    for state in states:
        if all(turn_between_deg(state.world_from_head, other.world_from_head) > SAME_POSE_DEG for other in chosen):
            chosen.append(state)
        if len(chosen) == MANY_FINALISTS:
            break
    return chosen


def head_origin(
    model: HeadModel, silhouettes: Mapping[str, Silhouette], rig: Rig, axes: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, " 3"]:
    """Returns the position (world frame, mm) of the mean head's origin at which its crown and centre match those of the
    subject's head in the visual hull. Raises NoSubject."""
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
    """Returns the pose after a rotation of the head in its frame: by yaw about its vertical axis, and by the pitch."""
    turn = rotation_from_vector(np.radians([0.0, yaw_deg, 0.0])) @ rotation_from_vector(
        np.radians([pitch_deg, 0.0, 0.0])
    )
    return replace(start, rotation=start.rotation @ turn)


def _descended(
    problem: ContourProblem, state: State, stage: Stage, judged_px: float = RANKED_PX
) -> tuple[float, State]:
    evidence = first_evidence(problem.settings)
    state, _, _ = run_stage(problem, evidence, state, stage, lambda fraction: None)
    return build_head_problem(problem, evidence, stage, judged_px, REFERENCE_PX).at(state).cost, state
