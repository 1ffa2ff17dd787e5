"""Assigns every picture to the camera that took it, before any measurement in the pictures.

The module returns capture and silhouettes under the right cameras, and the exchanges found. Another camera's clean
plate gives no useful mask, so plates are first matched to pictures by their common background. Pictures with their
plates are then matched to cameras (``pipeline.view_checks.camera_assignment``).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.triangulation import NoPoint, triangulate
from pipeline.view_checks.camera_assignment import (
    FITTING_MISFIT,
    MIN_CAMERAS,
    NOTHING,
    find_assignment,
    own_misfit,
    ring_messages,
)
from pipeline.view_checks.guards import STRICT, Guards
from pipeline.view_checks.mask_edges import TURNS, find_turned_masks, masks_alone_exchanged
from pipeline.view_checks.rig_agreement import explain_disagreement, loose_outlines
from pipeline.warnings import ReportWarning
from rig.capture import Capture, Features, reassign_images, turn_masks
from rig.errors import EigenheadError
from rig.messages.message import Message, compose, some_of
from rig.rig import Rig

MAX_REENCODED = 25  # grey levels, 99 % of the pixels: JPEG of quality 50 changes 14, other views of four captures 78
PLATE_SEEN = 0.6  # share of a picture that its plate explains, below which other plates are tried; 0.6 to 0.8 in good
# ones
PLATE_GAIN = 1.3  # how many times as much of each picture the other plates must explain; another's explains 0 to 0.5
PLATE_COLUMNS = 64
PLATE_TOLERANCE = 0.06  # of log level: 2 % of light drift, vignetting, and noise averaged over 16 x 16 pixels
CLICK_PX, MAX_CLICK_MISFIT = 1.5, 50.0
Segmentation = Callable[[Capture], dict[str, Silhouette]]


@dataclass(frozen=True, slots=True, eq=False)
class ImageAssignment:
    """Holds a capture and its silhouettes with every picture filed under the right camera. For each camera that had a
    wrong picture or plate, ``pictures`` and ``plates`` have the name under which the correct one was filed."""

    capture: Capture
    silhouettes: Mapping[str, Silhouette]
    pictures: Mapping[str, str]
    plates: Mapping[str, str]
    warnings: tuple[ReportWarning, ...]


class ExchangedPictures(EigenheadError):
    """Reports exchanged pictures that were not corrected, because the settings forbid it or the evidence is too
    weak."""

    def __init__(self, found: Sequence[Message], *, doubtful: bool) -> None:
        reason = compose("exchange-doubtful") if doubtful else compose("exchange-not-wanted")
        super().__init__(compose("pictures-exchanged", exchange=found, reason=reason))


class SamePictures(EigenheadError):
    """Reports that several cameras have the same picture and that too few different pictures remain."""

    def __init__(self, duplicates: Mapping[str, str], count: int) -> None:
        names = some_of(sorted({*duplicates, *duplicates.values()}))
        super().__init__(compose("pictures-the-same", count=len(duplicates), all=count, names=names))


class WrongRig(EigenheadError):
    """Reports that the calibrated cameras cannot have taken the pictures."""


def assign_images(
    capture: Capture,
    rig: Rig,
    segmented: Segmentation,
    *,
    exchanged: Literal["repair", "refuse"],
    guards: Guards = STRICT,
) -> ImageAssignment:
    """Segments a capture, and files exchanged pictures and plates under the right cameras.

    ``capture``: the capture as it was read. ``rig``: the cameras as calibrated. ``segmented``: computes the silhouettes
    of a capture; called again after every change. ``exchanged``: whether a certain exchange is repaired or refused.
    ``guards``: decides about refusals.

    Refuses with ExchangedPictures if the settings forbid a repair, or if the exchange is uncertain and the face
    confirms no picture. Refuses with SamePictures if fewer than three pictures differ. Refuses with WrongRig if most
    cameras contradict the others, no exchange is found, and the face does not confirm the rig.
    """
    overruled: list[ReportWarning] = []
    plates = misplaced_plates(capture, rig)
    if plates and exchanged == "refuse":
        exchange = ring_messages(plates, compose("what-plates"))
        overruled.append(guards.refuse(ExchangedPictures(exchange, doubtful=False)))
    capture = reassign_images(capture, plates=plates) if plates else capture
    silhouettes = segmented(capture)
    turned = find_turned_masks(capture.images, silhouettes, capture.masks)
    if turned:
        capture = turn_masks(capture, {name: TURNS[turn] for name, turn in turned.items()})
        silhouettes = segmented(capture)
    for turn in dict.fromkeys(turned.values()):
        names = some_of([name for name in turned if turned[name] == turn])
        overruled.append(compose("masks-turned", turn=turn, cameras=names))
    duplicates = duplicate_views(capture, silhouettes, rig)
    if len(silhouettes) - len(duplicates) < MIN_CAMERAS <= len(silhouettes):
        guards.refuse(SamePictures(duplicates, len(silhouettes)))
    distinct = {name: silhouette for name, silhouette in silhouettes.items() if name not in duplicates}
    assignment = find_assignment(distinct, rig)
    if assignment.pictures and not assignment.overwhelming:
        face = guards.find_face(capture.images, rig)
        if face is not None and not assignment.pictures.keys().isdisjoint(face.views):
            assignment = NOTHING
    masks_given = assignment.pictures.keys() <= capture.masks.keys()
    alone = masks_given and masks_alone_exchanged(capture.images, silhouettes, assignment.pictures)
    masks = assignment.pictures if alone else {}
    what = compose("what-masks") if masks else compose("what-pictures")
    if assignment.pictures and (exchanged == "refuse" or not assignment.overwhelming):
        found = ring_messages(assignment.pictures, what)
        overruled.append(guards.refuse(ExchangedPictures(found, doubtful=not assignment.overwhelming)))
    if not assignment.pictures:
        overruled += _check_rig(capture, rig, distinct, guards)
    pictures = {} if masks else assignment.pictures
    if assignment.pictures:
        capture = reassign_images(capture, masks=masks) if masks else _filed_back(capture, pictures, rig)
        silhouettes = segmented(capture)
    plates = _composed(plates, pictures) if pictures else plates
    loose = not assignment.pictures and loose_outlines(distinct, rig)
    outlines = [compose("outlines-loose")] if loose else []
    warnings = (*overruled, *_warnings(pictures, masks, plates, duplicates), *outlines)
    silhouettes = {n: s.judged(usable=False) if n in duplicates else s for n, s in silhouettes.items()}
    return ImageAssignment(capture, silhouettes, pictures, plates, warnings)


def _check_rig(capture: Capture, rig: Rig, distinct: Mapping[str, Silhouette], guards: Guards) -> list[ReportWarning]:
    """Refuses the calibration of another rig, unless the face confirms the rig. Else returns warnings."""
    wrong = explain_disagreement(distinct, rig)
    if not wrong:
        return []
    face = guards.find_face(capture.images, rig)
    if face is None or not face.holds_the_rig:
        return [guards.refuse(WrongRig(wrong))]
    return [compose("lens-doubtful", finding=wrong)] if wrong.code == "other-lenses" else []


def misplaced_plates(capture: Capture, rig: Rig) -> dict[str, str]:
    """Returns, for each camera that has another camera's clean plate, the name under which its own plate is filed.

    Only cameras whose picture differs much from its plate are compared. An exchange is accepted only if every exchanged
    plate fits its new picture clearly better.
    """
    named = [name for name in rig.names if name in capture.images and capture.backgrounds.get(name)]
    pictures = {name: thumbnail(capture.images[name]) for name in named}
    plates = {name: thumbnail(capture.backgrounds[name][0]) for name in named}
    doubtful = [name for name in named if common_share(pictures[name], plates[name]) < PLATE_SEEN]
    share = np.array([[common_share(pictures[name], plates[other]) for other in doubtful] for name in doubtful])
    if len(doubtful) < 2:
        return {}
    from scipy.optimize import linear_sum_assignment  # loads all of scipy.optimize, and plates are rarely exchanged

    best = linear_sum_assignment(-share)[1]
    moved = np.flatnonzero(best != np.arange(len(doubtful)))
    clear = share[moved, best[moved]] > PLATE_GAIN * share[moved, moved]
    return {doubtful[i]: doubtful[best[i]] for i in moved.tolist()} if clear.all() else {}


def thumbnail(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "r c 3"]:
    """Returns the logarithm of an image's levels, reduced to ``PLATE_COLUMNS`` columns."""
    rows = max(1, round(image.shape[0] * PLATE_COLUMNS / image.shape[1]))
    small = cv2.resize(image, (PLATE_COLUMNS, rows), interpolation=cv2.INTER_AREA)
    return np.log(small.astype(np.float32) + 1.0)


