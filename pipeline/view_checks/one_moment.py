"""Finds views that show another moment or another person than the other views, by the positions of face and lips.

The face landmarks of each view are compared with landmarks triangulated from the other views. The first test measures
the offset of the whole face or of its upper half, whichever is less: it shows that the head has moved, or is another
person's. The second test measures the change of the distance between the lips: it shows that the mouth has opened or
closed. The noise of both offsets has two parts: the common error of a view's landmarks, and the uncertainty of the
other views.

Two changes are not found: a head that moved towards a camera or away from it, and an opening mouth seen from the side.
"""

from collections.abc import Container, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pipeline.faces.detection import FaceDetection
from pipeline.faces.points import direction_from_face, point_table
from pipeline.faces.subject import SubjectFaces
from pipeline.faces.triangulated_face import (
    TriangulatedFace,
    shared_modes,
    triangulate_face,
    unbiased_px,
    view_noise_px,
)
from pipeline.warnings import ReportWarning
from rig.messages.message import compose
from rig.rig import Rig

MAX_SIGMAS = 5.0  # 4.9 in 24 clean studio heads of 410 px, 4.2 in other clean captures; 10 mm aside are 5 to 8 there
OPEN_MM = 3.0  # between lips: 0.4 to 2.3 of eight shut mouths, 4.3 to 11 of six jaws opened by half and fully
OPEN_DIFFERENCE = 0.78  # of the larger opening, between views of one open mouth: 0.76 at most in 50
OPENING_NOISE = 0.15  # of the opening that the other views see, by which lips seen from above or below differ
MIN_FACING = 0.5  # cosine, of a view whose lips are judged: from the side all mouths look shut
MIN_OFFSET_MM = 5.0, 30.0  # of a head from the front and aside: clean ones are up to 5.2 mm (3.3 deviations) and 20 off
# With so many, one that errs by a third of the limits in the face of all passes: in that of the others it is 1.6 times
MIN_JOINT, CAUTION = 6, 3.0
UPPER_LIP, LOWER_LIP = [0, 37, 267, 13, 82, 312, 81, 311], [17, 84, 314, 14, 87, 317, 178, 402]  # of the 468 points


class _Offset(NamedTuple):
    """Holds how far the face in one view, or its lower lip relative to the upper lip, deviates from the other views."""

    sigmas: float
    distance_mm: float
    camera: str


def judge_moments(subject: SubjectFaces | None, rig: Rig) -> list[ReportWarning]:
    """Returns a warning for each view that shows another moment or person. A view with a warning is removed before the
    next search. If only three views exist, all that differ are named, since each of them may be wrong."""
    face, odd = None if subject is None else subject.matched, list[_Offset]()
    if subject is None or face is None:
        return []
    in_place = {name: subject.found[name][0] for name in subject.expected if subject.found.get(name)}
    shown = in_place | dict(face.outliers) | dict(face.detections)
    while len(shown) > 2 and 2 * len(odd) < len(shown):
        over = _list_differing(shown, face.detections, rig)
        if len(shown) == 3 or not over:
            odd += over
            break
        rests = [{name: seen for name, seen in shown.items() if name != one.camera} for one in over]
        left = [_list_differing(rest, face.detections, rig)[:1] for rest in rests] if len(over) > 1 else [[]]
        best = left.index(min(left))  # by the largest offset that is left
        odd, shown = [*odd, over[best]], rests[best]
    return [compose("moments-differ", camera=one.camera, offset_mm=one.distance_mm) for one in odd]


def _list_differing(shown: Mapping[str, FaceDetection], matched: Container[str], rig: Rig) -> list[_Offset]:
    """Returns the views that differ from the other matched views, the worst first."""
    offsets = []
    every = {name: seen for name, seen in shown.items() if name in matched}
    joint = triangulate_face(every, rig) if len(every) >= MIN_JOINT else None
    for name, seen in shown.items():
        if joint is not None and _offset(name, seen, joint, rig, CAUTION).sigmas < MAX_SIGMAS / CAUTION:
            continue
        others = {other: face for other, face in shown.items() if other != name}
        agreeing = {other: face for other, face in others.items() if other in matched}
        face = triangulate_face(agreeing if len(agreeing) > 1 else others, rig)
        if face is not None:
            offsets.append(_offset(name, seen, face, rig))
    return sorted((one for one in offsets if one.sigmas > MAX_SIGMAS), reverse=True)


def _offset(name: str, seen: FaceDetection, face: TriangulatedFace, rig: Rig, caution: float = 1.0) -> _Offset:
    camera, points = rig[name], face.points.positions_world
    aside = direction_from_face(face.world_from_face, camera)[2] < MIN_FACING
    pixels, slopes = camera.project_with_jacobian(points)
    missed = unbiased_px(seen, face.world_from_face, camera) - pixels
    unknown = np.einsum("nij,mnj->mni", slopes, shared_modes(face, rig)).mean(axis=1)
    noise_px = np.hypot(view_noise_px(seen.size_px, face.world_from_face, camera), np.sqrt((unknown**2).sum() / 2.0))
    mm_per_px = float(camera.camera_from_world.apply(points)[:, 2].mean()) / camera.intrinsics.fx
    high = point_table().shape_mm[:, 1]
    upper = high > np.median(high)
    head_px = min(float(np.linalg.norm(np.median(each, axis=0))) for each in (missed, missed[upper]))
    there, seen_there, world = (_lips_apart(each) for each in (pixels, pixels + missed, points))
    lips_px, open_px = float(np.linalg.norm(seen_there - there)), float(np.linalg.norm(there))
    seen_px = float(np.linalg.norm(seen_there))
    both_open = min(float(np.linalg.norm(world)), seen_px * mm_per_px) > OPEN_MM
    both_open &= lips_px < OPEN_DIFFERENCE * max(open_px, seen_px)
    head_px *= caution * head_px * mm_per_px > MIN_OFFSET_MM[int(aside)]
    lips_px *= not both_open and not aside
    by_head = _Offset(head_px / float(noise_px), head_px * mm_per_px, name)
    by_lips = _Offset(lips_px / float(np.hypot(noise_px, OPENING_NOISE * open_px)), lips_px * mm_per_px, name)
    return max(by_head, by_lips)


def _lips_apart(points: Float[np.ndarray, "468 d"]) -> Float[np.ndarray, " d"]:
    """Returns the distance of the lower lip from the upper lip, in the unit of the points (pixels or mm)."""
    return np.median(points[LOWER_LIP], axis=0) - np.median(points[UPPER_LIP], axis=0)
