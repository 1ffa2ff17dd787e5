"""Judges whether a capture, taken by the rig or uploaded, is worth reconstructing.

The module holds only one camera's picture in memory at a time."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, TypedDict

import numpy as np
from jaxtyping import Bool

from rig.acquisition.image_checks import SubjectPlace, find_subject, subject_of_mask
from rig.acquisition.judgement import examine_picture, judge_checks, plate_level
from rig.acquisition.shot import CheckDocument, Fault, PictureCheck
from rig.formats.rig_toml import ShotConfig
from rig.image import ImageRgb
from rig.messages.message import compose

Verdict = Literal["good", "usable", "poor"]

PLACE_FAULTS = frozenset({"empty", "cut-off"})
DISPLACED = frozenset({"moved", "view", "swapped", "dark"})
CAMERAS_LEAST = 3  # with fewer there is no reconstruction
SOUND_SHARE = 0.75  # 8 of 11 cameras still surround a head; with fewer, one side of it is seen by one camera or none


class SubjectDocument(TypedDict):
    """Holds the subject's position in a picture, for JSON. ``outline`` lists the contour's corners (px)."""

    share: float
    cut_off: list[str]
    outline: list[list[float]]


class ViewDocument(TypedDict, total=False):
    """Holds the measurements of one camera's picture as plain values for JSON, without missing measurements."""

    mean: float
    clipped_share: float
    blur_px: float | None
    background_found: float | None
    background_moved_px: float | None
    subject: SubjectDocument | None


@dataclass(frozen=True, slots=True)
class ViewCheck:
    """Holds the check of one camera's picture.

    Attributes:
        picture: measurements; None if the shot has them.
        level: mean value that the picture should have; None without a clean plate.
        place: where the subject is.
        looked: whether there was a clean plate or a mask to find the subject by.
    """

    picture: PictureCheck | None
    level: float | None
    place: SubjectPlace | None
    looked: bool

    def document(self) -> ViewDocument:
        """Returns the check as plain values for JSON."""
        measured: ViewDocument = {} if self.picture is None else {**_known(self.picture.document())}
        if self.looked:
            measured["subject"] = None if self.place is None else _place_document(self.place)
        return measured


def check_view(
    image: ImageRgb, plate: ImageRgb | None, mask: Bool[np.ndarray, "h w"] | None, *, place_only: bool = False
) -> ViewCheck:
    """Measures one camera's picture and finds the subject in it. With ``place_only`` the function only finds the
    subject, because the picture was already measured."""
    if mask is not None and mask.shape == image.shape[:2]:
        position = subject_of_mask(mask)
    else:
        position = None if plate is None else find_subject(image, plate)
    picture = None if place_only else examine_picture(image, plate)
    return ViewCheck(
        picture, None if plate is None else plate_level(plate), position, not (mask is None and plate is None)
    )


def view_faults(views: Mapping[str, ViewCheck], limits: ShotConfig) -> list[Fault]:
    """Returns the faults of a capture's pictures from the cameras' measurements."""
    pictures = {name: view.picture for name, view in views.items() if view.picture is not None}
    levels = {name: view.level for name, view in views.items() if view.level is not None}
    return remove_consequences([*judge_checks(pictures, levels, limits), *_place_faults(views)])


def remove_consequences(faults: Iterable[Fault]) -> list[Fault]:
    """Removes faults that another fault of the same camera explains. For example, a wrong background explains that no
    subject was found."""
    known = [*faults]
    displaced = {fault.camera for fault in known if fault.code in DISPLACED} - {None}
    return [fault for fault in known if not (fault.code in PLACE_FAULTS and fault.camera in displaced)]


def verdict_of(faults: Iterable[Fault], cameras: Collection[str]) -> Verdict:
    """Returns the verdict on a capture. The verdict is ``good`` without faults, and ``poor`` if the whole rig has a
    fault or too few ``cameras`` are free of faults. Any other capture has the verdict ``usable``."""
    named = {fault.camera for fault in faults}
    if not named:
        return "good"
    sound = len(set(cameras) - named)
    return "poor" if None in named or sound < max(CAMERAS_LEAST, SOUND_SHARE * len(cameras)) else "usable"


def _place_faults(views: Mapping[str, ViewCheck]) -> list[Fault]:
    looked = {name: view.place for name, view in views.items() if view.looked}
    if looked and not any(looked.values()):
        return [Fault("empty", None, compose("nobody-in-pictures"))]
    faults = []
    for name, position in looked.items():
        if position is None:
            faults.append(Fault("empty", name, compose("nobody-in-picture")))
        elif position.cut_off:
            faults.append(Fault("cut-off", name, compose("head-cut-off", sides=position.cut_off)))
    return faults


def _place_document(position: SubjectPlace) -> SubjectDocument:
    outline = [[round(x, 1), round(y, 1)] for x, y in position.outline]
    return {"share": round(position.share, 4), "cut_off": [*position.cut_off], "outline": outline}


def _known(check: CheckDocument) -> ViewDocument:
    return {
        "mean": check["mean"],
        "clipped_share": check["clipped_share"],
        "blur_px": check["blur_px"],
        "background_found": check["background_found"],
        "background_moved_px": check["background_moved_px"],
    }
