"""Turns detections of the subject's face in a shot into remarks for the operator.

``pipeline.faces`` finds the face and creates the ``FaceSighting``. Remarks are no faults: a head can be reconstructed
if the face is turned away, or if the face detector fails, for example on a statue."""

from collections.abc import Iterable
from dataclasses import dataclass

from rig.acquisition.shot import Fault
from rig.messages.message import Message, compose

TURNED_DEG = 15.0  # people who look into a camera are within 8 of it (the rendered captures' subjects: 13)
EXPLAINING = frozenset(
    {"empty", "cut-off", "dark", "lights-off", "view", "swapped", "overexposed", "blurred", "frozen"}
)
"""Faults of a camera with which nobody wonders that its picture shows no face."""


@dataclass(frozen=True, slots=True)
class FaceSighting:
    """Holds the cameras that see the subject's face, and the direction of the face.

    ``searched`` is the number of searched pictures. ``missing`` lists the cameras in front of the face whose pictures
    do not show the face. ``left_deg`` and ``up_deg`` are the angles of the face to the subject's left and up, relative
    to the camera ``front``. Both angles are None without a face, and if cameras all around the subject leave the front
    undefined. ``remarks`` holds further observations, such as closed eyes.
    """

    searched: int
    is_found: bool
    has_faces: bool  # some picture shows a face, be it the subject's or not
    front: str
    missing: tuple[str, ...] = ()
    left_deg: float | None = None
    up_deg: float | None = None
    remarks: tuple[Message, ...] = ()


def face_remarks(sighting: FaceSighting | None, faults: Iterable[Fault]) -> tuple[Message, ...]:
    """Returns remarks on the cameras that do not show the face, and on the face's direction. Cameras with a fault in
    ``EXPLAINING`` get no remark. If a fault in ``EXPLAINING`` concerns the whole rig, returns no remarks."""
    explained = {fault.camera for fault in faults if fault.code in EXPLAINING}
    if sighting is None or None in explained:
        return ()
    if not sighting.is_found:
        return () if sighting.has_faces else (compose("face-nowhere", count=sighting.searched),)
    missing = [name for name in sighting.missing if name not in explained]
    remarks = [compose("face-missing", cameras=missing)] if missing else []
    ways = _ways(sighting)
    if ways:
        way = ways[0] if len(ways) == 1 else compose("look-both", across=ways[0], upwards=ways[1])
        remarks.append(compose("face-turned", way=way, camera=sighting.front))
    return (*remarks, *sighting.remarks)


def _ways(sighting: FaceSighting) -> list[Message]:
    """Returns the directions (left or right, up or down) in which the face is turned by more than ``TURNED_DEG``."""
    left, up = sighting.left_deg or 0.0, sighting.up_deg or 0.0
    ways = []
    if abs(left) > TURNED_DEG:
        ways.append(compose("look-left", angle_deg=left) if left > 0.0 else compose("look-right", angle_deg=-left))
    if abs(up) > TURNED_DEG:
        ways.append(compose("look-up", angle_deg=up) if up > 0.0 else compose("look-down", angle_deg=-up))
    return ways
