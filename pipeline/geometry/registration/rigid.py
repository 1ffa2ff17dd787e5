"""Takes Gauss-Newton steps on the distances of points from a surface along its normals (Chen and Medioni 1992), over a
motion and, if wanted, over the coefficients of a shape."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rig.geometry import Similarity, rotation_from_vector

Points = Float[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Counterparts:
    """Holds what n points meet: the unit normals there, how far the surface lies ahead along them (mm), and weights, 0
    for a point without a counterpart. ``reach_mm`` is how far counterparts may be at the next step."""

    normals: Points
    ahead_mm: Float[np.ndarray, " n"]
    weights: Float[np.ndarray, " n"]
    reach_mm: float


Meet = Callable[[Similarity, Points, float], Counterparts | None]


def fit_motion(
    points: Points, meet: Meet, start: Similarity, *, reach_mm: float, steps: int, still_mm: float, scale: bool = False
) -> Similarity | None:
    """Lays points on a surface by a rigid motion or, with ``scale``, a similarity. ``meet`` finds the counterparts of
    the points where a motion brings them, within a reach that is ``reach_mm`` at first; once it returns None, for too
    few, so does this. A step that moves every point by less than ``still_mm`` is the last, unless the reach shrinks."""
    motion = start
    for _ in range(steps):
        there = motion.apply(points)
        met = meet(motion, there, reach_mm)
        if met is None:
            return None
        centre = np.average(there, axis=0, weights=met.weights)
        root = np.sqrt(met.weights / met.weights.sum())
        columns = motion_columns(there - centre, met.normals, scale=scale)
        step = np.linalg.lstsq(columns * root[:, None], met.ahead_mm * root, rcond=None)[0]
        moved = motion_about(centre, step)
        motion = moved @ motion
        if met.reach_mm >= reach_mm and float(np.abs(moved.apply(there) - there).max()) < still_mm:
            break
        reach_mm = met.reach_mm
    return motion


def motion_columns(arms: Points, normals: Points, *, scale: bool = False) -> Float[np.ndarray, "n p"]:
    """Returns how far points move along normals by a turn (rad) about the origin of ``arms``, by a shift (mm) and, with
    ``scale``, by the logarithm of the scale."""
    columns = [np.cross(arms, normals), normals]
    if scale:
        columns.append((arms * normals).sum(axis=1, keepdims=True))
    return np.concatenate(columns, axis=1)


def motion_about(centre: Float[np.ndarray, " 3"], step: Float[np.ndarray, " p"]) -> Similarity:
    """Returns the motion of a step in the unknowns of ``motion_columns``, about ``centre``."""
    turn, scale = rotation_from_vector(step[:3]), float(np.exp(step[6])) if len(step) > 6 else 1.0
    return Similarity(scale, turn, centre + step[3:6] - scale * turn @ centre)


def solve_with_prior(
    columns: Float[np.ndarray, "n p"],
    ahead: Float[np.ndarray, " n"],
    information: Float[np.ndarray, " n"],
    prior: Float[np.ndarray, " p"],
    state: Float[np.ndarray, " p"],
    *,
    precision: type = np.float64,
    ridge: float = 0.0,
) -> Float[np.ndarray, " p"]:
    """Returns the step of the unknowns from ``state`` that explains the distances ``ahead`` best, under independent
    priors about 0 of information ``prior``.

    Single ``precision`` halves the time where the prior is firm. ``ridge`` keeps unknowns without a prior from running
    away: it is added to their information, by the mean information of all.
    """
    root = np.sqrt(information)
    weighted = (columns * root[:, None]).astype(precision)
    system = (weighted.T @ weighted).astype(float)
    diagonal = np.einsum("ii->i", system)
    diagonal += prior
    diagonal += np.where(prior > 0.0, 0.0, ridge * diagonal.mean())
    return np.linalg.solve(system, weighted.T.astype(float) @ (ahead * root) - prior * state)
