"""Which views of a capture take part, and what is said of the others: all that can be known before a fit.

Enters: a capture, its rig, and a way to segment it. Leaves: every picture under its own camera, silhouettes of which
those that may not be believed are marked, and the warnings that say why. ``reconstruct`` begins with it; ``eigenhead
check`` asks nothing else.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from pipeline.diagnostics import ReportWarning
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.camera_drift import find_drift
from pipeline.multiview.head_size import judge_head_size
from pipeline.multiview.rig_agreement import misplaced_camera
from pipeline.silhouettes.mask_edges import masks_off_edges
from pipeline.silhouettes.own_pictures import own_pictures
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.formats.fault_groups import say_once
from rig.messages.message import Message, compose
from rig.rig import Rig

VIEWS_LEAST = 3


class TooFewViews(EigenheadError):
    """Not enough usable silhouettes."""

    def __init__(self, silhouettes: Mapping[str, Silhouette], capture: Capture) -> None:
        poor = {name: s.quality.warnings for name, s in silhouettes.items() if not s.quality.usable}
        reasons = [
            compose("view-reasons", camera=name, reasons=[reason]) if reason else compose("view-unusable", camera=name)
            for name, why in poor.items()
            for reason in why or (None,)
        ]
        if capture.masks:
            remedy = compose("advice-correct-masks")
        elif capture.backgrounds:
            remedy = compose("advice-new-plates")
        else:
            remedy = compose("advice-supply-plates")
        told = say_once(reasons, silhouettes, named_most=len(silhouettes))
        usable, every = len(silhouettes) - len(poor), len(silhouettes)
        super().__init__(
            compose("too-few-views", usable=usable, all=every, needed=VIEWS_LEAST, reasons=told, remedy=remedy)
        )


@dataclass(frozen=True, slots=True, eq=False)
class UsableViews:
    """A capture with every picture under its own camera and its silhouettes; those that take no part are not usable.
    ``pictures``: for each camera that was given another's picture, the name under which its own is filed."""

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
) -> UsableViews:
    """Segments a capture, files exchanged pictures back, and leaves out what contradicts the other views.

    Args:
        capture: as it was read.
        rig: the cameras as calibrated.
        segmented: the silhouettes of a capture.
        exchanged: what to do about an exchange of pictures that is beyond doubt.

    Raises:
        ExchangedPictures, WrongRig: of ``own_pictures``.
        WrongScale: of ``judge_head_size``.
        TooFewViews: fewer than ``VIEWS_LEAST`` silhouettes are of use.
    """
    own = own_pictures(capture, rig, segmented, exchanged=exchanged)
    if sum(silhouette.quality.usable for silhouette in own.silhouettes.values()) < VIEWS_LEAST:
        raise TooFewViews(own.silhouettes, capture)
    silhouettes, moved = without_moved_cameras(own.silhouettes, rig)
    size = judge_head_size(silhouettes, rig, masks_given=bool(own.capture.masks))
    beside = masks_off_edges(own.capture.images, silhouettes, [name for name in rig.names if name in own.capture.masks])
    warnings = (*own.warnings, *view_warnings(silhouettes), *moved, *size, *beside, *capture.remarks)
    return UsableViews(own.capture, silhouettes, own.pictures, warnings)


def without_moved_cameras(
    silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[dict[str, Silhouette], list[ReportWarning]]:
    """Views of cameras that no longer stand where they were calibrated take no part; each is named, and so are those
    whose mask may be loose instead."""
    kept, warnings = dict(silhouettes), []
    for drift in find_drift(silhouettes, rig):
        if drift.moved:
            quality = replace(silhouettes[drift.camera].quality, usable=False)
            kept[drift.camera] = replace(silhouettes[drift.camera], quality=quality)
        warnings.append(drift.warning())
    misplaced = misplaced_camera(kept, rig)
    if misplaced is not None:
        kept[misplaced] = replace(kept[misplaced], quality=replace(kept[misplaced].quality, usable=False))
        warnings.append(compose("camera-moved", finding=compose("camera-misplaced", camera=misplaced)))
    return kept, warnings


def view_warnings(silhouettes: Mapping[str, Silhouette]) -> list[ReportWarning]:
    """What the views' qualities say, as warnings of the report; what is true of many views is one of them."""
    told: dict[str, list[Message]] = {"view-left-out": [], "view": [], "mask-doubtful": []}
    for name, silhouette in silhouettes.items():
        code = "view" if silhouette.quality.usable else "view-left-out"
        told[code] += [compose("located", where=name, fault=remark) for remark in silhouette.quality.warnings]
        told["mask-doubtful"] += [compose("located", where=name, fault=doubt) for doubt in silhouette.quality.doubts]
    once = {code: say_once(remarks, silhouettes, named_most=len(silhouettes)) for code, remarks in told.items()}
    found = [compose("view-left-out", remark=remark) for remark in once["view-left-out"]]
    found += [compose("view", remark=remark) for remark in once["view"]]
    return found + [_doubt(remark) for remark in once["mask-doubtful"]]


def _doubt(remark: Message) -> ReportWarning:
    """Of one view, or, where it is true of many, of the first with the number of the others."""
    located = remark if remark.code == "located" else remark.parameters["fault"]
    assert isinstance(located, Message)
    camera, fault = str(located.parameters["where"]), located.parameters["fault"]
    if located is remark:
        return compose("mask-doubtful", camera=camera, remark=fault)
    count, names = remark.parameters["count"], remark.parameters["names"]
    return compose(
        "mask-doubtful", camera=camera, remark=compose("same-of-more", fault=fault, count=count, names=names)
    )
