"""Simulates the subjects of section 5.2: silhouettes of heads of the model without hair, with exact cameras.

Every error is the mean distance of corresponding face-region vertices in the world frame without realignment, unless an
experiment says otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.contour import finish, solve_contour
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.problem import camera_information
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.settings import FittingSettings
from rig.geometry import RigidTransform, Similarity, rotation_from_vector
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.anatomy import anatomy
from rig.studio.scene.hair import HairStyle, grow
from rig.studio.scene.worn import make_shirt

SPREAD = 0.8  # section 5.2: Gaussian within +-0.8 standard deviations
TURN, SHIFT_MM = 0.06, 8.0  # a seated subject: standard deviation of its pose
START_TURN, START_SHIFT_MM = np.radians(2.0), 4.0  # what feature points leave (tests/laboratory/notes/paper.md)


@dataclass(frozen=True, slots=True, eq=False)
class Planted:
    """Holds a head with known coefficients in a known pose, and a start pose as feature points would give it."""

    name: str
    coefficients: Float[np.ndarray, " m"]
    world_from_head: Similarity
    start: Similarity

    def vertices(self, model: HeadModel, level: str = "full") -> Float[np.ndarray, "v 3"]:
        """Returns the true vertices of a mesh level, world frame, mm."""
        return self.world_from_head.apply(model.vertices(self.coefficients, level))


def subjects_of_section_5_2(model: HeadModel, count: int = 100, seed: int = 52) -> list[Planted]:
    """Returns the subjects of section 5.2: half of them heads of the database (all their modes), half random (60
    modes)."""
    rng = np.random.default_rng(seed)
    known = rng.permutation(len(model.scores))[: count // 2]
    found = [_planted(f"database-{i:03}", np.asarray(model.scores[i], float), rng) for i in known]
    for i in range(count - len(found)):
        found.append(_planted(f"random-{i:03}", _within(rng, 60), rng))
    return found


def random_subjects(count: int, seed: int, modes: int = 60, most: float | None = SPREAD) -> list[Planted]:
    """Returns random heads of the model's span, each coefficient within ``most`` standard deviations if not None."""
    rng = np.random.default_rng(seed)
    bound = np.inf if most is None else most
    return [_planted(f"random-{i:03}", _within(rng, modes, bound), rng) for i in range(count)]


def _within(rng: np.random.Generator, modes: int, most: float = SPREAD) -> Float[np.ndarray, " m"]:
    """Gaussian coefficients, drawn again where they leave +-0.8 standard deviations, as section 5.2 says."""
    drawn = rng.standard_normal(modes)
    while (outside := np.abs(drawn) > most).any():
        drawn[outside] = rng.standard_normal(int(outside.sum()))
    return drawn


def _planted(name: str, coefficients: np.ndarray, rng: np.random.Generator) -> Planted:
    pose = Similarity(1.0, rotation_from_vector(TURN * rng.standard_normal(3)), SHIFT_MM * rng.standard_normal(3))
    turn = rotation_from_vector(START_TURN / np.sqrt(3.0) * rng.standard_normal(3))
    shift = START_SHIFT_MM / np.sqrt(3.0) * rng.standard_normal(3)
    start = Similarity(1.0, turn @ pose.rotation, pose.translation + shift)
    return Planted(name, coefficients, pose, start)


def exact(rig: Rig) -> Rig:
    """Returns the rig with calibration errors stated as zero."""
    return Rig(tuple(replace(camera, covariance=1e-12 * np.eye(6)) for camera in rig))


def binary_silhouettes(
    model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer, scale: float = 1.0
) -> dict[str, Silhouette]:
    """Returns silhouettes of masks that the renderer draws at full mesh resolution."""
    with renderer.silhouette_set(rig, model.levels["full"].faces, scale) as drawn:
        masks = drawn.masks(subject.vertices(model))
    return {name: silhouette_from_mask(mask) for name, mask in masks.items()}


