"""Computes the surface of a FLAME head model: linear shape and expression modes, pose correctives, and skinning over
five joints.

T. Li, T. Bolkart, M. J. Black, H. Li and J. Romero, *Learning a model of facial shape and expression from 4D scans*,
ACM Transactions on Graphics 36(6), 2017, sections 3 and 4. Lengths are metres, as in the model's files; y points up, z
out of the face. The joints are, in this order, the root, the neck, the jaw and the two eyes.

The parameters are fitted to a mesh in FLAME's vertex order by Levenberg-Marquardt on the vertex distances, with
Gaussian priors. The standard deviation of the vertex distances is estimated anew in each round of the fit. The smaller
this standard deviation, the less the priors count; the priors decide parameters that the mesh leaves undetermined."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.terms import LinearisedQuadratic, Problem, Quadratic, Residuals
from rig.geometry import rigid_fit, rotation_from_vector, vector_from_rotation

TURN_RAD = 0.3  # standard deviation of each angle of neck, jaw and eyes: 17 degrees; the root turns freely
FIRST_M, FLOOR_M = 1e-3, 1e-5  # of a vertex's distance: assumed at first, and the least that is assumed
ROUNDS = 5
STEP_RAD = 1e-5  # of the differences that give the Jacobian of the angles
LIMITS = Limits(steps=30, tolerance=1e-4)
JOINTS = 5
POSE = 3 * JOINTS


@dataclass(frozen=True, slots=True, eq=False)
class FlameParameters:
    """Holds the parameters of one face of a FLAME model. ``shape`` and ``expression`` count standard deviations.
    ``pose`` has a rotation vector (radians) for each joint, relative to its parent; ``translation`` is in metres."""

    shape: Float[np.ndarray, " s"]
    expression: Float[np.ndarray, " e"]
    pose: Float[np.ndarray, "5 3"]
    translation: Float[np.ndarray, " 3"]


@dataclass(frozen=True, slots=True, eq=False)
class FlameModel:
    """Holds the arrays of a FLAME head model.

    Attributes:
        template: vertices of the mean head, m.
        shape_modes: displacement for one standard deviation of each coefficient of shape, m.
        expression_modes: the same for expression.
        pose_modes: displacement by each element of the rotation matrices (minus the identity) of the joints below
            the root, m.
        joint_regressor: weights that compute the joints from the shaped vertices.
        weights: skinning weight of each vertex for each joint.
        parents: the parent of each joint; -1 for the root.
        faces: triangles.
    """

    template: Float[np.ndarray, "v 3"]
    shape_modes: Float[np.ndarray, "v 3 s"]
    expression_modes: Float[np.ndarray, "v 3 e"]
    pose_modes: Float[np.ndarray, "v 3 36"]
    joint_regressor: Float[np.ndarray, "5 v"]
    weights: Float[np.ndarray, "v 5"]
    parents: Int[np.ndarray, " 5"]
    faces: Int[np.ndarray, "f 3"]

    def neutral(self) -> FlameParameters:
        """Returns the parameters of the mean head."""
        shapes, expressions = self.shape_modes.shape[2], self.expression_modes.shape[2]
        return FlameParameters(np.zeros(shapes), np.zeros(expressions), np.zeros((JOINTS, 3)), np.zeros(3))

    def shaped(self, parameters: FlameParameters) -> Float[np.ndarray, "v 3"]:
        """Returns the vertices with shape and expression applied, before any joint rotates, m."""
        return self.template + self.shape_modes @ parameters.shape + self.expression_modes @ parameters.expression

    def surface(
        self, parameters: FlameParameters, offsets: Float[np.ndarray, "v 3"] | None = None
    ) -> Float[np.ndarray, "v 3"]:
        """Returns the vertices of a face, m. ``offsets`` are added before any joint rotates (``static_offset``)."""
        shaped = self.shaped(parameters)
        return self.posed(shaped if offsets is None else shaped + offsets, parameters.pose) + parameters.translation

    def posed(self, shaped: Float[np.ndarray, "v 3"], pose: Float[np.ndarray, "5 3"]) -> Float[np.ndarray, "v 3"]:
        """Returns the vertices after the joints have been rotated."""
        local = rotation_from_vector(pose)
        turns = chained(local, self.parents)
        shifts = joint_shifts(turns, (self.joint_regressor @ shaped)[:, :, None], self.parents)[:, :, 0]
        corrected = shaped + self.pose_modes @ (local[1:] - np.eye(3)).ravel()
        return np.einsum("vxy,vy->vx", self.blended(turns), corrected) + self.weights @ shifts

    def blended(self, turns: Float[np.ndarray, "5 3 3"]) -> Float[np.ndarray, "v 3 3"]:
        """Returns the matrix that rotates each vertex: the mean of the joints' rotations with the skinning weights."""
        return np.tensordot(self.weights, turns, axes=1)


def chained(local: Float[np.ndarray, "5 3 3"], parents: Int[np.ndarray, " 5"]) -> Float[np.ndarray, "5 3 3"]:
    """Returns the rotation of each joint in the model's frame, from rotations relative to the parent joints."""
    out = local.copy()
    for joint in range(1, JOINTS):
        out[joint] = out[parents[joint]] @ local[joint]
    return out


def joint_shifts(
    turns: Float[np.ndarray, "5 3 3"], joints: Float[np.ndarray, "5 3 k"], parents: Int[np.ndarray, " 5"]
) -> Float[np.ndarray, "5 3 k"]:
    """Returns, for each joint, the translation that follows its rotation so that the joint itself does not move. The
    translations are linear in the joints' positions; the last axis of ``joints`` holds several sets of positions."""
    placed = joints.copy()
    for joint in range(1, JOINTS):
        above = parents[joint]
        placed[joint] = placed[above] + turns[above] @ (joints[joint] - joints[above])
    return placed - turns @ joints


