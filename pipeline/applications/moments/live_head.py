"""Tracks the head of a person in front of the cameras from face landmarks in small pictures; speed matters more than
precision.

The input is the current picture of each camera and the previous head. The output is the head's pose, its expression and
its landmarks in each camera.

In the first pictures, the face is searched in all views, and the head model is fitted to the triangulated landmarks.
The fitted head has the form of a recorded sequence's head (``sequence_person``), without outlines and texture. In later
pictures the network searches at the previous position, and the cost terms of ``face_evidence`` fit pose and weights,
starting from the previous values. If the head has moved far, the network searches again at the new position."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from pipeline.alignment.face_alignment import align_to_face
from pipeline.applications.moments.face_evidence import FaceReference, Sighting, refer, sight, terms_of
from pipeline.applications.moments.sequence_person import Motion, SequencePerson, tracked_names
from pipeline.applications.moments.track_frame import POSE, WeightPrior, after, room
from pipeline.contour_fit.head_problem import apply_step
from pipeline.contour_fit.landmark_term import LandmarkTerm
from pipeline.contour_fit.prior_term import LOG_SCALE, SCALE_SPREAD
from pipeline.contour_fit.problem import PER_CAMERA, LandmarkObservations, Stage, State
from pipeline.contour_fit.problem import POSE as POSE_WITH_SCALE
from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.terms import Problem, Residuals
from pipeline.faces.landmark_map import landmark_map
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.networks import LANDMARKS, FaceNetworks
from pipeline.faces.points import direction_from_face
from pipeline.geometry.projection import project_points
from pipeline.head_model.model import HeadModel
from rig.capture import ImageRgb
from rig.geometry import RigidTransform, Similarity, vector_from_rotation
from rig.rig import Rig

MODES = 40  # of the shape; landmarks do not determine finer modes
SHAPE_LIMITS, MOTION_LIMITS = Limits(8, 0.1), Limits(4, 0.05)
MIN_VIEWS = 2
EYES = 3  # cameras in which lids are measured
LOOKS = 3  # searches for one set of pictures, each from the previous result
FAR_DEG, FAR_MM = 4.0, 12.0  # of a motion: a crop so far off misplaces the landmarks
COARSE = 8.0  # of the landmarks' deviation, for a head that may have moved far
OPEN = 0.18  # an open eye's opening, at least (``faces.eyes``): the first look may have met closed ones
MAX_MISFIT = 0.08  # RMS by the face's size in the picture: beyond it the landmarks are another face's
NEAR = 0.03  # the same of a head that has hardly moved, in every camera
MESH = "p99"  # the mesh that is displayed


@dataclass(frozen=True, slots=True, eq=False)
class LivePerson:
    """Holds everything that does not change over time: the person, the head's ``scale`` relative to the head model,
    reference values of the networks, and a small mesh and the 468 landmarks with their expressions (head frame, mm)."""

    person: SequencePerson
    scale: float
    reference: FaceReference
    points: Float[np.ndarray, "n 3"]
    shapes: Float[np.ndarray, "e n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class LiveHead:
    """Holds the tracked head in the current pictures.

    Attributes:
        who: the person.
        motion: pose and weights.
        sighting: pixels of the landmarks by camera, and the openings of the lids.
        facing: cosine between the direction of the face and that to each camera.
        strangers: cameras in which the detected landmarks belong to another head.
        points_world: the vertices of the small mesh, then the 468 landmarks (mm).
    """

    who: LivePerson
    motion: Motion
    sighting: Sighting
    facing: Mapping[str, float]
    strangers: tuple[str, ...]
    points_world: Float[np.ndarray, "n 3"]

    @property
    def vertices_world(self) -> Float[np.ndarray, "v 3"]:
        """Returns the vertices of the small mesh (world frame, mm)."""
        return self.points_world[:-LANDMARKS]

    @property
    def landmarks_world(self) -> Float[np.ndarray, "468 3"]:
        """Returns the 468 landmarks on the head (world frame, mm)."""
        return self.points_world[-LANDMARKS:]


def meet(
    model: HeadModel, face: MatchedFaces, pictures: Mapping[str, ImageRgb], rig: Rig, networks: FaceNetworks
) -> LiveHead | None:
    """Builds the head of a person whose face was detected in the pictures. Returns None if a second detection fails."""
    alignment = align_to_face(model, face, landmark_map(model))
    state = _shaped(alignment.landmarks, alignment.world_from_head, min(MODES, len(model.modes)))
    scale, names = state.world_from_head.scale, tracked_names(model)
    operator, rows = model.levels["full"].operator, [model.expressions.names.index(name) for name in names]
    shapes = np.stack([scale * (operator @ model.expressions.shapes[row]) for row in rows]).astype(np.float32)
    pose = RigidTransform(state.world_from_head.rotation, state.world_from_head.translation)
    motion = Motion(pose, np.zeros(len(names)))
    neutral = scale * model.vertices(state.coefficients)
    person = SequencePerson(model, names, neutral, shapes, rig, (0,), (motion,))
    reference = refer(person, networks, [(pictures, motion)])
    if len(reference.bias) < MIN_VIEWS:
        return None
    reference = replace(reference, open={side: max(opening, OPEN) for side, opening in reference.open.items()})
    coarse, places = model.levels[MESH].rows, landmark_map(model)
    points = np.concatenate([neutral[coarse], places.points(neutral)])
    moved = np.stack([np.concatenate([shape[coarse], places.points(shape)]) for shape in shapes])
    who = LivePerson(person, scale, reference, points, moved)
    return follow(LiveHead(who, motion, Sighting({}, {}), {}, (), pose.apply(points)), pictures, networks)


def _shaped(observed: LandmarkObservations, start: Similarity, modes: int) -> State:
    """Fits the head model's first modes and its pose to triangulated face landmarks."""
    stage = Stage("full", modes, False, (), False, False, 0)
    rows = np.eye(modes + 1, modes + POSE_WITH_SCALE)
    rows[modes, [modes, modes + LOG_SCALE]] = 0.0, 1.0 / SCALE_SPREAD
    terms = (LandmarkTerm(observed, stage, 0), ShapePrior(rows))
    problem = Problem(terms, modes + POSE_WITH_SCALE, partial(apply_step, stage=stage))
    return minimise(problem, State(np.zeros(modes), start, np.zeros((0, PER_CAMERA))), SHAPE_LIMITS).value