def common_share(picture: Float32[np.ndarray, "r c 3"], plate: Float32[np.ndarray, "_ _ 3"]) -> float:
    """Returns the fraction of the picture's pixels that equal the plate's, apart from a difference in exposure. Picture
    and plate are results of ``thumbnail``."""
    if picture.shape != plate.shape:
        return 0.0
    ratio = (picture - plate).reshape(-1, 3)
    edges = np.arange(-1.5, 1.5, PLATE_TOLERANCE / 2)
    exposure = [edges[int(np.argmax(np.histogram(channel, edges)[0]))] for channel in ratio.T]
    return float((np.abs(ratio - exposure) < PLATE_TOLERANCE).all(axis=1).mean())


def duplicate_views(capture: Capture, silhouettes: Mapping[str, Silhouette], rig: Rig) -> dict[str, str]:
    """Returns the cameras whose picture is a copy of another camera's, perhaps re-encoded, each with the other camera.

    The camera whose silhouette contradicts the other cameras least keeps the picture, if it contradicts them little.
    """
    groups: list[list[str]] = []
    for name in (name for name in rig.names if name in capture.images):
        image = capture.images[name]
        same = next((group for group in groups if _same(capture.images[group[0]], image)), None)
        if same is not None:
            same.append(name)
        elif image.min() < image.max():  # a black picture is a fault of its own
            groups.append([name])
    found: dict[str, str] = {}
    for group in groups:
        if len(group) > 1:
            others = {name: silhouettes[name] for name in silhouettes if name not in group}
            misfit = {name: own_misfit({**others, name: silhouettes[name]}, rig).get(name, 1.0) for name in group}
            owner = min(group, key=lambda name: misfit[name])
            found |= {name: owner for name in group if name != owner}
            if misfit[owner] > FITTING_MISFIT:
                found[owner] = next(name for name in group if name != owner)
    return found


