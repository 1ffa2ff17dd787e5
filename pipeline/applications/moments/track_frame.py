"""Fits one frame of a sequence: the pose of a known head and its expression weights, starting from those of the
previous frame.

One least-squares problem combines three residuals: face landmarks, lid openings, and the difference between skin
texture and its reference (``appearance``). Landmarks find a head that moved far; texture is the most precise. The prior
of the weights is that of a job with one capture (``contour_fit.prior_term``).

    r_texture = (T_k(pi_k(R x_s(w) + t)) - reference_ks) / sigma
    r_landmark = (pi_k(R x_i(w) + t) + bias_ki - found_ki) / sigma_px
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.applications.moments.appearance import REDUCED, Appearance, Levels, Samples, Texture, textures, visible
from pipeline.applications.moments.footage import Pictures
from pipeline.applications.moments.sequence_person import Motion, SequencePerson
from pipeline.contour_fit.prior_term import EXPRESSION_MEDIAN, TAIL, weight_slope
from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.positive_definite import inverse_diagonal
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import NormalEquations, Problem, Residuals, Term
from pipeline.geometry.projection import project_points
from rig.geometry import RigidTransform, rotation_from_vector
from rig.rig import Rig

POSE = 6  # rotation (rad), translation (mm)
SCALES = {2: 6.0, 1: 3.0}  # Geman-McClure, in deviations, by how much pictures are reduced
ALIKE = 25.0  # samples with correlated errors: neighbours share pixels and the head's error
STEPS, TOLERANCE = {2: 3, 1: 4}, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class TextureTerm:
    """Computes the cost of the skin texture in all cameras."""

    samples: Samples
    rig: Rig
    images: Sequence[Texture | None]
    seen: Sequence[Int[np.ndarray, " n"]]
    appearance: Appearance
    scale: float

    def at(self, motion: Motion) -> Residuals:
        """Returns the residuals between texture and reference, in standard deviations."""
        pose, head = motion.world_from_head, self.samples.points(motion.weights)
        world, rows, parts = pose.apply(head), [], []
        sigma = np.float32(self.appearance.deviation * np.sqrt(ALIKE))
        for k, image in enumerate(self.images):
            if image is None:
                continue
            which = self.seen[k]
            values, inside = image.read(project_points(self.rig.cameras[k], world[which]))
            off = (values[:, 0] - self.appearance.reference[k, which]) / sigma
            good = inside & np.isfinite(off)
            parts.append(off[good])
            rows.append((k, which[good], values[good, 1:] / sigma))
        residual = np.concatenate(parts) if parts else np.zeros(0, np.float32)
        return Residuals(
            residual[:, None],
            lambda: self._jacobian(world, pose, rows)[:, None],
            GemanMcClure(self.scale / np.sqrt(ALIKE)),
        )

    def correlation(self, motion: Motion) -> float:
        """Returns the correlation of the texture with its reference over all samples; 0 without any sample."""
        world = motion.world_from_head.apply(self.samples.points(motion.weights))
        pairs = [np.zeros((0, 2))]
        for k, image in enumerate(self.images):
            if image is not None:
                values, inside = image.read(project_points(self.rig.cameras[k], world[self.seen[k]]))
                pairs.append(np.stack([values[:, 0], self.appearance.reference[k, self.seen[k]]], axis=1)[inside])
        both: np.ndarray = np.concatenate(pairs)
        known = both[np.isfinite(both).all(axis=1)]
        return float(np.corrcoef(known.T)[0, 1]) if len(known) > 1 else 0.0

    def _jacobian(
        self, world: Float[np.ndarray, "s 3"], pose: RigidTransform, rows: list
    ) -> Float32[np.ndarray, "n p"]:
        blocks = []
        for k, which, slope in rows:
            _, by_point = self.rig.cameras[k].project_with_jacobian(world[which])
            by_world = np.einsum("na,nac->nc", slope, by_point)
            blocks.append(derivatives(by_world, world[which], pose, self.samples.shapes[which]))
        return np.concatenate(blocks)


def derivatives(
    by_world: Float[np.ndarray, "n 3"],
    world: Float[np.ndarray, "n 3"],
    pose: RigidTransform,
    shapes: Float32[np.ndarray, "n 3 e"],
) -> Float32[np.ndarray, "n p"]:
    """Converts derivatives of values by world points to derivatives by pose and expression weights."""
    out = np.empty((len(world), POSE + shapes.shape[2]), np.float32)
    out[:, :3], out[:, 3:POSE] = np.cross(world - pose.translation, by_world), by_world
    turned = (by_world @ pose.rotation).astype(np.float32)
    out[:, POSE:] = np.matmul(turned[:, None], shapes)[:, 0]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class WeightPrior:
    """Computes the prior of the expression weights: most are small, a few are large."""

    def at(self, motion: Motion) -> "LinearisedWeightPrior":
        """Returns the prior linearised at a motion's weights."""
        return LinearisedWeightPrior(motion.weights)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedWeightPrior:
    """Holds the prior linearised at some expression weights."""

    weights: Float[np.ndarray, " e"]

    @property
    def cost(self) -> float:
        """Returns minus twice the logarithm of the prior density."""
        return float((self.weights**2).sum() + 2.0 * TAIL * np.log1p(self.weights / EXPRESSION_MEDIAN).sum())

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the prior on expression weights to the normal equations, in place."""
        rows = np.arange(POSE, POSE + len(self.weights))
        equations.matrix[rows, rows] += 1.0
        equations.gradient[rows] += self.weights + weight_slope(np.maximum(self.weights, 0.0))


def after(motion: Motion, step: Float[np.ndarray, " p"]) -> Motion:
    """Returns a motion after a step of its pose and weights."""
    pose = motion.world_from_head
    turned = rotation_from_vector(step[:3]) @ pose.rotation
    weights = np.clip(motion.weights + step[POSE:], 0.0, 1.0)
    return Motion(RigidTransform(turned, pose.translation + step[3:POSE]), weights)


def room(motion: Motion) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Returns the lower and upper bounds of a step: weights stay between 0 and 1."""
    free = np.full(POSE, np.inf)
    return np.concatenate([-free, -motion.weights]), np.concatenate([free, 1.0 - motion.weights])


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Holds the fit of a frame: its motion, the standard deviations of pose and weights (rad, mm, 1), and the
    correlation of its texture with the reference."""

    motion: Motion
    deviation: Float[np.ndarray, " p"]
    alike: float


def fit_frame(
    person: SequencePerson,
    samples: Samples,
    levels: Levels,
    pictures: Pictures,
    start: Motion,
    terms: Sequence[Term[Motion]] = (),
) -> Tracked:
    """Fits a frame to its skin texture, from coarse to fine resolution, and to the additional cost ``terms``."""
    seen, motion, weights = visible(person, samples, start), start, len(start.weights)

    def problem_at(reduced: int) -> tuple[Problem[Motion], TextureTerm]:
        some, images = [rows[::reduced] for rows in seen], textures(pictures, person.rig, reduced)
        texture = TextureTerm(samples, person.rig, images, some, levels[reduced], SCALES[reduced])
        return Problem((texture, *terms, WeightPrior()), POSE + weights, after, room=room), texture

    for reduced in REDUCED[:-1]:
        motion = minimise(problem_at(reduced)[0], motion, Limits(STEPS[reduced], TOLERANCE)).value
    problem, texture = problem_at(REDUCED[-1])
    found = minimise(problem, motion, Limits(STEPS[REDUCED[-1]], TOLERANCE))
    deviation = np.sqrt(inverse_diagonal(problem.equations(found.at).matrix))
    return Tracked(found.value, deviation, texture.correlation(found.value))
