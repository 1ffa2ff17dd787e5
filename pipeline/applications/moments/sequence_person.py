"""Estimates the head of the person in a sequence jointly from several frames of the first second.

The module's input is the sequence's footage. The output is the neutral head, the displacements of its vertices by each
expression, the corrected cameras, and the pose and weights in each frame used."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from pipeline.applications.moments.footage import Footage
from pipeline.applications.moments.joint_fit import fit_jointly
from pipeline.applications.moments.take import name_errors, solution_of
from pipeline.contour_fit.contour import ContourSolution
from pipeline.estimation.bounded import least_within
from pipeline.head_model.expressions import arkit_parts
from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import start_reconstruction
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.recorder import Recorder
from rig.errors import Cancelled, EigenheadError
from rig.geometry import RigidTransform
from rig.messages.message import Message
from rig.render.renderer import Renderer
from rig.rig import Rig

RIDGE = 1e-3  # of the mean diagonal: shapes that are alike share
FIRST_S, KEYS = 1.0, 5  # the identity's frames: the sharpest of each fifth of the first second


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Holds the values that change from frame to frame: the head's pose and its expression weights; the head's scale is
    contained in its vertices."""

    world_from_head: RigidTransform
    weights: Float[np.ndarray, " e"]


@dataclass(frozen=True, slots=True, eq=False)
class SequencePerson:
    """Holds the head of a person in a sequence. Vertices and shapes belong to the head model's finest mesh, head frame,
    mm; ``rig`` holds the corrected cameras of the reduced pictures."""

    model: HeadModel
    names: tuple[str, ...]  # of the expressions that are tracked: the model's for Apple's names
    neutral: Float[np.ndarray, "v 3"]
    shapes: Float32[np.ndarray, "e v 3"]  # mm at weight 1
    rig: Rig
    keys: tuple[int, ...]  # frames from which the identity was estimated ...
    motions: tuple[Motion, ...]  # ... and the head's motion in them
    warnings: tuple[Message, ...] = ()  # of these frames' fits, one of each code

    def head(self, weights: Float[np.ndarray, " e"]) -> Float[np.ndarray, "v 3"]:
        """Returns the vertices of the head for given expression weights."""
        return self.neutral + np.tensordot(weights.astype(np.float32), self.shapes, axes=1)


def find_person(
    footage: Footage, model: HeadModel, settings: Settings, renderer: Renderer, report: Callable[[float], None]
) -> SequencePerson:
    """Estimates one head jointly from the best frames of the first second; frames that show no head are left out.
    Raises the first frame's error if no frame shows a head, and InputError for the method simplex."""
    keys, solved, refused = best_frames(footage), dict[int, ContourSolution](), list[EigenheadError]()
    warnings: dict[str, Message] = {}
    for done, key in enumerate(keys):
        report(done / (len(keys) + 1))
        try:
            with name_errors(footage.frames[key]), footage.capture(key) as (capture, rig):
                context = ReconstructionContext(capture, rig, model, settings, renderer)
                run = Recorder(context)
                steps = start_reconstruction(context, run)
                solved[key] = solution_of(next(steps))
                steps.close()
            warnings = {each.code: each for each in run.warnings} | warnings
        except Cancelled:
            raise
        except EigenheadError as error:
            refused.append(error)
    if not solved:
        raise refused[0]
    report(len(keys) / (len(keys) + 1))
    alone = tuple(solved.values())
    joint = fit_jointly(alone, min(settings.fitting.modes, len(model.modes))) if len(alone) > 1 else alone
    return replace(person_of(footage, model, tuple(solved), joint), warnings=tuple(warnings.values()))


def best_frames(footage: Footage) -> tuple[int, ...]:
    """Returns the sharpest frame of each equal part of the first second."""
    count = int(np.searchsorted(footage.times_s, footage.times_s[0] + FIRST_S, side="right"))
    sharpness = []
    for number, pictures in zip(range(count), footage.read(), strict=False):
        edges = [float(np.abs(np.diff(image[::4].astype(np.int16), axis=1)).mean()) for image in pictures.values()]
        sharpness.append(np.mean(edges) if len(pictures) == len(footage.rig) else -float(number))
    parts = np.array_split(np.arange(len(sharpness)), min(KEYS, len(sharpness)))
    return tuple(int(part[np.argmax(np.array(sharpness)[part])]) for part in parts)


def person_of(
    footage: Footage, model: HeadModel, keys: tuple[int, ...], joint: tuple[ContourSolution, ...]
) -> SequencePerson:
    """Builds the person from the joint solutions of the frames ``keys``."""
    longest = max(joint, key=lambda each: len(each.state.coefficients))
    fitted, scale = longest.problem.model, longest.state.world_from_head.scale
    coefficients = longest.state.coefficients.copy()
    coefficients[np.asarray(fitted.posed, int)] = 0.0
    operator, names = model.levels["full"].operator, tracked_names(model)
    rows = [model.expressions.names.index(name) for name in names]
    shapes = np.stack([scale * (operator @ shape) for shape in model.expressions.shapes]).astype(np.float32)
    motions = []
    for each in joint:
        pose, posed = each.state.world_from_head, each.problem.model.posed
        weights = np.clip(each.state.coefficients[posed.start : posed.stop], 0.0, 1.0)
        weights = weights_alone(shapes[:, model.levels["full"].face_region], weights, rows)
        motions.append(Motion(RigidTransform(pose.rotation, pose.translation), weights))
    rig = _corrected(footage.work, joint)
    return SequencePerson(model, names, scale * fitted.vertices(coefficients), shapes[rows], rig, keys, tuple(motions))


def tracked_names(model: HeadModel) -> tuple[str, ...]:
    """Returns the head model's expressions that have one of Apple's 52 names. The head model's other expressions
    largely repeat the named ones, and together they could imitate a shift of the whole head."""
    parts = arkit_parts(model.expressions.names)
    return tuple(model.expressions.names[row] for row in sorted({row for of in parts.values() for row in of}))


def weights_alone(
    shapes: Float32[np.ndarray, "n v 3"], weights: Float[np.ndarray, " n"], rows: list[int]
) -> Float[np.ndarray, " e"]:
    """Returns weights for only the shapes ``rows`` that move the head as nearly as possible like all ``weights``."""
    flat = shapes.reshape(len(shapes), -1)
    alone = flat[rows]
    matrix = (alone @ alone.T).astype(float)
    matrix += RIDGE * np.trace(matrix) / len(rows) * np.eye(len(rows))
    slope = -(alone @ (weights.astype(np.float32) @ flat)).astype(float)
    return least_within(matrix, slope, np.zeros(len(rows)), np.ones(len(rows)))


def _corrected(rig: Rig, joint: tuple[ContourSolution, ...]) -> Rig:
    """Returns the cameras after the mean correction over all frames, because the cameras do not move."""
    shifts: dict[str, list[np.ndarray]] = {name: [] for name in rig.names}
    for each in joint:
        for name, shift in zip(each.problem.views.names, each.state.camera_shift, strict=True):
            shifts[name].append(shift)
    cameras = []
    for camera in rig:
        cameras.append(camera.moved(np.mean(shifts[camera.name] or [np.zeros(6)], axis=0)))
    return replace(rig, cameras=tuple(cameras))
