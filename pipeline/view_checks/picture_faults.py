"""Finds faults of the picture itself, for a view that contradicts the others or its clean plate.

The outlines of a blurred picture are loose, and those of a turned one are elsewhere. Both look like a camera that
moved, or a backdrop that does not differ from the subject. The picture shows which it is, so that the right remedy is
named.

Enters: photographs, clean plates, silhouettes. Leaves: the fault of each picture that has one.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace

import cv2
import numpy as np

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.view_checks.camera_assignment import FITTING_MISFIT, own_misfit
from pipeline.view_checks.image_assignment import common_share, thumbnail
from rig.capture import Capture
from rig.colour_space import linear_from_srgb
from rig.image import ImageRgb
from rig.messages.message import Message, compose
from rig.rig import Rig

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


def with_picture_faults(
    silhouettes: Mapping[str, Silhouette], capture: Capture, suspects: Collection[str], rig: Rig
) -> dict[str, Silhouette]:
    """Returns silhouettes in which the fault of a suspect's picture replaces the warnings that follow from it. Views
    with a turned picture are not usable."""
    found = dict(silhouettes)
    blurred = blurred_views(capture.images, silhouettes) if suspects else {}
    for name in suspects:
        fault = turned_against_plate(capture, name) or turned_against_others(silhouettes, name, rig)
        usable = silhouettes[name].quality.usable and fault is None
        fault = fault or blurred.get(name)
        if fault is not None:
            quality = replace(silhouettes[name].quality, usable=usable, warnings=(fault,), doubts=())
            found[name] = replace(silhouettes[name], quality=quality)
    return found


def turned_against_plate(capture: Capture, name: str) -> Message | None:
    """Returns the fault of a picture that shows its clean plate only once it is turned by 180 degrees or flipped."""
    plates = capture.backgrounds.get(name, ())
    if name not in capture.images or not plates:
        return None
    picture, plate = thumbnail(capture.images[name]), thumbnail(plates[0])
    turns = {
        compose("turned-half"): picture[::-1, ::-1],
        compose("flip-across"): picture[:, ::-1],
        compose("flip-down"): picture[::-1],
    }
    shares = {turn: common_share(np.ascontiguousarray(turned), plate) for turn, turned in turns.items()}
    turn, share = max(shares.items(), key=lambda one: one[1])
    if share < max(MIN_TURNED, TURNED_GAIN * common_share(picture, plate)):
        return None
    return compose("picture-turned-to-plate", turn=turn)


def turned_against_others(silhouettes: Mapping[str, Silhouette], name: str, rig: Rig) -> Message | None:
    """Returns the fault of a picture, turned together with its plate, whose outline agrees with those of the other
    cameras only once it is turned by 180 degrees or flipped."""
    others = {camera: s for camera, s in silhouettes.items() if s.quality.usable and camera != name}
    if len(others) < MIN_COMPARED or not silhouettes[name].mask.any():
        return None

    def misfit(mask: np.ndarray) -> float:
        return own_misfit({**others, name: silhouette_from_mask(np.ascontiguousarray(mask))}, rig)[name]

    mask = silhouettes[name].mask
    turns = {
        compose("turned-half"): mask[::-1, ::-1],
        compose("flip-across"): mask[:, ::-1],
        compose("flip-down"): mask[::-1],
    }
    misfits = {turn: misfit(turned) for turn, turned in turns.items()}
    turn, least = min(misfits.items(), key=lambda one: one[1])
    if not least < FITTING_MISFIT < misfit(mask) or misfit(mask) < MISFIT_GAIN * least:
        return None
    return compose("picture-turned-to-others", turn=turn)


def blurred_views(images: Mapping[str, ImageRgb], silhouettes: Mapping[str, Silhouette]) -> dict[str, Message]:
    """Returns the fault of each picture whose subject has much less fine detail than in the other views."""
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
    """Returns how many times as bright as the pictures the clean plates are, in linear light; None where that is no
    other exposure. The subject covers less than half of a picture, so that the median is of the backdrop."""
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
    """Returns how much (levels) the subject's pixels change within a few pixels; None where too few are seen."""
    inside = silhouette.distance < -INSET_PX
    if np.count_nonzero(inside) < MIN_PIXELS:
        return None
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (FINE_PX, COARSE_PX))
    return float(np.quantile(np.abs(fine - coarse)[inside], DETAIL_QUANTILE))