def exact_silhouettes(
    model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer, finer: int = 4, level: str = "full"
) -> dict[str, Silhouette]:
    """Returns silhouettes with signed distances exact to about 0.03 px, from masks drawn ``finer`` times as large."""
    with renderer.silhouette_set(rig, model.levels[level].faces, float(finer)) as drawn:
        masks = drawn.masks(subject.vertices(model, level))
    found = {}
    for name, mask in masks.items():
        fine = silhouette_from_mask(mask).distance / finer
        size = (mask.shape[1] // finer, mask.shape[0] // finer)
        distance = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
        found[name] = Silhouette(distance < 0, distance)
    return found


def face_errors(model: HeadModel, fit: Fit, subject: Planted) -> Float[np.ndarray, "n 3"]:
    """Returns found minus true position (mm, world) of every face-region vertex."""
    region = model.levels["full"].face_region
    found = fit.world_from_head.apply(model.vertices(fit.coefficients))
    return found[region] - subject.vertices(model)[region]


def mean_error_mm(model: HeadModel, fit: Fit, subject: Planted) -> float:
    """Returns the mean distance (mm) of the face region's vertices from their true positions."""
    return float(np.linalg.norm(face_errors(model, fit, subject), axis=1).mean())


def worn_silhouettes(
    model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer, style: HairStyle, rng: np.random.Generator,
    *, strands: bool = True,
) -> dict[str, Silhouette]:  # fmt: skip
    """Returns silhouettes of the head with hair, its strands, and a shirt, as the studio dresses a subject. Without
    ``strands`` they are like masks that count a pixel from one half of coverage on: most strands are thinner."""
    head, full = model.vertices(subject.coefficients), model.levels["full"]
    body = anatomy(head, {name: head[row] for name, row in model.landmarks.items()})
    hair, worn = grow(head, body, style, rng), make_shirt(Mesh(head, full.faces), body, rng)
    pieces = [(head, full.faces), (hair.shell, hair.shell_faces)]
    pieces += [(hair.strands, hair.strand_faces)] if strands else []
    pieces += [worn] if worn is not None else []
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in pieces])
    faces = np.concatenate([faces + start for (_, faces), start in zip(pieces, starts[:-1], strict=True)])
    with renderer.silhouette_set(rig, faces) as drawn:
        masks = drawn.masks(subject.world_from_head.apply(np.concatenate([vertices for vertices, _ in pieces])))
    return {name: silhouette_from_mask(mask) for name, mask in masks.items()}


def off_by(rig: Rig, error_px: float, rng: np.random.Generator) -> Rig:
    """Returns the rig with an error in every camera's pose, drawn from the solver's prior for ``error_px``: a head in
    the middle moves by 1.3 times that along each axis of the image, RMS."""
    moved = []
    for camera in rig:
        depth = float(camera.camera_from_world.apply(rig.centre_world())[2])
        spread = 1.0 / np.sqrt(np.diag(camera_information(replace(camera, covariance=None), depth, error_px)))
        shift = spread * rng.standard_normal(6)
        motion = RigidTransform(rotation_from_vector(shift[:3]), shift[3:])
        moved.append(replace(camera, camera_from_world=motion @ camera.camera_from_world))
    return Rig(tuple(moved))


def stated(rig: Rig, error_px: float) -> Rig:
    """Returns the rig with calibration errors of ``error_px`` stated as each camera's covariance."""
    cameras = []
    for camera in rig:
        depth = float(camera.camera_from_world.apply(rig.centre_world())[2])
        information = camera_information(replace(camera, covariance=None), depth, error_px)
        cameras.append(replace(camera, covariance=np.linalg.inv(information)))
    return Rig(tuple(cameras))


def face_rows(
    model: HeadModel, coefficients: Float[np.ndarray, " m"], pose: Similarity, every: int
) -> Float[np.ndarray, "n p"]:
    """Returns d(position along a world axis) / d(coefficients, rotation, translation, log scale): three rows for every
    ``every``-th vertex of the face region, all x first."""
    region = np.flatnonzero(model.levels["full"].face_region)[::every]
    basis = model.basis("full", len(coefficients), region).astype(float)
    arms = pose.apply(model.vertices(coefficients)[region]) - pose.translation
    rows = []
    for axis in range(3):
        unit = np.broadcast_to(np.eye(3)[axis], arms.shape)
        shape = pose.scale * np.einsum("c,mvc->vm", pose.rotation[axis], basis)
        rows.append(np.concatenate([shape, np.cross(arms, unit), unit, arms[:, [axis]]], axis=1))
    return np.concatenate(rows)


def fit_contour(model: HeadModel, start: Similarity, silhouettes: Mapping, rig: Rig, settings: FittingSettings) -> Fit:
    """Fits all modes of a head to outlines alone."""
    return finish(solve_contour(model, start, silhouettes, rig, settings))
