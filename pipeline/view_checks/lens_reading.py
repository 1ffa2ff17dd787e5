"""Finds intrinsics with which the outlines agree, if those of the calibration contradict them for the whole rig.

If pictures were cropped, reduced, or taken at another zoom than those of the calibration, the poses are still right.
One factor on all focal lengths and one shift of all principal points (relative to the picture's size) then correct the
rig. For another rig there is no such correction.

Enters: the convex hulls of the outlines, and the rig. Leaves: the intrinsics that fit, to be judged.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.view_checks.camera_assignment import tangency_errors_px
from rig.messages.message import Message, compose
from rig.rig import Rig

Pixels = Float[np.ndarray, "_ 2"]
FACTORS = (1.0, 0.5, 0.67, 1.5, 2.0)  # of the focal lengths, of which the best are searched from
MAX_SEARCHED_CAMERAS = 12  # of many: the search takes time by their square, and three numbers need no more
SEARCHES, STEPS = 2, 90  # and how often the misses are asked in each
STRIDE = 0.1  # of a factor's logarithm, and of a picture's side
OTHER_FACTOR, OTHER_SHIFT = 0.15, 0.03  # of a factor's logarithm and a side: what makes a rig contradict itself
MIN_FACTOR = 0.04  # from one; less is not told
MIN_SHIFT = 0.02  # of the picture's width; less is not told


@dataclass(frozen=True, slots=True, eq=False)
class LensReading:
    """Holds the rig with all focal lengths multiplied by ``factor`` and all principal points moved by ``shift``
    (relative to the pictures' width and height)."""

    rig: Rig
    factor: float
    shift: tuple[float, float]

    @property
    def is_other(self) -> bool:
        """Tells whether the intrinsics differ from the calibrated ones by more than loose outlines alone would
        cause."""
        return bool(abs(np.log(self.factor)) >= OTHER_FACTOR or max(map(abs, self.shift)) >= OTHER_SHIFT)

    def message(self) -> Message:
        """Returns the message that refuses the rig and says by how much its lenses differ."""
        k = self.rig.cameras[0].intrinsics
        changes = []
        if abs(self.factor - 1.0) >= MIN_FACTOR:
            changes.append(compose("focal-lengths-times", factor=self.factor))
        if max(map(abs, self.shift)) >= MIN_SHIFT:
            right, down = self.shift[0] * k.width, self.shift[1] * k.height
            changes.append(compose("principal-points-moved", right_px=right, down_px=down))
        return compose("other-lenses", changes=changes)


def find_lens_reading(hulls: Sequence[Pixels], rig: Rig, misfit: Callable[[Rig], float]) -> LensReading:
    """Searches for the focal factor and principal shift with the smallest ``misfit``, starting from several focal
    lengths (``FACTORS``).

    Args:
        hulls: convex hulls of the outlines (px), in the order of the rig.
        rig: the cameras as calibrated.
        misfit: returns how badly a rig fits.
    """
    from scipy.optimize import minimize  # a quarter of a second, and few rigs are wrong

    searched = np.unique(np.linspace(0, len(rig) - 1, MAX_SEARCHED_CAMERAS).round().astype(int))
    some, some_hulls = Rig(tuple(rig.cameras[k] for k in searched)), [hulls[k] for k in searched]

    def cost(at: Float[np.ndarray, " 3"]) -> float:
        misses = np.abs(tangency_errors_px(some_hulls, _read(some, at)))
        known = misses[np.isfinite(misses)]
        return float(np.mean(np.sqrt(known))) if len(known) >= misses.size / 4 else 1e6

    found = []
    for start in sorted((np.array([np.log(factor), 0.0, 0.0]) for factor in FACTORS), key=cost)[:SEARCHES]:
        simplex = start + np.vstack([np.zeros(3), STRIDE * np.eye(3)])
        options = {"initial_simplex": simplex, "maxfev": STEPS, "xatol": 1e-4, "fatol": 1e-4}
        found.append(minimize(cost, start, method="Nelder-Mead", options=options).x)
    log_factor, right, down = min(found, key=lambda at: misfit(_read(rig, at)))
    read = _read(rig, np.array([log_factor, right, down]))
    return LensReading(read, float(np.exp(log_factor)), (float(right), float(down)))


def _read(rig: Rig, at: Float[np.ndarray, " 3"]) -> Rig:
    factor = float(np.exp(np.clip(at[0], -2.0, 2.0)))
    cameras = []
    for camera in rig:
        k = camera.intrinsics
        cx, cy = k.cx + float(at[1]) * k.width, k.cy + float(at[2]) * k.height
        cameras.append(replace(camera, intrinsics=replace(k, fx=k.fx * factor, fy=k.fy * factor, cx=cx, cy=cy)))
    return Rig(tuple(cameras))
