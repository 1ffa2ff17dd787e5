"""Runs the face networks on a frame, in the cameras that see the face best, and returns landmarks and how far the lids
are open.

The networks search the face where the previous frames predict it. The frames from which the person was estimated also
give the networks' bias for each landmark in each camera, and the measured lid opening of open eyes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.alignment.face_alignment import spread_points
from pipeline.applications.moments.appearance import LID_MM, lid_motion_mm
from pipeline.applications.moments.footage import Pictures
from pipeline.applications.moments.sequence_person import Motion, SequencePerson
from pipeline.applications.moments.track_frame import POSE, derivatives
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import Linear, Residuals, Term
from pipeline.faces.detection import MIN_SCORE, FaceDetection, crop_around, in_picture, make_pyramid
from pipeline.faces.eyes import LIDS, LOWER, UPPER, find_eyes, opening_of
from pipeline.faces.landmark_map import landmark_map
from pipeline.faces.networks import LANDMARK_SIZE, FaceNetworks
from pipeline.faces.points import RIGHT_EYE_OUTLINE, direction_from_face, point_table
from pipeline.geometry.projection import project_points
from pipeline.head_model.expressions import BLINKS, plain_name
from rig.geometry import Similarity
from rig.rig import Rig

VIEWS = 3  # in which the networks search
MIN_FACING = 0.5  # cosine between where a face looks and the camera
CLOSED_OPENING = 0.045  # of lids that meet, as ``faces.eyes`` measures it on drawn heads and on people
CLOSURE_SIGMA = 0.1  # of a closure, 0 to 1, by one frame: 0.05 on drawn heads
ALIKE = 12.0  # number of landmarks with correlated errors
FORGIVEN = 3.0  # deviations of a landmark
MIN_SIGMA_PX = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Holds the networks' results in a frame: pixels of the 468 landmarks by camera, and the lid opening by eye."""

    pixels: Mapping[str, Float[np.ndarray, "468 2"]]
    openings: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class FaceReference:
    """Holds the landmarks' positions on the person's head, and statistics of the networks' results on this person."""

    which: Int[np.ndarray, " n"]  # of the 468
    neutral: Float[np.ndarray, "n 3"]
    shapes: Float32[np.ndarray, "n 3 e"]
    bias: Mapping[str, Float[np.ndarray, "n 2"]]  # by camera, px
    sigma_px: float
    open: Mapping[str, float]  # opening of each eye when it is open
    closing: Mapping[str, Float[np.ndarray, " e"]]  # by side: how far each expression closes the eye; a blink is 1

    def points(self, weights: Float[np.ndarray, " e"]) -> Float[np.ndarray, "n 3"]:
        """Returns the landmarks for given expression weights, head frame, mm."""
        return self.neutral + self.shapes @ weights.astype(np.float32)


def sight(
    person: SequencePerson,
    networks: FaceNetworks,
    pictures: Pictures,
    motion: Motion,
    views: int = VIEWS,
    *,
    eyes: int | None = None,
    points: Float[np.ndarray, "468 3"] | None = None,
) -> Sighting:
    """Searches the face where ``motion`` predicts it, in the ``views`` cameras that see it best, and measures the lids
    in the first ``eyes`` of these cameras (None: in all). ``points`` are the predicted landmarks, if known (world, mm).
    """
    placed = Similarity.from_rigid(motion.world_from_head)
    facing = {
        name: float(direction_from_face(placed, person.rig[name])[2]) for name in person.rig.names if name in pictures
    }
    best = sorted((name for name in facing if facing[name] > MIN_FACING), key=lambda name: -facing[name])[:views]
    points = placed.apply(landmarks_of(person, motion.weights)) if points is None else points
    pixels, openings = dict[str, np.ndarray](), dict[str, list[float]]()
    for name in best:
        camera = person.rig[name]
        expected = camera.project(points)
        if not np.isfinite(expected).all():
            continue
        pyramid, crop = make_pyramid(pictures[name]), crop_around(expected)
        found, score = networks.place_landmarks(pyramid.sample(crop, LANDMARK_SIZE))
        if score < MIN_SCORE:
            continue
        pixels[name] = in_picture(found[:, :2], crop.picture_from_crop(LANDMARK_SIZE))
        if eyes is not None and len(pixels) > eyes:
            continue
        box = np.concatenate([pixels[name].min(axis=0), pixels[name].max(axis=0)])
        face = find_eyes(pyramid, FaceDetection(pixels[name], score, box, crop.roll_deg), networks)
        assert face.lids_px is not None
        direction = direction_from_face(placed, camera)
        for side, rows in LIDS.items():
            openings.setdefault(side, []).append(opening_of(face.lids_px[rows], direction))
    return Sighting(pixels, {side: float(np.median(of)) for side, of in openings.items()})


def landmarks_of(person: SequencePerson, weights: Float[np.ndarray, " e"]) -> Float[np.ndarray, "468 3"]:
    """Returns the 468 landmarks for given expression weights, head frame, mm."""
    places = landmark_map(person.model)
    rows = np.unique(places.rows)
    vertices = np.zeros_like(person.neutral)
    vertices[rows] = person.neutral[rows] + np.tensordot(weights.astype(np.float32), person.shapes[:, rows], axes=1)
    return places.points(vertices)


