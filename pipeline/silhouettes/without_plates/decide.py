"""Decisions for every view of a capture that has neither plates nor masks."""

from collections.abc import Callable, Mapping

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.settings import SegmentationSettings
from pipeline.silhouettes.background import coarse_size
from pipeline.silhouettes.foreground import Decision
from pipeline.silhouettes.without_plates.estimated_plate import decision_without_plate
from pipeline.silhouettes.without_plates.mask_search import search_masks
from pipeline.silhouettes.without_plates.viewing_volume import viewing_volume
from rig.rig import Rig


def decide_without_plates(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]],
    rig: Rig,
    settings: SegmentationSettings,
    *,
    report: Callable[[float], None] = lambda share: None,
) -> dict[str, Decision]:
    """What is subject in every photograph: ``pipeline.silhouettes.matting`` finds the contour from it."""
    small = {
        name: cv2.resize(
            images[name], coarse_size(images[name].shape, settings.coarse_columns), interpolation=cv2.INTER_AREA
        ).astype(np.float32)
        for name in rig.names
    }
    volume = viewing_volume(rig, {name: image.shape[:2] for name, image in small.items()})
    background = {name: np.zeros(image.shape[:2], bool) for name, image in small.items()}
    found = search_masks(small, rig, volume, background, report=report)
    return {name: decision_without_plate(images[name], small[name], found[name], settings) for name in rig.names}
