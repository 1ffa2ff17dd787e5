"""Converts the findings of one set of pictures to each camera's indicator lamps and to instructions before a shot.

All limits for lamps and instructions are defined here. Most instructions appear after their cause has lasted ``HOLD_S``
seconds, so a blink has no effect, and disappear with it.
"""

from collections import deque
from collections.abc import Iterator
from statistics import median

import numpy as np

from rig.acquisition.face_sighting import TURNED_DEG
from rig.geometry import vector_from_rotation
from rig.messages.message import compose
from server.services.live.seen import CameraSeen, HeadOut, LampsOut, Seen, Word

HOLD_S = 0.4  # longer than a blink
AT_ONCE = frozenset({"live-black", "live-darker", "live-brighter", "live-soft"})  # no subject does that in passing
STEADY_S, STEADY_MM, STEADY_DEG = 0.7, 2.5, 1.2  # a still head's landmarks move it by a third of that
SOFT_PX = 1.2  # on the face, picture 640 wide: sharp ones have 0 to 0.5, 4 px of 1024 out of focus 1.4 to 1.6
DARKER, BRIGHTER = 0.75, 1.35  # than its clean plate, by the median camera: 0.97 to 1.03 on a subject of the studio
DARKER_SEEN, BRIGHTER_SEEN = 0.6, 1.7  # than the other cameras, without clean plates: they see other things
ALL_DARK = 0.4  # of the median camera against its plate
BLACK = 0.1
CHIN_DEG = 25.0  # up or down; a stranger's face is known to 9 degrees that way on six drawn heads, to 2 sideways
LEVEL = 64.0  # of a studio's pictures, where there are no plates (rig.acquisition.judgement)
CLIPPED = 0.05  # share of the picture
LOOKING = 0.5  # cosine: both eyes are seen


class Speaker:
    """Converts successive sets of findings to lamps and instructions, remembering the last second's findings."""

    def __init__(self) -> None:
        self._since: dict[tuple[str, str | None], float] = {}
        self._poses: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=64)

    def words(self, seen: Seen, time_s: float) -> tuple[Word, ...]:
        """Returns the instructions at ``time_s`` (a monotonic clock)."""
        reasons = list(reasons_of(seen))
        keys = [(word.message.code, word.camera) for word in reasons]
        self._since = {key: self._since.get(key, time_s) for key in keys}
        held_s = [0.0 if code in AT_ONCE else HOLD_S for code, _ in keys]
        triples = zip(reasons, keys, held_s, strict=True)
        return tuple(word for word, key, least_s in triples if time_s - self._since[key] >= least_s)

    def steady(self, head: HeadOut | None, time_s: float) -> bool:
        """Returns whether the head has kept its pose for ``STEADY_S`` seconds."""
        if head is None:
            self._poses.clear()
            return False
        now = np.array(head.rotation).reshape(3, 3), np.array(head.translation)
        self._poses.append((time_s, *now))
        while time_s - self._poses[0][0] > 2.0 * STEADY_S:
            self._poses.popleft()
        lately = [pose for pose in self._poses if time_s - pose[0] <= STEADY_S]
        turns = [float(np.degrees(np.linalg.norm(vector_from_rotation(now[0] @ turn.T)))) for _, turn, _ in lately]
        shifts = [float(np.linalg.norm(now[1] - shift)) for _, _, shift in lately]
        return time_s - self._poses[0][0] >= STEADY_S and max(turns) < STEADY_DEG and max(shifts) < STEADY_MM


def lamps_of(seen: Seen) -> dict[str, LampsOut]:
    """Returns the lamps of every camera."""
    light = dict(_light(seen))
    return {
        name: LampsOut(
            face=camera.face,
            sharp=None if camera.blur_px is None else camera.blur_px <= SOFT_PX,
            exposed=name not in light and camera.clipped <= CLIPPED,
            centred=camera.centred,
            looking=None if camera.facing is None else camera.facing >= LOOKING,
            points=camera.points,
        )
        for name, camera in seen.cameras.items()
    }


def reasons_of(seen: Seen) -> Iterator[Word]:
    """Yields the instructions that follow from these findings alone, those for the subject first."""
    if not seen.calibrated:
        yield Word(compose("live-uncalibrated"))
    elif not seen.cameras:
        yield Word(compose("live-no-pictures"))
    elif seen.head is None:
        yield Word(compose("live-faces-differ" if seen.faces else "live-nobody"))
    else:
        yield from _of_head(seen.head)
    light = dict(_light(seen))
    about_all = [word for word in light.values() if word.camera is None]
    yield from about_all[:1] or light.values()
    yield from (Word(compose("live-no-picture", camera=name), name) for name in seen.missing)
    for name, camera in seen.cameras.items():
        if name not in light:
            yield from _of_camera(name, camera)


def _of_head(head: HeadOut) -> Iterator[Word]:
    if abs(head.left_deg) > TURNED_DEG:
        yield Word(
            compose("live-turn-right" if head.left_deg > 0.0 else "live-turn-left", angle_deg=abs(head.left_deg))
        )
    if abs(head.up_deg) > CHIN_DEG:
        yield Word(compose("live-chin-down" if head.up_deg > 0.0 else "live-chin-up"))
    ways = (
        (head.away_mm, head.depth_mm, "live-closer", "live-back"),
        (head.down_mm, head.room_mm, "live-higher", "live-lower"),
        (head.right_mm, head.room_mm, "live-move-right", "live-move-left"),  # the subject's own sides
    )
    for off_mm, room_mm, beyond, before in ways:
        if abs(off_mm) > room_mm:
            code = beyond if off_mm > 0.0 else before
            yield Word(compose(code, cm=abs(off_mm) / 10.0))
    if head.eyes_open is False:
        yield Word(compose("live-eyes-shut"))


def _of_camera(name: str, camera: CameraSeen) -> Iterator[Word]:
    if camera.clipped > CLIPPED:
        yield Word(compose("live-burnt-out", camera=name, percent=100.0 * camera.clipped), name)
    if camera.blur_px is not None and camera.blur_px > SOFT_PX:
        yield Word(compose("live-soft", camera=name), name)
    if camera.stranger:
        yield Word(compose("live-stranger", camera=name), name)
    elif camera.face is False:
        yield Word(compose("live-no-face", camera=name), name)
    elif camera.centred is False:
        yield Word(compose("live-off-centre", camera=name), name)


def _light(seen: Seen) -> Iterator[tuple[str, Word]]:
    """Yields an instruction for each camera with a wrong brightness, relative to its clean plate or to the others."""
    against = {name: camera.light for name, camera in seen.cameras.items() if camera.light is not None}
    plated = len(against) == len(seen.cameras)
    ratios = against if plated else {name: camera.mean / LEVEL for name, camera in seen.cameras.items()}
    common = median(ratios.values()) if ratios else 1.0
    if common < ALL_DARK:
        yield from ((name, Word(compose("live-lights", percent=100.0 * common))) for name in ratios)
        return
    for name, ratio in ratios.items():
        share = ratio / common if len(ratios) > 2 else ratio
        if ratio < BLACK:
            yield name, Word(compose("live-black", camera=name), name)
        elif share < (DARKER if plated else DARKER_SEEN):
            code = "live-darker" if plated else "live-darker-than-others"
            yield name, Word(compose(code, camera=name, percent=100.0 * share), name)
        elif share > (BRIGHTER if plated else BRIGHTER_SEEN):
            code = "live-brighter" if plated else "live-brighter-than-others"
            yield name, Word(compose(code, camera=name, percent=100.0 * share), name)
