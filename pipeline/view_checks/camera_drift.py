"""Checks by means of the silhouettes, before each fit, whether a camera has moved since the calibration.

A plane through two camera centres that touches the subject is tangent to both silhouettes (epipolar tangency;
Ramanathan, Steinbach and Girod 2000). Hair and shoulders are as useful as skin, since the subject is rigid within a
shot. Eleven cameras give about fifty tangency equations, exact to 0.2 px. A small rotation of a camera shifts its whole
image, so all equations of this camera give the same shift.

A loose mask is too large on every side, while a shifted image is off in one direction; tangencies on opposite sides
distinguish these causes. In a close-up most tangencies are on one side, and both causes are possible: the camera is
reported with both, and its view is still used. Strands of hair that only some cameras resolve would cause errors of
several pixels. Therefore the planes are tangent to a curve that lies inside the outline by the same distance in mm for
every camera.

The module returns the cameras that have moved, with the size and the significance of the shift.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import fdtrc

from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import Problem, Quadratic, Residuals
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.tangency import Tangency, find_tangencies
from rig.camera import Camera
from rig.messages.message import Message, compose
from rig.rig import Rig

INSET_MM = 2.2  # four pixels of the usual rig: a strand under a mask that is 2 px loose is 5 px wide
NOISE_FLOOR_PX = 0.28  # of one contour, in its own pixels, never less however well they agree by chance
ROBUST_SIGMAS = 3.0
_LOSS = GemanMcClure(ROBUST_SIGMAS)
MIN_EQUATIONS = 5  # of a camera: two unknowns, and enough left over to judge them
MIN_INDEPENDENT = 0.3  # sine of the angle between two normals whose crossing is proposed
NO_SHIFT_INFORMATION = 1e-6  # px^-2: keeps a shift that no normal sees at zero
MIN_SIGMAS, MIN_SHIFT_PX = 8.0, 1.5  # good cameras reach 4, cameras turned by 0.2 degrees 14 and more
MIN_GAIN = 0.4  # share of the camera's own robust misfit that its shift must explain, and of all but one of them
LOOSE_PX = 1.5  # standard deviation of how loose a mask is: 1 to 2 px in real photographs
MIN_MOVED_SIGMAS = 4.0  # by which a shift explains the planes better than loose masks do, or both explain them
CHANCE = 0.01  # that a good camera disagrees so much with the rest (F test)


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Holds a camera whose silhouette is shifted from the position that the other cameras predict.

    Attributes:
        camera: its name.
        shift_px: the shift of its image, assuming a tight mask.
        deviation_px: standard deviation of the shift.
        turn_deg: rotation of the camera that would cause it.
        sigmas: the shift in standard deviations.
        moved: whether a loose mask cannot explain the shift, and the other cameras agree better without this one.
    """

    camera: str
    shift_px: Float[np.ndarray, " 2"]
    deviation_px: float
    turn_deg: float
    sigmas: float
    moved: bool

    def warning(self) -> Message:
        """Returns the warning about this camera."""
        shift_px = float(np.linalg.norm(self.shift_px))
        if not self.moved:
            return compose("mask-loose", camera=self.camera, shift_px=shift_px, turn_deg=self.turn_deg)
        shifted = compose(
            "camera-shifted", camera=self.camera, shift_px=shift_px, turn_deg=self.turn_deg, sigmas=self.sigmas
        )
        return compose("camera-moved", finding=shifted)


def find_drift(silhouettes: Mapping[str, Silhouette], rig: Rig) -> tuple[Drift, ...]:
    """Finds cameras that have moved since the calibration, or appear to have moved because of a loose mask, the largest
    shift first.

    The worst camera is removed before the next search, since it distorts the equations of its neighbours.
    """
    usable = rig.subset(name for name in rig.names if name in silhouettes and silhouettes[name].quality.usable)
    tangencies = find_tangencies(silhouettes, usable, INSET_MM)
    found: list[Drift] = []
    names = list(usable.names)
    while len(names) > 3 and len(found) < len(usable) // 4 + 1:
        among = [t for t in tangencies if set(t.cameras) <= set(names)]
        judged = [drift for name in names if (drift := _judge(name, among, usable[name])) is not None]
        if not judged:
            break
        worst = max(judged, key=lambda drift: drift.sigmas)
        found.append(worst)
        names.remove(worst.camera)
    return tuple(sorted(found, key=lambda drift: -float(np.linalg.norm(drift.shift_px))))