def refer(person: SequencePerson, networks: FaceNetworks, shown: Iterable[tuple[Pictures, Motion]]) -> FaceReference:
    """Computes the networks' statistics from their results in frames with known motions."""
    places = landmark_map(person.model)
    which = spread_points(places)
    still = places.points(np.repeat(lid_motion_mm(person)[:, None], 3, axis=1))[which, 0] < LID_MM
    which = which[still]
    corners, blend = places.rows[which], places.weights[which]
    shapes = np.einsum("nk,enkc->nce", blend.astype(np.float32), person.shapes[:, corners], optimize=True)
    neutral = np.einsum("nk,nkc->nc", blend, person.neutral[corners])
    off, openings = dict[str, list[np.ndarray]](), dict[str, list[float]]()
    for pictures, motion in shown:
        found = sight(person, networks, pictures, motion, len(person.rig))
        world = motion.world_from_head.apply(neutral + shapes @ motion.weights.astype(np.float32))
        for name, pixels in found.pixels.items():
            off.setdefault(name, []).append(pixels[which] - person.rig[name].project(world))
        for side, opening in found.openings.items():
            openings.setdefault(side, []).append(opening)
    bias = {name: np.mean(of, axis=0) for name, of in off.items()}
    left = [each - bias[name] for name, of in off.items() if len(of) > 1 for each in of]
    sigma = float(np.std(left)) if left else 2.0
    wide = {side: float(np.quantile(of, 0.75)) for side, of in openings.items()}
    return FaceReference(which, neutral, shapes, bias, max(sigma, MIN_SIGMA_PX), wide, closing_of(person))


def closing_of(person: SequencePerson) -> dict[str, Float[np.ndarray, " e"]]:
    """Returns, for each eye, how much each expression closes it, relative to a full blink. An eye for which the head
    model has no blink is left out."""
    places, right = landmark_map(person.model), np.array(RIGHT_EYE_OUTLINE)
    outline = {"right": right, "left": point_table().mirror_images[right]}
    names, found = [plain_name(name) for name in person.names], {}
    for side, rows in outline.items():
        corners, blend = places.rows[rows], places.weights[rows]
        moved = np.einsum("nk,enkc->enc", blend, person.shapes[:, corners], optimize=True)
        gap = (moved[:, UPPER, 1] - moved[:, LOWER, 1]).mean(axis=1)
        blink = [k for k, name in enumerate(names) if BLINKS.get(name) == side and name.startswith("eyeBlink")]
        if blink and gap[blink[0]] < 0.0:
            found[side] = gap / gap[blink[0]]
    return found


def terms_of(reference: FaceReference, rig: Rig, found: Sighting) -> Sequence[Term[Motion]]:
    """Returns the cost terms of the networks' landmarks and lid openings in a frame."""
    terms: list[Term[Motion]] = []
    seen = {name: pixels[reference.which] for name, pixels in found.pixels.items()}
    if seen:
        terms.append(LandmarkTerm(reference, rig, seen))
    sides = [side for side in found.openings if side in reference.closing and side in reference.open]
    if sides:
        closure = [
            (reference.open[side] - found.openings[side]) / max(reference.open[side] - CLOSED_OPENING, 0.05)
            for side in sides
        ]
        columns = np.stack([reference.closing[side] for side in sides]) / CLOSURE_SIGMA
        terms.append(LidTerm(columns, np.clip(closure, 0.0, 1.0) / CLOSURE_SIGMA))
    return terms


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkTerm:
    """Computes the cost of the detected landmark pixels after the networks' bias has been removed."""

    reference: FaceReference
    rig: Rig
    pixels: Mapping[str, Float[np.ndarray, "n 2"]]

    def at(self, motion: Motion) -> Residuals:
        """Returns the residuals between projected and detected landmarks, in standard deviations."""
        pose, reference = motion.world_from_head, self.reference
        world = pose.apply(reference.points(motion.weights))
        none, sigma = np.zeros((len(world), 2)), reference.sigma_px * np.sqrt(ALIKE)
        off = [
            (project_points(self.rig[name], world) + reference.bias.get(name, none) - pixels) / sigma
            for name, pixels in self.pixels.items()
        ]

        def jacobian() -> Float32[np.ndarray, "n 2 p"]:
            blocks = []
            for name in self.pixels:
                _, slopes = self.rig[name].project_with_jacobian(world)
                axes = [derivatives(slopes[:, k] / sigma, world, pose, reference.shapes) for k in range(2)]
                blocks.append(np.stack(axes, axis=1))
            return np.concatenate(blocks)

        return Residuals(np.concatenate(off), jacobian, GemanMcClure(FORGIVEN / np.sqrt(ALIKE)))


@dataclass(frozen=True, slots=True, eq=False)
class LidTerm:
    """Computes the cost of the eyes' closures, which are linear in the expression weights."""

    columns: Float[np.ndarray, "s e"]
    observed: Float[np.ndarray, " s"]

    def at(self, motion: Motion) -> Residuals:
        """Returns the residuals between modelled and observed closures, in standard deviations."""
        whole = np.concatenate([np.zeros((len(self.observed), POSE)), self.columns], axis=1)
        return Linear(whole, self.observed).at(np.concatenate([np.zeros(POSE), motion.weights]))
