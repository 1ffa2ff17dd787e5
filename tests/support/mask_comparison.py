"""Compares silhouettes of pictures of any size with the true masks of the whole size."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.imaging.silhouette import Silhouette
from rig.capture import Capture
from rig.rig import Rig
from tests.pipeline.segmentation.test_segment import true_mask

FAR_PX = 4.0  # of the whole size, 1.5 mm of a head: from there on a contour is wrong, and not only blurred


@dataclass(frozen=True)
class Row:
    """One view: overlap, distances from the true contour to the mask's (px of the whole size), what the view says."""

    view: str
    overlap: float
    off_px: np.ndarray
    silhouette: Silhouette

    @property
    def far(self) -> float:
        return float((self.off_px > FAR_PX).mean())

    @property
    def weak(self) -> float:
        """What the program says of the contour: the share that hardly differs from the background."""
        return float(np.asarray(self.silhouette.quality.figures.get("weak_share", 1.0)))

    def line(self) -> str:
        quality = self.silhouette.quality
        return (
            f"{self.overlap:.4f} {np.median(self.off_px):.2f} {np.sqrt((self.off_px**2).mean()):.2f} "
            f"{np.quantile(self.off_px, 0.95):.2f} {self.far:.3f} weak {self.weak:.3f} "
            f"{'' if quality.usable else 'left out '}{'; '.join(map(str, quality.warnings))}"
        )


def smaller(capture: Capture, rig: Rig, size: float) -> tuple[Capture, Rig]:
    """The capture with pictures and plates as means over areas; ``size`` must leave whole pixels."""
    if size == 1:
        return capture, rig
    return change_pictures(
        capture, lambda picture: cv2.resize(picture, None, fx=size, fy=size, interpolation=cv2.INTER_AREA)
    ), rig.scaled(size)


def change_pictures(capture: Capture, change: Callable[[np.ndarray], np.ndarray]) -> Capture:
    """The capture with another picture in place of each, plates too."""
    images = {name: change(image) for name, image in capture.images.items()}
    plates = {name: tuple(map(change, several)) for name, several in capture.backgrounds.items()}
    return replace(capture, images=images, backgrounds=plates)


def compare_view(name: str, view: str, silhouette: Silhouette) -> Row:
    """Compares one silhouette, of any size, with the true mask of the whole size."""
    truth = true_mask(view, name)
    size = silhouette.mask.shape[1] / truth.shape[1]
    at = (contour_points(truth) + 0.5) * size - 0.5
    x, y = (np.ascontiguousarray(at[:, k], np.float32)[None] for k in (0, 1))
    off = np.abs(cv2.remap(silhouette.distance, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]) / size
    small = cv2.resize(truth.astype(np.float32), silhouette.mask.shape[::-1], interpolation=cv2.INTER_AREA) >= 0.5
    overlap = np.count_nonzero(silhouette.mask & small) / np.count_nonzero(silhouette.mask | small)
    return Row(view, overlap, off, silhouette)


def contour_points(mask: np.ndarray) -> np.ndarray:
    """Points half-way between neighbours that a mask separates, (x, y)."""
    across, down = np.argwhere(mask[:, 1:] != mask[:, :-1]), np.argwhere(mask[1:] != mask[:-1])
    return np.concatenate([across[:, ::-1] + (0.5, 0.0), down[:, ::-1] + (0.0, 0.5)])