@dataclass(frozen=True, slots=True, eq=False)
class FlameFit:
    """Holds fitted FLAME parameters, the remaining vertex distances from the mesh, and offsets that remove them, m."""

    parameters: FlameParameters
    distances: Float[np.ndarray, " v"]  # from the mesh to the surface that the parameters make, m
    offsets: Float[np.ndarray, "v 3"]  # added before the joints turn, the surface is the mesh


def fit_flame(
    model: FlameModel, target: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, " v"] | None = None
) -> FlameFit:
    """Fits the FLAME model to a mesh in FLAME's vertex order.

    Args:
        model: the model.
        target: the mesh's vertices, m, in any frame.
        weights: the weight of each vertex, 0 to 1; 1 by default.
    """
    counted = np.ones(len(target)) if weights is None else weights
    value, deviation = _start(model, target, counted), FIRST_M
    for _ in range(ROUNDS):
        terms = (_Vertices(model, target, np.sqrt(counted) / deviation), _Prior.of(model))
        value = minimise(Problem(terms, len(_vector(value)), _moved), value, LIMITS).value
        variance = counted @ _distances(model, value, target) ** 2 / (3.0 * counted.sum())  # of a coordinate
        before, deviation = deviation, max(FLOOR_M, float(np.sqrt(variance)))
        if abs(deviation - before) < 0.01 * before:
            break
    turns = np.stack([vector_from_rotation(turn) for turn in rotation_from_vector(value.pose)])
    value = replace(value, pose=turns)
    return FlameFit(value, _distances(model, value, target), _offsets(model, value, target))


def _start(model: FlameModel, target: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, " v"]) -> FlameParameters:
    """Returns the parameters of the mean head, moved rigidly to the mesh. The motion rotates about the root joint."""
    placed = rigid_fit(model.template, target, weights)
    mean, root = model.neutral(), model.joint_regressor[0] @ model.template
    pose = np.zeros((JOINTS, 3))
    pose[0] = vector_from_rotation(placed.rotation)
    return replace(mean, pose=pose, translation=placed.apply(root) - root)


def _distances(model: FlameModel, value: FlameParameters, target: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
    return np.linalg.norm(model.surface(value) - target, axis=1)


def _vector(value: FlameParameters) -> Float[np.ndarray, " p"]:
    return np.concatenate([value.shape, value.expression, value.pose.ravel(), value.translation])


def _moved(value: FlameParameters, step: Float[np.ndarray, " p"]) -> FlameParameters:
    ends = np.cumsum([len(value.shape), len(value.expression), POSE])
    shape, expression, pose, translation = np.split(_vector(value) + step, ends)
    return FlameParameters(shape, expression, pose.reshape(JOINTS, 3), translation)


@dataclass(frozen=True, slots=True, eq=False)
class _Prior:
    """Holds the priors: coefficients are N(0, 1), joint angles except the root's N(0, ``TURN_RAD``)."""

    form: Quadratic

    @classmethod
    def of(cls, model: FlameModel) -> "_Prior":
        """Returns the priors of a FLAME model's parameters."""
        turns = np.full((JOINTS, 3), 1.0 / TURN_RAD**2)
        turns[0] = 0.0
        modes = model.shape_modes.shape[2] + model.expression_modes.shape[2]
        information = np.concatenate([np.ones(modes), turns.ravel(), np.zeros(3)])
        return cls(Quadratic.prior(np.diag(information), np.zeros(len(information))))

    def at(self, value: FlameParameters) -> LinearisedQuadratic:
        """Returns the cost of the priors at given parameters."""
        return self.form.at(_vector(value))


@dataclass(frozen=True, slots=True, eq=False)
class _Vertices:
    """Holds the vertex distances as a cost term; ``roots`` are the distances' inverse standard deviations (1/m)."""

    model: FlameModel
    target: Float[np.ndarray, "v 3"]
    roots: Float[np.ndarray, " v"]

    def at(self, value: FlameParameters) -> Residuals:
        """Returns the vertex distances between a FLAME face and the mesh."""
        residual = (self.model.surface(value) - self.target) * self.roots[:, None]
        return Residuals(residual, lambda: surface_jacobian(self.model, value) * self.roots[:, None, None])


def surface_jacobian(model: FlameModel, value: FlameParameters) -> Float[np.ndarray, "v 3 p"]:
    """Returns the derivatives of a FLAME face's vertices by shape, expression, pose and translation, in this order.
    Derivatives by shape and expression are exact; those by joint angles are finite differences."""
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
    """Returns the vertex offsets with which the FLAME face equals the mesh. Offsets also move the joints, about which
    all vertices rotate, so the 15 joint coordinates are solved for as well."""
    turns = chained(rotation_from_vector(value.pose), model.parents)
    back = np.linalg.inv(model.blended(turns))
    missing = np.einsum("vxy,vy->vx", back, target - model.surface(value))
    units = np.eye(POSE).reshape(JOINTS, 3, POSE)
    moved = np.tensordot(model.weights, joint_shifts(turns, units, model.parents), axes=1)
    moved = back @ moved
    system = np.eye(POSE) + np.einsum("jv,vxk->jxk", model.joint_regressor, moved).reshape(POSE, POSE)
    joints = np.linalg.solve(system, (model.joint_regressor @ missing).ravel())
    return missing - moved @ joints
