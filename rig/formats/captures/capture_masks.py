"""Reads the masks of one capture together, to decide whether black or white is the subject.

The input is the decoded pixels of a mask file for each camera. The output is masks (True = subject) at the size of the
reduced pictures, grey values of masks with soft edges, and warnings. Masks with equal faults share one message."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from rig.formats.pictures.mask_values import MaskReading, Plane, Share, inverted_masks, read_masks
from rig.formats.pictures.work_size import at_share, work_rig, work_share
from rig.messages.message import Message, compose
from rig.rig import Rig

SPECK_SHARE = 0.02  # of the largest piece's area: smaller pieces are dropped; a head above a collar has 0.3 of a torso
HOLE_SHARE = 3e-4  # of the subject's area: smaller holes are filled (whites of eyes); gaps in hair are larger
SPECKS_TOLD = 0.011  # of the subject's area: a remark from here on; strands of hair in true masks make 0.0004 to 0.0103


@dataclass(frozen=True, slots=True, eq=False)
class MaskSubjects:
    """Holds the masks of a capture by camera. ``masks`` is True for the subject. ``soft`` holds the subject's share of
    each pixel, 0 to 255, for masks with soft edges. ``remarks`` holds warnings."""

    masks: Mapping[str, Bool[np.ndarray, "_ _"]]
    soft: Mapping[str, UInt8[np.ndarray, "_ _"]]
    remarks: tuple[Message, ...]


def mask_subjects(
    planes: Mapping[str, tuple[str, Plane]],
    rig: Rig,
    faults: list[Message],
    *,
    pixels_most: int | None = None,
    lost: dict[str, list[Message]] | None = None,
) -> MaskSubjects:
    """Interprets the masks of one capture, reduced to ``pixels_most`` pixels. ``planes`` holds each mask file's name
    and full-size pixels by camera. Unusable masks are reported in ``lost`` by camera or, if ``lost`` is None, in
    ``faults``."""
    readings = read_masks({name: plane for name, (_, plane) in planes.items()})
    files = {name: file for name, (file, _) in planes.items()}
    usable = {name: reading for name, reading in readings.items() if not reading.fault}
    unfit = {name: reading.fault for name, reading in readings.items() if reading.fault}
    inverted = inverted_masks({name: reading.share > 127 for name, reading in usable.items()}, _middles(rig))
    masks, soft, specked = {}, {}, list[str]()
    for name, reading in usable.items():
        whole, changed = _without_specks(255 - reading.share if name in inverted else reading.share)
        specked += [files[name]] if changed > SPECKS_TOLD else []
        share = _in_picture(whole, reading, name, rig, pixels_most)
        if not (share > 127).any():
            unfit[name] = compose("mask-empty")
            continue
        masks[name] = share > 127
        masks[name].setflags(write=False)
        if reading.soft:
            soft[name] = share
            soft[name].setflags(write=False)
    if lost is None:
        faults += _by_cause({files[name]: fault for name, fault in unfit.items()})
    else:
        for name, fault in unfit.items():
            lost.setdefault(name, []).append(compose("of-file", file=files[name], fault=fault))
    grouped = _by_cause({files[name]: reading.remark for name, reading in usable.items()})
    remarks = [compose("mask-undecided", remark=remark) for remark in grouped]
    if specked:
        remarks.append(compose("mask-specks", masks=_of_masks(specked)))
    if inverted:
        remarks.append(compose("mask-inverted", remark=_inverted([files[name] for name in inverted], len(planes))))
    return MaskSubjects(masks, soft, tuple(remarks))


def _without_specks(share: Share) -> tuple[Share, float]:
    """Removes small components beside the subject and fills small holes. Returns the cleaned mask and the changed area,
    relative to the subject's.

    A small component would otherwise distort the outline that is compared between cameras."""
    white = share > 127
    changed, area, lost = share, max(int(np.count_nonzero(white)), 1), 0
    for fill in (0, 255):
        of = changed > 127 if fill == 0 else changed <= 127  # after the specks, whose holes are gone with them
        _, labels, stats, _ = cv2.connectedComponentsWithStats(of.astype(np.uint8), connectivity=8 if fill == 0 else 4)
        labels, areas = np.asarray(labels, np.int32), np.asarray(stats, np.int64)[:, cv2.CC_STAT_AREA]
        largest = int(areas[1:].max(initial=0))
        limit = SPECK_SHARE * largest if fill == 0 else HOLE_SHARE * area
        small: np.ndarray = np.asarray(areas < limit)
        small[0] = False
        if fill == 255:  # background that the picture's border cuts off is no hole
            small[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = False
        if small.any():
            inside = np.take(small, labels)
            lost += int(areas[small].sum())
            changed = np.where(inside, np.uint8(fill), changed)
    if lost == 0:
        return share, 0.0
    near = cv2.dilate((changed != share).astype(np.uint8), np.ones((5, 5), np.uint8)).view(bool)
    # The soft edges of removed specks and filled holes are removed too.
    changed = np.where(near, np.where(changed > 127, np.uint8(255), np.uint8(0)), changed)
    return changed, lost / area


def _in_picture(
    share: Share, reading: MaskReading, name: str, rig: Rig, pixels_most: int | None
) -> UInt8[np.ndarray, "_ _"]:
    """Reduces and undistorts a mask as its camera's picture is reduced and undistorted."""
    camera = rig[name]
    scale = work_share(camera.intrinsics, pixels_most)
    pixels = at_share(share, (share.shape[1], share.shape[0]), scale)
    if camera.recorded is None:
        return pixels
    matrix = work_rig(rig.subset([name]), pixels_most)[name].intrinsics.matrix()
    return camera.recorded.undistort(pixels, matrix, smooth=reading.soft)


def _middles(rig: Rig) -> dict[str, np.ndarray]:
    """Projects the point nearest to all optical axes to each camera. Returns no projected point for a single camera."""
    if len(rig) < 2:
        return {}
    point = rig.centre_world()[None]
    with np.errstate(all="ignore"):
        pixels = {camera.name: camera.project(point)[0] for camera in rig}
    return {name: pixel for name, pixel in pixels.items() if np.isfinite(pixel).all()}


def _by_cause(messages: Mapping[str, Message | None]) -> list[Message]:
    """Returns one message for all files with the same fault."""
    files: dict[Message, list[str]] = {}
    for file, message in messages.items():
        if message is not None:
            files.setdefault(message, []).append(file)
    return [compose("of-file", file=_of_masks(names), fault=message) for message, names in files.items()]


def _of_masks(files: list[str]) -> str | Message:
    if len(files) == 1:
        return files[0]
    return compose("each-of-masks", count=len(files), first=files[0], last=files[-1])


def _inverted(files: list[str], count: int) -> Message:
    if len(files) == count > 1:
        return compose("masks-inverted-all")
    return compose("masks-inverted-some", count=len(files), masks=files)