@dataclass(frozen=True, slots=True, eq=False)
class ShapePrior:
    """Computes the prior of shape coefficients and scale, like ``contour_fit.prior_term``."""

    rows: Float[np.ndarray, "n p"]  # by coefficients and pose, in deviations

    def at(self, state: State) -> Residuals:
        """Returns the coefficients, and the logarithm of scale divided by its standard deviation."""
        residual = np.append(state.coefficients, np.log(state.world_from_head.scale) / SCALE_SPREAD)
        return Residuals(residual[:, None], lambda: self.rows[:, None])


def follow(head: LiveHead, pictures: Mapping[str, ImageRgb], networks: FaceNetworks) -> LiveHead | None:
    """Returns the same person's head in the next pictures. Returns None if the head is not found in these pictures."""
    who, person = head.who, head.who.person
    motion, points, found, strangers = head.motion, head.points_world, head.sighting, tuple[str, ...]()
    for _ in range(LOOKS):
        before = motion
        found = sight(person, networks, pictures, before, len(person.rig), eyes=EYES, points=points[-LANDMARKS:])
        if len(found.pixels) < MIN_VIEWS:
            return None
        motion = _fitted(who, found, before)
        points = motion.world_from_head.apply(who.points + np.tensordot(motion.weights, who.shapes, axes=1))
        theirs = {name for name, misfit in _misfits(who, found, motion).items() if misfit < MAX_MISFIT}
        if len(theirs) < MIN_VIEWS:
            return None
        strangers = tuple(name for name in found.pixels if name not in theirs)
        if not _moved_far(before, motion):
            break
    seen = {name: pixels for name, pixels in found.pixels.items() if name not in strangers}
    placed = Similarity.from_rigid(motion.world_from_head)
    facing = {camera.name: float(direction_from_face(placed, camera)[2]) for camera in person.rig}
    return LiveHead(who, motion, replace(found, pixels=seen), facing, strangers, points)


def _fitted(who: LivePerson, found: Sighting, start: Motion) -> Motion:
    rig, motion = who.person.rig, start
    near = max(_misfits(who, found, start).values()) < NEAR
    for loose in (1.0,) if near else (COARSE, 1.0):
        reference = replace(who.reference, sigma_px=loose * who.reference.sigma_px)
        terms = (*terms_of(reference, rig, found), WeightPrior())
        problem = Problem(terms, POSE + len(start.weights), after, room=room)
        motion = minimise(problem, motion, MOTION_LIMITS).value
    return motion


def _misfits(who: LivePerson, found: Sighting, motion: Motion) -> dict[str, float]:
    """Returns, by camera, the RMS distance between detected and projected landmarks, relative to the face's size."""
    reference, misfits = who.reference, {}
    world = motion.world_from_head.apply(reference.points(motion.weights))
    for name, pixels in found.pixels.items():
        shown = pixels[reference.which]
        off = shown - project_points(who.person.rig[name], world) - reference.bias.get(name, 0.0)
        misfits[name] = float(np.sqrt((off**2).sum(axis=1).mean()) / np.ptp(shown, axis=0).max())
    return misfits


def _moved_far(before: Motion, motion: Motion) -> bool:
    was, now = before.world_from_head, motion.world_from_head
    turn_deg = float(np.degrees(np.linalg.norm(vector_from_rotation(now.rotation @ was.rotation.T))))
    return turn_deg > FAR_DEG or float(np.linalg.norm(now.translation - was.translation)) > FAR_MM
