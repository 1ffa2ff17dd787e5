"""Computes the points about which a head's jaw, eyes and neck rotate (head frame: x to the subject's left, y up, z out
of the face).

- ``jaw`` is the middle of the hinge axis, which lies 13 mm from each tragion towards the outer corner of the eye
  (Beyron 1942, the arbitrary hinge axis of dental articulators).
- ``eye_right`` and ``eye_left`` are the centres of the mesh's eyeballs; without eyeballs, of balls of 12 mm radius (an
  adult's) over which the closing lids slide.
- ``neck`` is the joint of skull and spine, 26 mm below and 11 mm behind the midpoint between the ear openings (Ewing
  and Thomas 1972)."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from rig.geometry import RigidTransform, rotation_from_vector

Vertices = Float[np.ndarray, "v 3"]

HINGE_MM = 13.0
EYE_RADIUS_MM, EYE_REACH_MM = 12.0, 20.0  # an eyeball's centre is no farther from the middle between the eye's corners
NECK_MM = np.array([0.0, -26.0, -11.0])
CHIN_MM = 15.0  # about the lowest point of the chin, skin lies close on the bone
SLIDING = 0.6  # of the largest motion of a closing lid: its edge
Points = Mapping[str, Float[np.ndarray, " 3"]]


def pivots(
    landmarks: Points, vertices: Vertices, shapes: Mapping[str, Vertices], balls: list[Float[np.ndarray, "b 3"]]
) -> dict[str, Float[np.ndarray, " 3"]]:
    """Returns the pivots (rotation centres) of a head's parts by name, in the head frame, mm.

    Args:
        landmarks: landmarks of the head without expression.
        vertices: its finest mesh.
        shapes: displacements of the finest mesh, by Apple's names.
        balls: vertices of each eyeball of the mesh.
    """
    out = {"jaw": hinge(landmarks)}
    for side in ("right", "left"):
        corners = 0.5 * (landmarks[f"exocanthion_{side}"] + landmarks[f"endocanthion_{side}"])
        centres = [ball.mean(axis=0) for ball in balls]
        near = [c for c in centres if np.linalg.norm(c - corners) < EYE_REACH_MM]
        blink = shapes.get(f"eyeBlink{side.capitalize()}")
        out[f"eye_{side}"] = near[0] if near else corners if blink is None else _lid_centre(vertices, blink)
    out["neck"] = 0.5 * (landmarks["tragion_right"] + landmarks["tragion_left"]) + NECK_MM
    return out


def hinge(landmarks: Points) -> Float[np.ndarray, " 3"]:
    """Returns the middle of the jaw's hinge axis."""
    sides = []
    for side in ("right", "left"):
        ear = landmarks[f"tragion_{side}"]
        towards = landmarks[f"exocanthion_{side}"] - ear
        sides.append(ear + HINGE_MM * towards / np.linalg.norm(towards))
    return np.mean(sides, axis=0)


def _lid_centre(vertices: Vertices, blink: Vertices) -> Float[np.ndarray, " 3"]:
    """Returns the centre of the eyeball under a lid: the lid's edge touches this ball both open and closed."""
    moved = np.linalg.norm(blink, axis=1)
    rows = moved > SLIDING * moved.max()
    points = np.concatenate([vertices[rows], vertices[rows] + blink[rows]])
    columns = np.concatenate([2.0 * points, np.ones((len(points), 1))], axis=1)
    solved = np.linalg.lstsq(columns, (points**2).sum(axis=1), rcond=None)[0]
    centre = solved[:3]
    radius = float(np.sqrt(solved[3] + centre @ centre))
    return centre - np.array([0.0, 0.0, EYE_RADIUS_MM - radius])


def jaw_motions(landmarks: Points, vertices: Vertices, shapes: Mapping[str, Vertices]) -> dict[str, RigidTransform]:
    """Returns the rigid motion of the lower jaw for each blendshape that moves it, estimated from the skin over the
    chin: ``jawOpen`` rotates about the hinge axis, the others translate."""
    chin = np.linalg.norm(vertices - landmarks["gnathion"], axis=1) < CHIN_MM
    before, out = vertices[chin].mean(axis=0), {}
    for name in ("jawForward", "jawLeft", "jawRight"):
        if name in shapes:
            out[name] = RigidTransform(np.eye(3), shapes[name][chin].mean(axis=0))
    if "jawOpen" in shapes:
        axis = hinge(landmarks)
        first, last = before - axis, before + shapes["jawOpen"][chin].mean(axis=0) - axis
        angle = np.arctan2(first[1] * last[2] - first[2] * last[1], first[1:] @ last[1:])  # about x, y towards z
        turn = rotation_from_vector(np.array([angle, 0.0, 0.0]))
        out["jawOpen"] = RigidTransform(turn, axis - turn @ axis)
    return out


def in_mouth(landmarks: Points, points: Float[np.ndarray, "n 3"]) -> bool:
    """Returns whether a part of a mesh lies in the lower half of the mouth, as lower teeth and tongue do."""
    centre, wide = points.mean(axis=0), landmarks["cheilion_left"][0] - landmarks["cheilion_right"][0]
    low, high, middle = landmarks["gnathion"][1], landmarks["stomion"][1], landmarks["stomion"][0]
    inside = low < centre[1] < high and abs(centre[0] - middle) < wide
    return bool(inside and hinge(landmarks)[2] < centre[2] < landmarks["stomion"][2])