def _same(one: UInt8[np.ndarray, "_ _ 3"], two: UInt8[np.ndarray, "_ _ 3"]) -> bool:
    """Returns True if two pictures differ by no more than JPEG rounding, on a grid of their pixels."""
    if one.shape != two.shape:
        return False
    a, b = (image[::61, ::7].astype(np.int16) for image in (one, two))
    return bool(
        np.percentile(np.abs(a - b), 99) < MAX_REENCODED and (a.std() > MAX_REENCODED or np.array_equal(one, two))
    )


def _composed(plates: Mapping[str, str], pictures: Mapping[str, str]) -> dict[str, str]:
    """Returns, for each camera, the name under which its plates are filed. The result combines the exchange of plates
    among pictures with the exchange of pictures among cameras."""
    found = {}
    for name in plates.keys() | pictures.keys():
        picture = pictures.get(name, name)
        found[name] = plates.get(picture, picture)
    return {name: filed for name, filed in sorted(found.items()) if filed != name}


def _filed_back(capture: Capture, pictures: Mapping[str, str], rig: Rig) -> Capture:
    """Returns the capture with pictures and plates under the right cameras. Feature points move with the pictures or
    stay, whichever gives the smaller triangulation error."""
    moved = reassign_images(capture, pictures=pictures, plates=pictures, points=pictures)
    kept = replace(moved, features=capture.features)
    return min((moved, kept), key=lambda filed: _contradiction(filed.features, rig))


def _contradiction(features: Features, rig: Rig) -> float:
    """Returns the sum of the triangulation misfits of all feature points seen in two or more views."""
    total = 0.0
    for views in features.values():
        known = {name: pixel for name, pixel in views.items() if name in rig}
        if len(known) > 1:
            try:
                misfit = triangulate(known, rig, noise_px=CLICK_PX).misfit(CLICK_PX)
            except NoPoint:
                misfit = MAX_CLICK_MISFIT
            total += min(misfit, MAX_CLICK_MISFIT)
    return total


def _warnings(
    pictures: Mapping[str, str], masks: Mapping[str, str], plates: Mapping[str, str], duplicates: Mapping[str, str]
) -> tuple[ReportWarning, ...]:
    found = []
    if pictures:
        found.append(compose("cameras-exchanged", exchange=ring_messages(pictures, compose("what-pictures"))))
    if masks:
        found.append(compose("masks-exchanged", exchange=ring_messages(masks, compose("what-masks"))))
    if plates and not pictures:
        found.append(compose("plates-exchanged", exchange=ring_messages(plates, compose("what-plates"))))
    for name, owner in duplicates.items():
        found.append(compose("picture-duplicated", camera=name, owner=owner))
    return tuple(found)
