"""Decides, before a fit, which views of a capture are used, and gives reasons for the excluded views.

The module returns every picture under its own camera, silhouettes with the unreliable ones marked, and warnings.
``reconstruct`` begins with this step; the command ``eigenhead check`` runs only this step.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.view_checks.camera_assignment import FITTING_MISFIT, own_misfit
from pipeline.view_checks.camera_drift import find_drift
from pipeline.view_checks.guards import STRICT, Guards
from pipeline.view_checks.head_size import find_low_crowns, judge_head_size
from pipeline.view_checks.image_assignment import assign_images, common_share, thumbnail
from pipeline.view_checks.mask_edges import TURNS, masks_off_edges
from pipeline.view_checks.rig_agreement import misplaced_camera
from pipeline.warnings import ReportWarning
from rig.capture import Capture
from rig.colour_space import linear_from_srgb
from rig.errors import EigenheadError
from rig.image import ImageRgb
from rig.messages.message import Message, compose, say_once
from rig.rig import Rig

MIN_VIEWS = 3
MIN_VIEWS_OF_FACE = 2  # of three or more cameras, where the face holds the pose
MIN_AREA = 0.01  # of a picture: a smaller mask is no subject even if everything is to be tried


class TooFewViews(EigenheadError):
    """Reports that there are not enough usable silhouettes."""

    def __init__(self, silhouettes: Mapping[str, Silhouette], capture: Capture) -> None:
        poor = {name: s.quality.warnings for name, s in silhouettes.items() if not s.quality.usable}
        reasons = [
            compose("view-reasons", camera=name, reasons=[reason]) if reason else compose("view-unusable", camera=name)
            for name, why in poor.items()
            for reason in why or (None,)
        ]
        if capture.masks:
            remedy = compose("advice-correct-masks")
        elif any(remark.code == "rims-empty" for remark in capture.remarks):
            remedy = compose("advice-plates-alike")
        elif capture.backgrounds:
            remedy = compose("advice-new-plates")
        else:
            remedy = compose("advice-supply-plates")
        factor = None if capture.masks else plates_brightness(capture)
        if factor is not None:  # everything else follows from it
            reasons, remedy = [compose("plates-of-other-exposure", factor=factor)], compose("advice-same-exposure")
        said = say_once(reasons, silhouettes, named_most=len(silhouettes))
        usable, every = len(silhouettes) - len(poor), len(silhouettes)
        super().__init__(
            compose("too-few-views", usable=usable, all=every, needed=MIN_VIEWS, reasons=said, remedy=remedy)
        )


@dataclass(frozen=True, slots=True, eq=False)
class UsableViews:
    """Holds a capture with every picture under the right camera, and its silhouettes; excluded views are marked as not
    usable. For each camera that had a wrong picture, ``pictures`` has the name under which the correct one was
    filed."""

    capture: Capture
    silhouettes: Mapping[str, Silhouette]
    pictures: Mapping[str, str]
    warnings: tuple[ReportWarning, ...]


def usable_views(
    capture: Capture,
    rig: Rig,
    segmented: Callable[[Capture], dict[str, Silhouette]],
    *,
    exchanged: Literal["repair", "refuse"],
    guards: Guards = STRICT,
) -> UsableViews:
    """Segments a capture, files exchanged pictures correctly, and marks views that contradict the others as not usable.

    ``capture``: the capture as it was read. ``rig``: the cameras as calibrated. ``segmented``: computes the silhouettes
    of a capture. ``exchanged``: whether a certain exchange of pictures is repaired or refused. ``guards``: decides
    about refusals.

    Refuses with ExchangedPictures, SamePictures or WrongRig (``assign_images``) and WrongScale (``judge_head_size``).
    Refuses with TooFewViews if fewer than ``MIN_VIEWS`` silhouettes are usable (``MIN_VIEWS_OF_FACE`` if the face is
    found).
    """
    assigned = assign_images(capture, rig, segmented, exchanged=exchanged, guards=guards)
    find_face = cache(lambda: guards.find_face(assigned.capture.images, rig))
    overruled: list[ReportWarning] = []
    doubted = [name for name, s in assigned.silhouettes.items() if s.quality.warnings or not s.quality.usable]
    silhouettes = replace_by_faults(assigned.silhouettes, assigned.capture, doubted, rig)
    usable = sum(s.quality.usable for s in silhouettes.values())
    by_face = MIN_VIEWS_OF_FACE <= usable < MIN_VIEWS <= len(silhouettes) and find_face() is not None
    if by_face:
        overruled.append(compose("pose-doubtful", finding=compose("pose-few-views", usable=usable, needed=MIN_VIEWS)))
    elif usable < MIN_VIEWS:
        overruled.append(guards.refuse(TooFewViews(silhouettes, capture)))
        silhouettes = {
            n: s.judged(usable=s.quality.usable or float(s.mask.mean()) > MIN_AREA) for n, s in silhouettes.items()
        }
    low = find_low_crowns(silhouettes, rig, find_face)
    left_out = usable - len(low) >= MIN_VIEWS
    silhouettes = {n: s.judged(usable=False) if left_out and n in low else s for n, s in silhouettes.items()}
    crowns = [compose("crown-low", camera=name, low_mm=mm) for name, mm in low.items()]
    silhouettes, moved = exclude_moved_cameras(silhouettes, rig)
    unexplained = silhouettes
    silhouettes = replace_by_faults(silhouettes, assigned.capture, moved.keys(), rig)
    moved_warnings = [warning for name, warning in moved.items() if silhouettes[name] is unexplained[name]]
    size = judge_head_size(silhouettes, rig, find_face, guards=guards, masks_given=bool(assigned.capture.masks))
    given_masks = [name for name in rig.names if name in assigned.capture.masks]
    beside = masks_off_edges(assigned.capture.images, silhouettes, given_masks)
    of_views = (*view_warnings(silhouettes), *moved_warnings)
    warnings = (*assigned.warnings, *overruled, *crowns, *of_views, *size, *beside, *capture.remarks)
    return UsableViews(assigned.capture, silhouettes, assigned.pictures, warnings)


def exclude_moved_cameras(
    silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[dict[str, Silhouette], dict[str, ReportWarning]]:
    """Marks the views of cameras that moved since the calibration as not usable. The function also returns warnings by
    camera, for cameras that moved and for cameras whose mask may be loose."""
    kept, warnings = dict(silhouettes), dict[str, ReportWarning]()
    for drift in find_drift(silhouettes, rig):
        if drift.moved:
            kept[drift.camera] = silhouettes[drift.camera].judged(usable=False)
        warnings[drift.camera] = drift.warning()
    misplaced = misplaced_camera(kept, rig)
    if misplaced is not None:
        kept[misplaced] = kept[misplaced].judged(usable=False)
        warnings[misplaced] = compose("camera-moved", finding=compose("camera-misplaced", camera=misplaced))
    return kept, warnings


def view_warnings(silhouettes: Mapping[str, Silhouette]) -> list[ReportWarning]:
    """Returns the report's warnings about the quality of single views. A warning that holds for many views appears
    once."""
    remarks_by_code: dict[str, list[Message]] = {"view-left-out": [], "view": [], "mask-doubtful": []}
    for name, silhouette in silhouettes.items():
        quality = silhouette.quality
        of_view = "view" if quality.usable else "view-left-out"
        for code, faults in ((of_view, quality.warnings), ("mask-doubtful", quality.doubts)):
            remarks_by_code[code] += [compose("located", where=name, fault=fault) for fault in faults]
    once = {
        code: say_once(remarks, silhouettes, named_most=len(silhouettes)) for code, remarks in remarks_by_code.items()
    }
    return [
        *(compose("view-left-out", remark=remark) for remark in once["view-left-out"]),
        *(compose("view", remark=remark) for remark in once["view"]),
        *(_doubt(remark) for remark in once["mask-doubtful"]),
    ]


def _doubt(remark: Message) -> ReportWarning:
    """Returns the warning about a doubtful mask. If the same remark holds for several views, the warning names the
    first and the number of the others."""
    located = remark if remark.code == "located" else remark.parameters["fault"]
    assert isinstance(located, Message)
    camera, fault = str(located.parameters["where"]), located.parameters["fault"]
    if located is remark:
        return compose("mask-doubtful", camera=camera, remark=fault)
    count, names = remark.parameters["count"], remark.parameters["names"]
    return compose(
        "mask-doubtful", camera=camera, remark=compose("same-of-more", fault=fault, count=count, names=names)
    )


MIN_TURNED = 0.5  # share of a picture that its turned plate explains: 0.65 to 0.69, and 0.55 to 0.79 of right ones ...
TURNED_GAIN = 1.5  # ... and how many times what the plate explains as it is: 1.7 to 4, and 0.95 at most of right ones
MISFIT_GAIN = 1.2  # how many times the misfit of the right turn that as it is must be: 1.26 to 1.6 if upside down
FINE_PX, COARSE_PX = 1.0, 2.0  # blurs between which a picture's fine detail lies: noise of single pixels is below
DETAIL_QUANTILE = 0.9  # of the subject's pixels: eyes, hair and clothes, not flat skin
MAX_BLURRED = 0.45  # of the median view's detail: 0.39 at a blur of 3 px, 0.28 in motion over 60; 0.57 and more in
# sharp views of six captures, from face to back
INSET_PX = 4.0  # inside the outline, of which a loose mask shows the backdrop
OTHER_EXPOSURE = 1.8  # between plate and shot: up to one stop is levelled
MIN_LIGHT, MAX_LIGHT = 0.002, 0.98  # neither black nor burnt out
MIN_PIXELS, MIN_COMPARED = 500, 3  # of a subject, and views, that tell anything


def replace_by_faults(
    silhouettes: Mapping[str, Silhouette], capture: Capture, suspects: Collection[str], rig: Rig
) -> dict[str, Silhouette]:
    """Replaces the warnings of each view in ``suspects`` by their cause, a fault of its picture. Views with a rotated
    or flipped picture are marked as not usable."""
    found = dict(silhouettes)
    blurred = blurred_views(capture.images, silhouettes) if suspects else {}
    misfits = own_misfit({camera: s for camera, s in silhouettes.items() if s.quality.usable}, rig) if suspects else {}
    for name in suspects:
        fits = misfits.get(name, np.inf) <= FITTING_MISFIT
        fault = turned_against_plate(capture, name) or (None if fits else turned_against_others(silhouettes, name, rig))
        usable = silhouettes[name].quality.usable and fault is None
        fault = fault or blurred.get(name)
        if fault is not None:
            found[name] = silhouettes[name].judged(usable=usable, warnings=(fault,), doubts=())
    return found


def _turns(image: np.ndarray) -> dict[Message, np.ndarray]:
    """Returns a picture or a mask rotated by 180 degrees, and flipped, each with a message about the change."""
    return {turn: np.ascontiguousarray(image[ways]) for turn, ways in TURNS.items()}


def turned_against_plate(capture: Capture, name: str) -> Message | None:
    """Returns the fault of a picture that matches its clean plate only after a rotation by 180 degrees or a flip."""
    plates = capture.backgrounds.get(name, ())
    if name not in capture.images or not plates:
        return None
    picture, plate = thumbnail(capture.images[name]), thumbnail(plates[0])
    shares = {turn: common_share(turned, plate) for turn, turned in _turns(picture).items()}
    turn, share = max(shares.items(), key=lambda one: one[1])
    if share < max(MIN_TURNED, TURNED_GAIN * common_share(picture, plate)):
        return None
    return compose("picture-turned-to-plate", turn=turn)


def turned_against_others(silhouettes: Mapping[str, Silhouette], name: str, rig: Rig) -> Message | None:
    """Returns the fault of a picture whose outline agrees with the other cameras only after a rotation by 180 degrees
    or a flip of picture and plate."""
    others = {camera: s for camera, s in silhouettes.items() if s.quality.usable and camera != name}
    if len(others) < MIN_COMPARED or not silhouettes[name].mask.any():
        return None

    def misfit(mask: np.ndarray) -> float:
        return own_misfit({**others, name: silhouette_from_mask(mask)}, rig)[name]

    mask = silhouettes[name].mask
    if (present := misfit(mask)) <= FITTING_MISFIT:
        return None
    misfits = {turn: misfit(turned) for turn, turned in _turns(mask).items()}
    turn, least = min(misfits.items(), key=lambda one: one[1])
    if least >= FITTING_MISFIT or present < MISFIT_GAIN * least:
        return None
    return compose("picture-turned-to-others", turn=turn)


def blurred_views(images: Mapping[str, ImageRgb], silhouettes: Mapping[str, Silhouette]) -> dict[str, Message]:
    """Returns the fault of each picture in which the subject has much less fine detail than in other views."""
    known = {name: _detail(image, silhouettes[name]) for name, image in images.items() if name in silhouettes}
    details = {name: detail for name, detail in known.items() if detail is not None}
    if len(details) < MIN_COMPARED:
        return {}
    usual = float(np.median([*details.values()]))
    return {
        name: compose("detail-missing", share=detail / usual)
        for name, detail in details.items()
        if detail < MAX_BLURRED * usual
    }


def plates_brightness(capture: Capture) -> float | None:
    """Returns the brightness of the clean plates divided by that of the pictures, in linear light; None if the
    exposures are equal. The medians are used, since the subject covers less than half of a picture."""
    ratios = []
    for name, plates in capture.backgrounds.items():
        if name in capture.images and plates and plates[0].shape == capture.images[name].shape:
            light = [
                linear_from_srgb(of[::8, ::8].astype(np.float32) / 255.0) for of in (plates[0], capture.images[name])
            ]
            known = (light[0] < MAX_LIGHT).all(axis=2) & (light[1] > MIN_LIGHT).all(axis=2)
            ratios += [float(np.median(light[0][known] / light[1][known]))] if known.any() else []
    factor = float(np.median(ratios)) if ratios else 1.0
    return factor if abs(np.log(factor)) > np.log(OTHER_EXPOSURE) else None


def _detail(image: ImageRgb, silhouette: Silhouette) -> float | None:
    """Returns the local variation (levels) of the subject's pixels; None if too few are visible."""
    inside = silhouette.distance < -INSET_PX
    if np.count_nonzero(inside) < MIN_PIXELS:
        return None
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (FINE_PX, COARSE_PX))
    return float(np.quantile(np.abs(fine - coarse)[inside], DETAIL_QUANTILE))