def _judge(name: str, tangencies: list[Tangency], camera: Camera) -> Drift | None:
    """Returns the shift that explains the camera's tangencies; None if there are too few or the shift is not
    significant."""
    rest = _normalised([t for t in tangencies if name not in t.cameras])
    scale = max(1.0, 1.4826 * float(np.median(np.abs(rest)))) if len(rest) else 1.0
    equations = ShiftEquations.of(name, tangencies, scale * NOISE_FLOOR_PX)
    if len(equations.excess_px) < MIN_EQUATIONS:
        return None
    found = _robust_shift(equations)
    before, after = _misfits(equations.excess_px / equations.noise_px), _misfits(equations.missed(found.shift_px, 0.0))
    size = float(np.linalg.norm(found.shift_px))
    if found.sigmas < MIN_SIGMAS or size < MIN_SHIFT_PX or not _explains(before, after):
        return None
    moved = _beyond_loose_masks(equations, found) >= MIN_MOVED_SIGMAS and _disagrees(before, _misfits(rest / scale))
    turn = np.degrees(np.arctan(size / camera.intrinsics.fx))
    return Drift(name, found.shift_px, found.deviation_px, float(turn), found.sigmas, moved)


def _normalised(tangencies: list[Tangency]) -> Float[np.ndarray, " n"]:
    """Returns the error of each tangency in standard deviations, for outlines with an error of ``NOISE_FLOOR_PX``."""
    excess = np.array([t.excess_px[0] for t in tangencies])
    slopes = np.array([t.steepness for t in tangencies]).reshape(-1, 2)
    return excess * slopes[:, 0] / (NOISE_FLOOR_PX * np.hypot(slopes[:, 0], slopes[:, 1]))


@dataclass(frozen=True, slots=True, eq=False)
class ShiftEquations:
    """Holds the equations ``normal . shift + outward * loose = excess`` of one camera's n tangencies (px). The unknowns
    are the shift of the image and the width by which the mask is too large all around (``loose``).

    ``outward`` is 1 where ``normal`` points out of the subject, else -1. ``pixels`` is the standard deviation of each
    equation for an outline noise of one pixel in both pictures; ``contour_noise_px`` is the actual noise.
    """

    normals: Float[np.ndarray, "n 2"]
    outward: Float[np.ndarray, " n"]
    excess_px: Float[np.ndarray, " n"]
    pixels: Float[np.ndarray, " n"]
    contour_noise_px: float

    @property
    def noise_px(self) -> Float[np.ndarray, " n"]:
        """Returns the standard deviation of each tangency equation, px."""
        return self.contour_noise_px * self.pixels

    @classmethod
    def of(cls, name: str, tangencies: list[Tangency], contour_noise_px: float) -> "ShiftEquations":
        """Builds the equations of the camera ``name`` from its tangencies with other cameras."""
        involved = [(t, side) for t in tangencies for side in range(2) if t.cameras[side] == name]
        ratio = np.array([t.steepness[1 - side] / t.steepness[side] for t, side in involved])
        return cls(
            np.array([t.normals[side] for t, side in involved]).reshape(-1, 2),
            np.array([t.outward for t, _ in involved]),
            np.array([t.excess_px[side] for t, side in involved]),
            np.hypot(1.0, ratio),
            contour_noise_px,
        )

    def missed(self, shift_px: Float[np.ndarray, " 2"], loose_px: float) -> Float[np.ndarray, " n"]:
        """Returns the residual of each equation, in standard deviations, for an image shift ``shift_px`` and a mask too
        large by ``loose_px``."""
        return (self.normals @ shift_px + self.outward * loose_px - self.excess_px) / self.noise_px


