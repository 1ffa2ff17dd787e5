"""Defines a capture: the pictures of one synchronised shot of all cameras, in memory."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, UInt8

from rig.image import ImageRgb
from rig.messages.message import Message

Content = TypeVar("Content")

TEXTURE_SETS = "texture_sets"  # a capture's folder of them
ReadImage = Callable[[str], ImageRgb]
"""Reads once more, at the size of its file, the picture that is filed under a camera's name. Raises InputError."""

Features = Mapping[str, Mapping[str, Float[np.ndarray, " 2"]]]


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Holds the pictures of one shot, and the data that were read with the pictures.

    ``images`` holds the photographs (RGB) by camera, ``backgrounds`` the pictures of the empty studio, and ``masks``
    the masks from files (True = subject). ``soft_masks`` holds masks with soft edges: the subject's share of each
    pixel, 0 to 255. ``features`` holds feature points (px) by landmark and camera. ``digests`` holds the SHA-256 of
    each file, and ``remarks`` the warnings from reading. ``texture_sets`` holds further photographs of the same
    cameras, by set and camera."""

    images: Mapping[str, ImageRgb]
    backgrounds: Mapping[str, tuple[ImageRgb, ...]] = field(default_factory=dict)
    masks: Mapping[str, Bool[np.ndarray, "h w"]] = field(default_factory=dict)
    features: Features = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[Message, ...] = ()
    soft_masks: Mapping[str, UInt8[np.ndarray, "h w"]] = field(default_factory=dict)
    texture_sets: Mapping[str, Mapping[str, ImageRgb]] = field(default_factory=dict)


def reassign_images(
    capture: Capture,
    *,
    pictures: Mapping[str, str] = MappingProxyType({}),
    plates: Mapping[str, str] = MappingProxyType({}),
    points: Mapping[str, str] = MappingProxyType({}),
    masks: Mapping[str, str] | None = None,
) -> Capture:
    """Returns the capture with some images, masks, clean plates and feature points assigned to other cameras.

    Args:
        pictures: for a camera, the name under which its image is stored now; its pictures in texture sets follow, and
            its mask, unless ``masks`` is given.
        plates: the same for its clean plates.
        points: the same for the feature points that were picked in its image.
        masks: the same for its mask.
    """

    def reassign(filed: Mapping[str, Content], source: Mapping[str, str]) -> dict[str, Content]:
        wanted = {name: source.get(name, name) for name in filed.keys() | source.keys()}
        return {name: filed[wanted[name]] for name in sorted(wanted) if wanted[name] in filed}

    masks = pictures if masks is None else masks
    return Capture(
        reassign(capture.images, pictures),
        reassign(capture.backgrounds, plates),
        reassign(capture.masks, masks),
        {landmark: reassign(views, points) for landmark, views in capture.features.items()},
        _renamed(capture.digests, {"images": pictures, "masks": masks, "background": plates, TEXTURE_SETS: pictures}),
        capture.remarks,
        reassign(capture.soft_masks, masks),
        {name: reassign(images, pictures) for name, images in capture.texture_sets.items()},
    )


def turn_masks(capture: Capture, ways: Mapping[str, tuple[slice, slice]]) -> Capture:
    """Returns the capture with some masks mirrored or turned by the slices ``ways`` (rows, columns) by camera."""

    def turned(masks: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {n: np.ascontiguousarray(of[ways[n]]) if n in ways else of for n, of in masks.items()}

    return replace(capture, masks=turned(capture.masks), soft_masks=turned(capture.soft_masks))


def _renamed(digests: Mapping[str, str], sources: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Returns the files' digests under the names of the reassigned cameras."""
    renamed = {}
    for file, digest in digests.items():
        path = PurePosixPath(file)
        owner = {filed: camera for camera, filed in sources.get(path.parts[0], {}).items()}
        if len(path.parts) > 2 and path.parts[0] != TEXTURE_SETS:
            path = PurePosixPath(path.parts[0], owner.get(path.parts[1], path.parts[1]), *path.parts[2:])
        elif path.stem in owner:
            path = path.with_name(owner[path.stem] + path.suffix)
        renamed[path.as_posix()] = digest
    return dict(sorted(renamed.items()))
