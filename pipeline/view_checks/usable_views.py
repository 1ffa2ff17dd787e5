"""Decides which views of a capture take part, and why the others do not: all that can be known before a fit.

Enters: a capture, its rig, and a function that segments it. Leaves: every picture under its own camera, silhouettes of
which the unreliable ones are marked, and the warnings that say why. ``reconstruct`` begins with it; ``eigenhead check``
does nothing else.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

from pipeline.imaging.silhouette import Silhouette
from pipeline.view_checks.camera_drift import find_drift
from pipeline.view_checks.guards import STRICT, Guards
from pipeline.view_checks.head_size import judge_head_size
from pipeline.view_checks.image_assignment import assign_images
from pipeline.view_checks.mask_edges import masks_off_edges
from pipeline.view_checks.picture_faults import plates_brightness, with_picture_faults
from pipeline.view_checks.rig_agreement import misplaced_camera
from pipeline.warnings import ReportWarning
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.messages.fault_groups import say_once
from rig.messages.message import Message, compose
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
    """Holds a capture with every picture under the right camera, and its silhouettes; views that take no part are
    marked as not usable. ``pictures`` has an entry for each camera that had another's picture: the name under which its
    own was filed."""

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
    """Segments a capture, files exchanged pictures right, and marks views that contradict the others as not usable.

    Args:
        capture: as it was read.
        rig: the cameras as calibrated.
        segmented: computes the silhouettes of a capture.
        exchanged: whether to repair or refuse an exchange of pictures that is beyond doubt.
        guards: what is refused.

    Refuses with:
        ExchangedPictures, WrongRig: as of ``assign_images``.
        WrongScale: as of ``judge_head_size``.
        TooFewViews: fewer than ``MIN_VIEWS`` silhouettes are usable, or, of a subject whose face is found, fewer than
            ``MIN_VIEWS_OF_FACE``.
    """
    assigned = assign_images(capture, rig, segmented, exchanged=exchanged, guards=guards)
    find_face = cache(lambda: guards.find_face(assigned.capture.images, rig))
    overruled: list[ReportWarning] = []
    doubted = [name for name, s in assigned.silhouettes.items() if s.quality.warnings or not s.quality.usable]
    silhouettes = with_picture_faults(assigned.silhouettes, assigned.capture, doubted, rig)
    usable = sum(silhouette.quality.usable for silhouette in silhouettes.values())
    by_face = MIN_VIEWS_OF_FACE <= usable < MIN_VIEWS <= len(silhouettes) and find_face() is not None
    if usable < MIN_VIEWS and not by_face:
        overruled.append(guards.refuse(TooFewViews(silhouettes, capture)))
        silhouettes = {name: _tried(silhouette) for name, silhouette in silhouettes.items()}
    silhouettes, moved = without_moved_cameras(silhouettes, rig)
    unexplained = silhouettes
    silhouettes = with_picture_faults(silhouettes, assigned.capture, moved.keys(), rig)
    moved_warnings = [warning for name, warning in moved.items() if silhouettes[name] is unexplained[name]]
    masks_given = bool(assigned.capture.masks)
    size = judge_head_size(silhouettes, rig, find_face, guards=guards, masks_given=masks_given)
    given_masks = [name for name in rig.names if name in assigned.capture.masks]
    beside = masks_off_edges(assigned.capture.images, silhouettes, given_masks)
    of_views = (*view_warnings(silhouettes), *moved_warnings)
    warnings = (*assigned.warnings, *overruled, *of_views, *size, *beside, *capture.remarks)
    return UsableViews(assigned.capture, silhouettes, assigned.pictures, warnings)


def _tried(silhouette: Silhouette) -> Silhouette:
    """Returns the silhouette as a usable one if it shows anything."""
    usable = silhouette.quality.usable or float(silhouette.mask.mean()) > MIN_AREA
    return replace(silhouette, quality=replace(silhouette.quality, usable=usable))


def without_moved_cameras(
    silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[dict[str, Silhouette], dict[str, ReportWarning]]:
    """Marks the views of cameras that moved since the calibration as not usable. Also returns warnings by camera: for
    each of these, and for each camera whose mask may be loose instead."""
    kept, warnings = dict(silhouettes), dict[str, ReportWarning]()
    for drift in find_drift(silhouettes, rig):
        if drift.moved:
            quality = replace(silhouettes[drift.camera].quality, usable=False)
            kept[drift.camera] = replace(silhouettes[drift.camera], quality=quality)
        warnings[drift.camera] = drift.warning()
    misplaced = misplaced_camera(kept, rig)
    if misplaced is not None:
        kept[misplaced] = replace(kept[misplaced], quality=replace(kept[misplaced].quality, usable=False))
        warnings[misplaced] = compose("camera-moved", finding=compose("camera-misplaced", camera=misplaced))
    return kept, warnings


def view_warnings(silhouettes: Mapping[str, Silhouette]) -> list[ReportWarning]:
    """Returns the warnings about the quality of single views as warnings of the report. One that holds for many views
    is given once."""
    remarks_by_code: dict[str, list[Message]] = {"view-left-out": [], "view": [], "mask-doubtful": []}
    for name, silhouette in silhouettes.items():
        code = "view" if silhouette.quality.usable else "view-left-out"
        remarks_by_code[code] += [
            compose("located", where=name, fault=remark) for remark in silhouette.quality.warnings
        ]
        remarks_by_code["mask-doubtful"] += [
            compose("located", where=name, fault=doubt) for doubt in silhouette.quality.doubts
        ]
    once = {
        code: say_once(remarks, silhouettes, named_most=len(silhouettes)) for code, remarks in remarks_by_code.items()
    }
    found = [compose("view-left-out", remark=remark) for remark in once["view-left-out"]]
    found += [compose("view", remark=remark) for remark in once["view"]]
    return found + [_doubt(remark) for remark in once["mask-doubtful"]]


def _doubt(remark: Message) -> ReportWarning:
    """Returns the warning of a doubtful mask: for one view or, if the remark holds for several, for the first of them
    with the number of the others."""
    located = remark if remark.code == "located" else remark.parameters["fault"]
    assert isinstance(located, Message)
    camera, fault = str(located.parameters["where"]), located.parameters["fault"]
    if located is remark:
        return compose("mask-doubtful", camera=camera, remark=fault)
    count, names = remark.parameters["count"], remark.parameters["names"]
    return compose(
        "mask-doubtful", camera=camera, remark=compose("same-of-more", fault=fault, count=count, names=names)
    )