@dataclass(frozen=True, slots=True, eq=False)
class ShiftTerm:
    """Computes the residuals ``(normal . shift - excess) / noise`` of one camera's tangencies, with Geman and McClure's
    loss."""

    equations: ShiftEquations

    def at(self, shift_px: Float[np.ndarray, " 2"]) -> Residuals:
        """Returns the residuals and their derivatives for a shift of the camera's image (px)."""
        equations = self.equations
        miss = equations.missed(shift_px, 0.0)
        return Residuals(miss[:, None], lambda: (equations.normals / equations.noise_px[:, None])[:, None], _LOSS)


@dataclass(frozen=True, slots=True, eq=False)
class _Shift:
    """Holds an image shift (px), its standard deviation (px), and its size in standard deviations, for a tight mask."""

    shift_px: Float[np.ndarray, " 2"]
    deviation_px: float
    sigmas: float


def _robust_shift(equations: ShiftEquations) -> _Shift:
    """Finds the image shift of least robust misfit, starting from the best solution of a pair of equations. If all
    equations have the same direction, the perpendicular shift stays zero."""
    pairs = np.stack(np.triu_indices(len(equations.excess_px), 1), axis=1)
    pairs = pairs[np.abs(np.linalg.det(equations.normals[pairs])) > MIN_INDEPENDENT]
    met = np.linalg.solve(equations.normals[pairs], equations.excess_px[pairs][:, :, None])[:, :, 0]
    proposals = np.concatenate([np.zeros((1, 2)), met])
    misses = (equations.excess_px - proposals @ equations.normals.T) / equations.noise_px
    start = proposals[int(np.argmin(_misfits(misses).sum(axis=1)))]
    known = NO_SHIFT_INFORMATION * np.eye(2)
    problem = Problem((ShiftTerm(equations), Quadratic.prior(known, np.zeros(2))), 2, np.add)
    found = minimise(problem, start, Limits(tolerance=1e-6))
    information = problem.equations(found.at).matrix - known
    deviation = float(np.sqrt(np.trace(np.linalg.inv(information + 1e-9 * np.eye(2)))))
    return _Shift(found.value, deviation, float(np.sqrt(found.value @ information @ found.value)))


def _beyond_loose_masks(equations: ShiftEquations, found: _Shift) -> float:
    """Returns the significance, in standard deviations, of a shift compared with a loose mask: the root of the
    difference in cost, or 0 if a loose mask explains the tangencies as well."""
    deviation_px = LOOSE_PX * float(np.median(equations.pixels))
    proposed = np.append(equations.outward * equations.excess_px, 0.0)
    loose = min(
        _cost(equations, np.zeros(2), loose_px) + (loose_px / deviation_px) ** 2 for loose_px in proposed.tolist()
    )
    return float(np.sqrt(max(0.0, loose - _cost(equations, found.shift_px, 0.0))))


def _cost(equations: ShiftEquations, shift_px: Float[np.ndarray, " 2"], loose_px: float) -> float:
    return float(_LOSS.cost(equations.missed(shift_px, loose_px) ** 2).sum())


def _explains(before: Float[np.ndarray, " n"], after: Float[np.ndarray, " n"]) -> bool:
    """Returns True if a shift removes enough of the misfit, even without the equation that it improves most. A bad part
    of an outline affects one tangent plane, a moved camera all of its planes."""
    others = np.arange(len(before)) != np.argmax(before - after)
    return all(after[k].sum() <= (1.0 - MIN_GAIN) * before[k].sum() for k in (slice(None), others))


def _disagrees(misfits: Float[np.ndarray, " n"], rest: Float[np.ndarray, " m"]) -> bool:
    """Returns True if the other cameras' tangent planes agree significantly better among themselves than with this
    camera (F test of the mean misfits)."""
    if not len(rest) or not rest.any():
        return True
    return bool(fdtrc(len(misfits), len(rest), misfits.mean() / rest.mean()) < CHANCE)


def _misfits(miss: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Converts errors in standard deviations to robust misfits, 0 to 1."""
    return _LOSS.cost(miss**2) / ROBUST_SIGMAS**2
