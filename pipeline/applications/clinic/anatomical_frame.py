"""Moves a head to LPS or RAS axes, oriented like the head frame or by the Frankfurt plane.

The Frankfurt plane passes through both porions (the upper edges of the ear openings) and both orbitalia (the lowest
points of the eye sockets' rims). Porions and orbitalia are points on bone, which photographs do not show. Unmarked
points are replaced, as ``AnatomicalFrame.sources`` records: the porion by the tragion, as ISO 7250-1 does on living
people, and the orbitale by a point ``ORBITALE_BELOW_EYE_MM`` below the midpoint between the eye's corners. The origin
is midway between the porions; the x axis is the line through them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from pipeline.applications.verification.measured import Measured
from pipeline.results.head_files import LPS_FROM_HEAD
from rig.errors import InputError
from rig.formats.meshes.markups import Axes, axes_turn
from rig.geometry import RigidTransform
from rig.messages.message import compose

Vector = Float[np.ndarray, " 3"]

Plane = Literal["head", "frankfurt"]
POINTS = ("porion_right", "porion_left", "orbitale_right", "orbitale_left")
# An adult's bony orbit is 34 to 36 mm high, and the eye stands a little above its middle (Gray's Anatomy). The rim of
# one person may lie 3 mm off, which tilts the plane by 2 degrees: mark orbitale where that matters.
ORBITALE_BELOW_EYE_MM, ORBITALE_STD_MM = 18.0, 3.0
TRAGION_STD_MM = 3.0  # of the tragion above or below the porion


@dataclass(frozen=True, slots=True, eq=False)
class AnatomicalFrame:
    """Holds the rigid transform of a head into a patient's axes.

    ``sources`` states for each point of the Frankfurt plane whether it was marked or what replaces it. ``tilt_deg`` is
    the angle between the head frame's horizontal plane and the Frankfurt plane, about the line through the ears,
    positive if the nose rises; ``tilt_std_deg`` is its standard deviation. Both are None without a plane.
    """

    axes: Axes
    plane: Plane
    patient_from_world: RigidTransform
    sources: Mapping[str, str]
    tilt_deg: float | None = None
    tilt_std_deg: float | None = None


def head_axes(measured: Measured, axes: Axes) -> AnatomicalFrame:
    """Returns the patient's axes with the orientation and origin of the head frame."""
    turn = RigidTransform(axes_turn(axes, "LPS") @ LPS_FROM_HEAD, np.zeros(3))
    return AnatomicalFrame(axes, "head", turn @ measured.head_from_world, {})


def frankfurt_axes(measured: Measured, axes: Axes, marked: Mapping[str, Vector] | None = None) -> AnatomicalFrame:
    """Returns the patient's axes aligned with the Frankfurt plane. Raises InputError if marked points are not where a
    head can have them.

    Args:
        measured: the head and its landmarks.
        axes: LPS or RAS.
        marked: any of ``POINTS`` (world frame, mm) that were marked; all others are replaced.
    """
    points, sources = _plane_points(measured, marked or {})
    right, left = points["porion_right"], points["porion_left"]
    origin = 0.5 * (right + left)
    forward = 0.5 * (points["orbitale_right"] + points["orbitale_left"]) - origin
    across = left - right
    width = float(np.linalg.norm(across))
    across = across / max(width, 1e-9)
    forward = forward - (forward @ across) * across
    reach = float(np.linalg.norm(forward))
    toward_face = forward @ (measured.head_from_world.rotation.T @ (0.0, 0.0, 1.0))
    if width < 60.0 or reach < 30.0 or toward_face < 0.7 * reach:
        raise InputError(measured.name, [compose("no-frankfurt-plane", width_mm=width, reach_mm=reach)])
    forward = forward / reach
    lps_from_world = np.stack([across, -forward, np.cross(across, -forward)])
    turn = axes_turn(axes, "LPS") @ lps_from_world
    rise = measured.head_from_world.rotation @ forward
    deviations = (
        TRAGION_STD_MM if any(sources[name] != "marked" for name in POINTS[:2]) else 0.0,
        ORBITALE_STD_MM if any(sources[name] != "marked" for name in POINTS[2:]) else 0.0,
    )
    return AnatomicalFrame(
        axes,
        "frankfurt",
        RigidTransform(turn, -turn @ origin),
        sources,
        float(np.degrees(np.arctan2(-rise[1], rise[2]))),
        float(np.degrees(np.hypot(*deviations) / reach)),
    )


def _plane_points(measured: Measured, marked: Mapping[str, Vector]) -> tuple[dict[str, Vector], dict[str, str]]:
    """Returns the four points of the Frankfurt plane (world frame) and the source of each. Raises InputError if the
    head lacks landmarks that replace unmarked points."""
    points, sources = dict(marked), dict.fromkeys(marked, "marked")
    needed = {"porion": ("tragion",), "orbitale": ("exocanthion", "endocanthion")}
    lacking = [
        f"{name}_{side}"
        for point, names in needed.items()
        for side in ("right", "left")
        if f"{point}_{side}" not in marked
        for name in names
        if f"{name}_{side}" not in measured.landmarks
    ]
    if lacking:
        raise InputError(measured.name, [compose("landmarks-lacking", names=", ".join(lacking))])
    for side in ("right", "left"):
        if f"porion_{side}" not in points:
            points[f"porion_{side}"] = measured.landmarks[f"tragion_{side}"]
            sources[f"porion_{side}"] = "tragion"
        if f"orbitale_{side}" not in points:
            points[f"orbitale_{side}"] = _below_eye(measured, side)
            sources[f"orbitale_{side}"] = f"{ORBITALE_BELOW_EYE_MM:g} mm below the middle of the eye's corners"
    return points, sources


def _below_eye(measured: Measured, side: str) -> Vector:
    """Returns the point on the skin straight below an eye in the head frame (returned in the world frame)."""
    corners = [measured.landmarks[f"{corner}_{side}"] for corner in ("exocanthion", "endocanthion")]
    target = measured.head_from_world.apply(np.mean(corners, axis=0)) - (0.0, ORBITALE_BELOW_EYE_MM, 0.0)
    head = measured.head_from_world.apply(measured.mesh_world.vertices)
    front = head[head[:, 2] > target[2] - 20.0]
    skin = front[np.argmin(np.linalg.norm(front[:, :2] - target[:2], axis=1))] if len(front) else target
    return measured.head_from_world.inverse().apply(np.array([target[0], target[1], skin[2]]))
