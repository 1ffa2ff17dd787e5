"""Fits the parameters of a FLAME model to a mesh in its vertex order: shape, expression, turned joints, translation.

Levenberg-Marquardt on the distances of the vertices, with Gaussian priors. The distances' own deviation is estimated,
too, in rounds: if the model can equal the mesh, the priors fade; if not, they decide what the mesh leaves open."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.applications.templates.flame_model import JOINTS, POSE, FlameModel, FlameParameters, chained, joint_shifts
from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.terms import LinearisedQuadratic, Problem, Quadratic, Residuals
from rig.geometry import rigid_fit, rotation_from_vector, vector_from_rotation

TURN_RAD = 0.3  # standard deviation of each angle of neck, jaw and eyes: 17 degrees; the root turns freely
FIRST_M, FLOOR_M = 1e-3, 1e-5  # of a vertex's distance: assumed at first, and the least that is assumed
ROUNDS = 5
STEP_RAD = 1e-5  # of the differences that give the Jacobian of the angles
LIMITS = Limits(steps=30, tolerance=1e-4)


@dataclass(frozen=True, slots=True, eq=False)
class FlameFit:
    """Holds fitted parameters, what they leave of the mesh, and offsets that take that up, m."""

    parameters: FlameParameters
    distances: Float[np.ndarray, " v"]  # from the mesh to the surface that the parameters make, m
    offsets: Float[np.ndarray, "v 3"]  # added before the joints turn, the surface is the mesh


def fit_flame(
    model: FlameModel, target: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, " v"] | None = None
) -> FlameFit:
    """Fits the model to a mesh in the model's vertex order.

    Args:
        model: the model.
        target: the mesh's vertices, m, in any frame.
        weights: how much each vertex counts, 0 to 1; equally by default.
    """
    counted = np.ones(len(target)) if weights is None else weights
    value, deviation = _start(model, target, counted), FIRST_M
    for _ in range(ROUNDS):
        terms = (_Vertices(model, target, np.sqrt(counted) / deviation), _Prior.of(model))
        value = minimise(Problem(terms, len(_vector(value)), _moved), value, LIMITS).value
        before, deviation = deviation, _deviation(_distances(model, value, target), counted)
        if abs(deviation - before) < 0.01 * before:
            break
    turns = np.stack([vector_from_rotation(turn) for turn in rotation_from_vector(value.pose)])
    value = replace(value, pose=turns)
    return FlameFit(value, _distances(model, value, target), _offsets(model, value, target))


def _start(model: FlameModel, target: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, " v"]) -> FlameParameters:
    """Returns the mean head where the mesh is. The root turns about its joint."""
    placed = rigid_fit(model.template, target, weights)
    mean, root = model.neutral(), model.joint_regressor[0] @ model.template
    pose = np.zeros((JOINTS, 3))
    pose[0] = vector_from_rotation(placed.rotation)
    return replace(mean, pose=pose, translation=placed.apply(root) - root)


def _distances(model: FlameModel, value: FlameParameters, target: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
    return np.linalg.norm(model.surface(value) - target, axis=1)


def _deviation(distances: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"]) -> float:
    """Returns the standard deviation of a coordinate of the distances, m; not less than ``FLOOR_M``."""
    return max(FLOOR_M, float(np.sqrt(weights @ distances**2 / (3.0 * weights.sum()))))


def _vector(value: FlameParameters) -> Float[np.ndarray, " p"]:
    return np.concatenate([value.shape, value.expression, value.pose.ravel(), value.translation])


def _moved(value: FlameParameters, step: Float[np.ndarray, " p"]) -> FlameParameters:
    ends = np.cumsum([len(value.shape), len(value.expression), POSE])
    shape, expression, pose, translation = np.split(_vector(value) + step, ends)
    return FlameParameters(shape, expression, pose.reshape(JOINTS, 3), translation)


@dataclass(frozen=True, slots=True, eq=False)
class _Prior:
    """Holds the priors: coefficients are N(0, 1), angles of the joints below the root N(0, ``TURN_RAD``)."""

    form: Quadratic

    @classmethod
    def of(cls, model: FlameModel) -> "_Prior":
        """Returns the priors of a model's parameters."""
        turns = np.full((JOINTS, 3), 1.0 / TURN_RAD**2)
        turns[0] = 0.0
        modes = model.shape_modes.shape[2] + model.expression_modes.shape[2]
        information = np.concatenate([np.ones(modes), turns.ravel(), np.zeros(3)])
        return cls(Quadratic.prior(np.diag(information), np.zeros(len(information))))

    def at(self, value: FlameParameters) -> LinearisedQuadratic:
        """Returns the priors' cost at a value."""
        return self.form.at(_vector(value))


@dataclass(frozen=True, slots=True, eq=False)
class _Vertices:
    """Holds the distances of all vertices as a term; ``roots`` divide them by their standard deviations (1/m)."""

    model: FlameModel
    target: Float[np.ndarray, "v 3"]
    roots: Float[np.ndarray, " v"]

    def at(self, value: FlameParameters) -> Residuals:
        """Returns the distances of a face from the mesh."""
        residual = (self.model.surface(value) - self.target) * self.roots[:, None]
        return Residuals(residual, lambda: surface_jacobian(self.model, value) * self.roots[:, None, None])


def surface_jacobian(model: FlameModel, value: FlameParameters) -> Float[np.ndarray, "v 3 p"]:
    """Returns the derivatives of a face's vertices by shape, expression, pose and translation, in this order. In the
    coefficients the surface is linear; angles have differences."""
    turns = chained(rotation_from_vector(value.pose), model.parents)
    blended, shaped = model.blended(turns), model.shaped(value)
    columns = []
    for modes in (model.shape_modes, model.expression_modes):
        joints = np.einsum("jv,vxk->jxk", model.joint_regressor, modes)
        shifts = joint_shifts(turns, joints, model.parents)
        columns.append(blended @ modes + np.tensordot(model.weights, shifts, axes=1))
    angles = np.empty((len(shaped), 3, POSE))
    for k in range(POSE):
        step = np.zeros(POSE)
        step[k] = STEP_RAD
        step = step.reshape(JOINTS, 3)
        ahead, behind = model.posed(shaped, value.pose + step), model.posed(shaped, value.pose - step)
        angles[:, :, k] = (ahead - behind) / (2.0 * STEP_RAD)
    shift = np.broadcast_to(np.eye(3), (len(shaped), 3, 3))
    return np.concatenate([*columns, angles, shift], axis=2)


def _offsets(model: FlameModel, value: FlameParameters, target: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Returns what must be added to the shaped vertices so that the face is the mesh. Offsets move the joints, too,
    which all vertices turn about: what the 15 coordinates of the joints do then is solved for."""
    turns = chained(rotation_from_vector(value.pose), model.parents)
    back = np.linalg.inv(model.blended(turns))
    missing = np.einsum("vxy,vy->vx", back, target - model.surface(value))
    units = np.eye(POSE).reshape(JOINTS, 3, POSE)
    moved = np.tensordot(model.weights, joint_shifts(turns, units, model.parents), axes=1)
    moved = back @ moved
    system = np.eye(POSE) + np.einsum("jv,vxk->jxk", model.joint_regressor, moved).reshape(POSE, POSE)
    joints = np.linalg.solve(system, (model.joint_regressor @ missing).ravel())
    return missing - moved @ joints
