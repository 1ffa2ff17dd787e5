"""The surface of a FLAME head model: linear shape and expression, pose correctives, and skinning over five joints.

T. Li, T. Bolkart, M. J. Black, H. Li and J. Romero, *Learning a model of facial shape and expression from 4D scans*,
ACM Transactions on Graphics 36(6), 2017, sections 3 and 4. Lengths are metres, as in the model's files; y is up, z out
of the face. The joints are, in this order, the root, the neck, the jaw and the two eyes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rig.geometry import rotation_from_vector

JOINTS = 5
POSE = 3 * JOINTS


@dataclass(frozen=True, slots=True, eq=False)
class FlameParameters:
    """Holds what makes one face of a FLAME model. ``shape`` and ``expression`` count standard deviations, ``pose`` has
    a rotation vector for each joint (radians), relative to the joint above it; ``translation`` is in metres."""

    shape: Float[np.ndarray, " s"]
    expression: Float[np.ndarray, " e"]
    pose: Float[np.ndarray, "5 3"]
    translation: Float[np.ndarray, " 3"]


@dataclass(frozen=True, slots=True, eq=False)
class FlameModel:
    """Holds the arrays of a FLAME model.

    Attributes:
        template: vertices of the mean head, m.
        shape_modes: displacement for one standard deviation of each coefficient of shape, m.
        expression_modes: the same for expression.
        pose_modes: displacement by each element of the rotation matrices of the joints below the root, less the
            identity's, m.
        joint_regressor: weights that make the joints of the shaped vertices.
        weights: how much each vertex turns with each joint.
        parents: the joint above each joint; the root's own is -1.
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
        """Returns the vertices with shape and expression, before any joint turns, m."""
        return self.template + self.shape_modes @ parameters.shape + self.expression_modes @ parameters.expression

    def surface(
        self, parameters: FlameParameters, offsets: Float[np.ndarray, "v 3"] | None = None
    ) -> Float[np.ndarray, "v 3"]:
        """Returns the vertices of a face, m. ``offsets`` are added before any joint turns (``static_offset``)."""
        shaped = self.shaped(parameters)
        return self.posed(shaped if offsets is None else shaped + offsets, parameters.pose) + parameters.translation

    def posed(self, shaped: Float[np.ndarray, "v 3"], pose: Float[np.ndarray, "5 3"]) -> Float[np.ndarray, "v 3"]:
        """Returns shaped vertices with the joints turned."""
        local = rotation_from_vector(pose)
        turns = chained(local, self.parents)
        shifts = joint_shifts(turns, (self.joint_regressor @ shaped)[:, :, None], self.parents)[:, :, 0]
        corrected = shaped + self.pose_modes @ (local[1:] - np.eye(3)).ravel()
        return np.einsum("vxy,vy->vx", self.blended(turns), corrected) + self.weights @ shifts

    def blended(self, turns: Float[np.ndarray, "5 3 3"]) -> Float[np.ndarray, "v 3 3"]:
        """Returns the matrix by which each vertex turns: the mean over the joints, by its weights."""
        return np.tensordot(self.weights, turns, axes=1)


def chained(local: Float[np.ndarray, "5 3 3"], parents: Int[np.ndarray, " 5"]) -> Float[np.ndarray, "5 3 3"]:
    """Returns the rotation of each joint in space from those relative to the joints above."""
    out = local.copy()
    for joint in range(1, JOINTS):
        out[joint] = out[parents[joint]] @ local[joint]
    return out


def joint_shifts(
    turns: Float[np.ndarray, "5 3 3"], joints: Float[np.ndarray, "5 3 k"], parents: Int[np.ndarray, " 5"]
) -> Float[np.ndarray, "5 3 k"]:
    """Returns what is added to a vertex that has turned with each joint, so that the joint stays in place. It is linear
    in the joints; the last axis has several sets of them."""
    placed = joints.copy()
    for joint in range(1, JOINTS):
        above = parents[joint]
        placed[joint] = placed[above] + turns[above] @ (joints[joint] - joints[above])
    return placed - turns @ joints
