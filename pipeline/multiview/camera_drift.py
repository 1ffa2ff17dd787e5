"""Has a camera moved since the calibration? Asked of every capture, before the fit, of the silhouettes alone.

The planes through two camera centres that touch the subject touch both silhouettes: epipolar tangency, at frontier
points (Ramanathan, Steinbach and Girod 2000, the paper's reference for calibration from silhouettes). Hair and
shoulders are as good as skin, since the subject is rigid within a shot. Eleven cameras give about fifty such equations,
good to 0.2 px. A camera that was turned by a small angle shifts its whole image; its equations then agree on one shift,
and only its own do.

Enters: silhouettes and the rig. Leaves: the cameras that have moved, how far, how sure.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.robust import GemanMcClure
from pipeline.estimation.terms import Problem, Quadratic, Residuals
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.tangency import Tangency, find_tangencies
from rig.camera import Camera
from rig.rig import Rig

NOISE_FLOOR_PX = 0.4  # of one tangency: two contours of 0.25 px, never less however well they agree by chance
ROBUST_SIGMAS = 3.0
EQUATIONS_LEAST = 5  # of a camera: two unknowns, and enough left over to judge them
INDEPENDENT_LEAST = 0.3  # sine of the angle between two normals whose crossing is proposed
NO_SHIFT_INFORMATION = 1e-6  # px^-2: keeps a shift that no normal sees at zero
SIGMAS_LEAST, SHIFT_LEAST_PX = 6.0, 1.5  # docs/results.md: false alarms against misses
GAIN_LEAST = 0.4  # share of the camera's own robust misfit that its shift must explain, and of all but one of them


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """A camera that has moved: its image's shift (px) and standard deviation, the turn that explains it, and how many
    standard deviations that is."""

    camera: str
    shift_px: Float[np.ndarray, " 2"]
    deviation_px: float
    turn_deg: float
    sigmas: float

    def __str__(self) -> str:
        return (
            f"{self.camera} has moved by {np.linalg.norm(self.shift_px):.1f} px in its image "
            f"(a turn of {self.turn_deg:.2f} degrees, {self.sigmas:.0f} standard deviations) and is left out: "
            "fasten it and calibrate again"
        )


def find_drift(silhouettes: Mapping[str, Silhouette], rig: Rig) -> tuple[Drift, ...]:
    """Cameras that no longer stand where their calibration says, the farthest moved first.

    One after the other: what the worst camera does to its neighbours' equations goes with it.
    """
    usable = rig.subset(name for name in rig.names if name in silhouettes and silhouettes[name].quality.usable)
    tangencies = find_tangencies(silhouettes, usable)
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
    """The shift that the camera's own equations agree on, if there is one worth an alarm."""
    rows, excess = _equations(name, tangencies)
    if len(rows) < EQUATIONS_LEAST:
        return None
    others = [t.excess_px[0] for t in tangencies if name not in t.cameras]
    noise = max(NOISE_FLOOR_PX, 1.4826 * float(np.median(np.abs(others)))) if others else NOISE_FLOOR_PX
    shift, information = _robust_shift(rows, excess, noise)
    before, after = _misfits(excess, noise), _misfits(excess - rows @ shift, noise)
    deviation = float(np.sqrt(np.trace(np.linalg.inv(information + 1e-9 * np.eye(2)))))
    size = float(np.linalg.norm(shift))
    sigmas = float(np.sqrt(shift @ information @ shift))
    if sigmas < SIGMAS_LEAST or size < SHIFT_LEAST_PX or not _explains(before, after):
        return None
    turn = np.degrees(np.arctan(size / camera.intrinsics.fx))
    return Drift(name, shift, deviation, float(turn), sigmas)


def _equations(name: str, tangencies: list[Tangency]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    rows, excess = [], []
    for tangency in tangencies:
        for side in range(2):
            if tangency.cameras[side] == name:
                rows.append(tangency.normals[side])
                excess.append(tangency.excess_px[side])
    return np.array(rows).reshape(-1, 2), np.array(excess)


@dataclass(frozen=True, slots=True, eq=False)
class ShiftTerm:
    """``(normal . shift - excess) / noise`` of one camera's tangencies, with Geman and McClure's loss."""

    normals: Float[np.ndarray, "n 2"]
    excess_px: Float[np.ndarray, " n"]
    noise_px: float

    def at(self, shift_px: Float[np.ndarray, " 2"]) -> Residuals:
        miss = (self.normals @ shift_px - self.excess_px) / self.noise_px
        return Residuals(miss[:, None], lambda: self.normals[:, None] / self.noise_px, GemanMcClure(ROBUST_SIGMAS))


def _robust_shift(rows: np.ndarray, excess: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """The shift (px) of least robust misfit, and its information: from the best of those that pairs of equations
    propose. Where the equations are all of one direction, the shift stays zero across it."""
    term = ShiftTerm(rows, excess, noise)
    proposals = [np.zeros(2)]
    for i, j in combinations(range(len(rows)), 2):
        pair = rows[[i, j]]
        if abs(np.linalg.det(pair)) > INDEPENDENT_LEAST:
            proposals.append(np.linalg.solve(pair, excess[[i, j]]))
    misfits = _misfits(excess[None, :] - np.array(proposals) @ rows.T, noise).sum(axis=1)
    problem = Problem((term, Quadratic.prior(NO_SHIFT_INFORMATION * np.eye(2), np.zeros(2))), 2, np.add)
    found = minimise(problem, proposals[int(np.argmin(misfits))], Limits(tolerance=1e-6))
    return found.value, problem.equations(found.at).matrix - NO_SHIFT_INFORMATION * np.eye(2)


def _explains(before: Float[np.ndarray, " n"], after: Float[np.ndarray, " n"]) -> bool:
    """Whether the shift takes enough of the misfits away, and not of a single one alone: a bad stretch of one outline
    is met by one tangent plane, a moved camera by all of its own."""
    others = np.arange(len(before)) != np.argmax(before - after)
    return all(after[k].sum() <= (1.0 - GAIN_LEAST) * before[k].sum() for k in (slice(None), others))


def _misfits(miss: Float[np.ndarray, "*n"], noise: float) -> Float[np.ndarray, "*n"]:
    """Robust misfit of each equation, 0 to 1."""
    return GemanMcClure(ROBUST_SIGMAS).cost((miss / noise) ** 2) / ROBUST_SIGMAS**2
