"""Checks, before the fit, whether the calibration belongs to the pictures, by means of the silhouettes.

If most cameras contradict the others, other interpretations of the calibration are tried. The pictures may be mirrored,
flipped, or rotated by 180 degrees, or by 90 if square. Poses may follow another convention (``rig.plausibility``).
Intrinsics may belong to pictures that were cropped, reduced or taken at another zoom (``LensReading``). The message
names the interpretation under which epipolar tangent planes touch both outlines of each pair of cameras. If no
interpretation fits, the calibration belongs to another rig, or the rig was changed. If many planes nevertheless agree
closely, the masks are loose: they include a shadow on the wall, or some lack hair. If a single camera contradicts the
others, the message names it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.imaging.silhouette import Silhouette
from pipeline.view_checks.camera_assignment import FITTING_MISFIT, mean_misfit, outlined, tangency_errors_px
from rig.camera import Intrinsics
from rig.messages.message import Message, compose
from rig.plausibility import alternative_conventions
from rig.rig import Rig

MIN_CAMERAS = 4  # three have six planes at most: too few to refuse a capture by
MIN_PLANES = 4  # of a camera whose word counts
MIN_WRONG = 0.35  # median over the cameras of their mean misfit: 0.07 in a good capture, 0.62 and more in other rigs
MAX_RIGHT = 0.25  # of a reading that is believed
MAX_CLEAR = 0.32  # of one by which the others are worse: 0.28 where the wrong rig has spoilt the outlines, which are
# found with each other's help ...
CLEARLY = 0.45  # ... and its share of theirs: 0.34 there
MANY_LOST = 0.33  # share of the views that only the others contradict, so that they are asked too: 6 of 11 of a wrong
# rig
JUDGED_BY_OTHERS = "strange_share"  # a figure of views that were of use before the others were asked
MAX_LENSES = 0.2  # of one in which focal lengths and principal points were sought: 0.01 to 0.15 where they are wrong
# Of the picture's width, that half of all planes miss at most in a right rig with loose masks: 50e-4 with long hair
# in 8 to 24 views; 58e-4 and more of other arrangements whose better quarter misses less than the bound below.
LOOSE_HALF = 54e-4
LOOSE_BIMODAL, MAX_LOOSE_QUARTER = 0.28, 35e-4  # a better quarter's share of it: shadows spoil some planes and leave
# others whole, 0.03 to 0.25 with shadows in all of 11 views; a wrong rig's misses have one spread, 0.34 and more
MIN_MISPLACED = 0.6  # of one camera among good ones: 0.95 with its rotation transposed; good ones reach 0.25
MISPLACED_AMONG = 5  # cameras; of four, one that is wrong leaves three, who have six planes at most

FACTORS = (1.0, 0.5, 0.67, 1.5, 2.0)  # of the focal lengths, of which the best are searched from
MAX_SEARCHED_CAMERAS = 12  # of many: the search takes time by their square, and three numbers need no more
SEARCHES, STEPS = 2, 90  # and how often the misses are asked in each
MIRRORED = {"rig-mirrored", "pictures-flipped"}
STRIDE = 0.1  # of a factor's logarithm, and of a picture's side
OTHER_FACTOR, OTHER_SHIFT = 0.15, 0.03  # of a factor's logarithm and a side: what makes a rig contradict itself
MIN_FACTOR = 0.04  # from one; less is not told
MIN_SHIFT = 0.02  # of the picture's width; less is not told

Pixels = Float[np.ndarray, "_ 2"]
Turn = Callable[[Pixels, Intrinsics], Pixels]


def explain_disagreement(silhouettes: Mapping[str, Silhouette], rig: Rig) -> Message | None:
    """Finds out why most cameras contradict each other: pictures are rotated or mirrored, the calibration has another
    convention or other lenses, or it belongs to another rig. Returns a message with the remedy; None if most cameras
    agree or only the masks are loose.

    Args:
        silhouettes: by camera; views without a usable mask are ignored.
        rig: the cameras as calibrated.
    """
    usable = {name for name, s in silhouettes.items() if s.quality.usable}
    found = _contradiction(*outlined({name: silhouettes[name] for name in usable}, rig))
    lost = {name for name, s in silhouettes.items() if JUDGED_BY_OTHERS in s.quality.figures} - usable
    if found is not None or len(lost) < MANY_LOST * len(silhouettes):
        return found
    among_all = outlined({name: silhouettes[name] for name in usable | lost}, rig)
    named = _contradiction(*among_all)  # views that a wrong rig alone makes contradict each other
    return None if named is None or named.code == "other-rig" else named


def _contradiction(seen: Rig, hulls: Sequence[Pixels]) -> Message | None:
    """Returns a message why most of the cameras ``seen`` contradict each other; None if they do not."""
    if len(seen) < MIN_CAMERAS:
        return None
    as_written = _median_misfit(hulls, seen)
    if not as_written >= MIN_WRONG:
        return None
    square = all(camera.intrinsics.width == camera.intrinsics.height for camera in seen)
    conventions = (*_CONVENTIONS, *(_SQUARE_CONVENTIONS if square else ()))
    found = [(_judged_misfit(_read(hulls, seen, turn), seen), message) for message, turn in conventions]
    for other, read, remedy in alternative_conventions(seen):
        message = compose("other-convention", convention=other, remedy=remedy)
        found.append((_judged_misfit(hulls, read), message))
    from_below = seen.with_intrinsics(lambda k: replace(k, cy=k.height - 1.0 - k.cy))
    found.append((_judged_misfit(hulls, from_below), compose("principal-points-from-below")))
    on_side = seen.with_intrinsics(
        lambda k: replace(k, width=k.height, height=k.width, fx=k.fy, fy=k.fx, cx=k.cy, cy=k.cx)
    )
    for message, turn in () if square else _SQUARE_CONVENTIONS:  # width and height were exchanged with the pictures
        found.append((_judged_misfit(_read(hulls, seen, turn), on_side), message))
    (best, message), *others = sorted(found, key=lambda one: one[0])
    kin = MIRRORED if message.code in MIRRORED else ()  # where the lens's axis is in the middle, they are one
    next_best = min(as_written, *(misfit for misfit, other in others if other != message and other.code not in kin))
    if best <= MAX_RIGHT or (best <= MAX_CLEAR and best <= CLEARLY * next_best):
        return message
    lenses = find_lens_reading(hulls, seen, lambda read: _judged_misfit(hulls, read))
    if lenses.is_other and _judged_misfit(hulls, lenses.rig) <= MAX_LENSES:
        return lenses.message()
    return None if are_loose(_missed_shares(hulls, seen)) else compose("other-rig")


def _judged_misfit(hulls: Sequence[Pixels], rig: Rig) -> float:
    misfit = _median_misfit(hulls, rig)
    return misfit if np.isfinite(misfit) else 1.0


def loose_outlines(silhouettes: Mapping[str, Silhouette], rig: Rig) -> bool:
    """Returns True if most outlines contradict the others because of loose masks, provided that
    ``explain_disagreement`` finds no fault."""
    seen, hulls = outlined({name: s for name, s in silhouettes.items() if s.quality.usable}, rig)
    return len(seen) >= MIN_CAMERAS and _median_misfit(hulls, seen) >= MIN_WRONG


@dataclass(frozen=True, slots=True, eq=False)
class LensReading:
    """Holds the rig with all focal lengths multiplied by ``factor`` and all principal points moved by ``shift``
    (relative to the pictures' width and height)."""

    rig: Rig
    factor: float
    shift: tuple[float, float]

    @property
    def is_other(self) -> bool:
        """Returns True if the intrinsics differ from the calibrated ones by more than loose masks explain."""
        return bool(abs(np.log(self.factor)) >= OTHER_FACTOR or max(map(abs, self.shift)) >= OTHER_SHIFT)

    def message(self) -> Message:
        """Returns the message that the rig's intrinsics are wrong, with their difference."""
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
        misfit: function that returns the misfit of a rig.
    """
    from scipy.optimize import minimize  # a quarter of a second, and few rigs are wrong

    searched = np.unique(np.linspace(0, len(rig) - 1, MAX_SEARCHED_CAMERAS).round().astype(int))
    some, some_hulls = Rig(tuple(rig.cameras[k] for k in searched)), [hulls[k] for k in searched]

    def cost(at: Float[np.ndarray, " 3"]) -> float:
        misses = np.abs(tangency_errors_px(some_hulls, _with_lenses(some, at)))
        known = misses[np.isfinite(misses)]
        return float(np.mean(np.sqrt(known))) if len(known) >= misses.size / 4 else 1e6

    found = []
    for start in sorted((np.array([np.log(factor), 0.0, 0.0]) for factor in FACTORS), key=cost)[:SEARCHES]:
        simplex = start + np.vstack([np.zeros(3), STRIDE * np.eye(3)])
        options = {"initial_simplex": simplex, "maxfev": STEPS, "xatol": 1e-4, "fatol": 1e-4}
        found.append(minimize(cost, start, method="Nelder-Mead", options=options).x)
    log_factor, right, down = min(found, key=lambda at: misfit(_with_lenses(rig, at)))
    read = _with_lenses(rig, np.array([log_factor, right, down]))
    return LensReading(read, float(np.exp(log_factor)), (float(right), float(down)))


def _with_lenses(rig: Rig, at: Float[np.ndarray, " 3"]) -> Rig:
    factor, (right, down) = float(np.exp(np.clip(at[0], -2.0, 2.0))), at[1:].tolist()
    return rig.with_intrinsics(
        lambda k: replace(k, fx=k.fx * factor, fy=k.fy * factor, cx=k.cx + right * k.width, cy=k.cy + down * k.height)
    )


def misplaced_camera(silhouettes: Mapping[str, Silhouette], rig: Rig) -> str | None:
    """Returns the single camera that contradicts all others, if the others agree; else None. A camera that contradicts
    all others was moved farther than ``camera_drift`` can measure, or its pose or mask is wrong."""
    seen, hulls = outlined({name: s for name, s in silhouettes.items() if s.quality.usable}, rig)
    if len(seen) < MISPLACED_AMONG:
        return None
    errors_px = tangency_errors_px(hulls, seen)
    misfit, planes = mean_misfit(errors_px), np.isfinite(errors_px).sum(axis=(1, 2))
    worst = int(np.argmax(misfit))
    if misfit[worst] < MIN_MISPLACED or planes[worst] < MIN_PLANES:
        return None
    others = np.delete(np.arange(len(seen)), worst)
    agree = mean_misfit(errors_px[np.ix_(others, others)]).max() <= FITTING_MISFIT
    return seen.names[worst] if agree else None


def _median_misfit(hulls: Sequence[Pixels], rig: Rig) -> float:
    """Returns the median over the cameras of the mean robust misfit (0 to 1) of their tangent planes; NaN if too few
    cameras have enough planes."""
    errors_px = tangency_errors_px(hulls, rig)
    speaking = np.isfinite(errors_px).sum(axis=(1, 2)) >= MIN_PLANES
    return float(np.median(mean_misfit(errors_px)[speaking])) if speaking.sum() >= MIN_CAMERAS else np.nan


def are_loose(missed: Float[np.ndarray, "c c p"]) -> bool:
    """Returns True if so many tangent planes agree closely that the calibration is right and the masks are loose.
    ``missed`` is the error of each plane at each other camera's outline, as a fraction of the picture's width; NaN
    without a plane."""
    quarter, half = np.nanquantile(missed, (0.25, 0.5))
    return bool(quarter <= MAX_LOOSE_QUARTER and (half <= LOOSE_HALF or quarter <= LOOSE_BIMODAL * half))


def _missed_shares(hulls: Sequence[Pixels], rig: Rig) -> Float[np.ndarray, "c c p"]:
    widths = np.array([camera.intrinsics.width for camera in rig], float)
    together = np.hypot(widths[:, None], widths[None, :]) / np.sqrt(2.0)
    return np.abs(tangency_errors_px(hulls, rig)) / together[..., None]


def _read(hulls: Sequence[Pixels], rig: Rig, turn: Turn) -> list[Pixels]:
    return [turn(hull, camera.intrinsics) for hull, camera in zip(hulls, rig, strict=True)]


# Other ways to read a picture's pixels (x, y), each with what is said if the outlines agree so.
_CONVENTIONS: tuple[tuple[Message, Turn], ...] = (
    (compose("rig-mirrored"), lambda p, k: p * (-1.0, 1.0) + (2.0 * k.cx, 0.0)),
    (compose("rig-mirrored"), lambda p, k: p * (1.0, -1.0) + (0.0, 2.0 * k.cy)),
    (compose("pictures-flipped", turn=compose("flip-across")), lambda p, k: p * (-1.0, 1.0) + (k.width - 1.0, 0.0)),
    (compose("pictures-flipped", turn=compose("flip-down")), lambda p, k: p * (1.0, -1.0) + (0.0, k.height - 1.0)),
    (compose("pictures-turned", turn=compose("turn-180")), lambda p, k: (k.width - 1.0, k.height - 1.0) - p),
)
_QUARTER_TURNS: tuple[tuple[Message, Turn], ...] = (
    (compose("turn-90-anticlockwise"), lambda p, k: p[:, ::-1] * (-1.0, 1.0) + (k.height - 1.0, 0.0)),
    (compose("turn-90-clockwise"), lambda p, k: p[:, ::-1] * (1.0, -1.0) + (0.0, k.width - 1.0)),
)
_SQUARE_CONVENTIONS = tuple((compose("pictures-turned", turn=turn), read) for turn, read in _QUARTER_TURNS)
