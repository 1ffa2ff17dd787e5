"""Masks from clean plates against true ones, of pictures as they are and made smaller: overlap, contour, what is said.

python -m tests.laboratory plate_masks
python -m tests.laboratory plate_masks --captures scan-a-skin --sizes 1 0.75 0.5 0.25 --views
python -m tests.laboratory plate_masks --sizes 0.5 --noise 3 --exposure 0.9 --jpeg 85

Pictures and plates are made smaller by the mean over each new pixel's area, the rig with them. Whatever the size,
contours are compared in pixels of the whole one, from every point of the true contour to the mask's: sizes compare.
What a mask has too much is in the overlap.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import cv2
import numpy as np

from pipeline.segmentation.segment import segment
from pipeline.settings import SegmentationSettings
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from rig.progress import Progress, discard_progress
from rig.rig import Rig
from tests.support.mask_comparison import FAR_PX, Row, change_pictures, compare_view, smaller
from tests.support.noisy_captures import noisier
from tests.support.shared_data import shared

CAPTURES = ("scan-a", "draw-b", "scan-a-skin", "beard-smile", "three-brows", "circle-hair")


def run(
    report: Progress,
    *,
    captures: Sequence[str] = CAPTURES,
    sizes: Sequence[float] = (1.0, 0.5),
    noise: Annotated[float, "levels that are added to the smaller pictures and plates"] = 0.0,
    exposure: Annotated[float, "light of the shot by that of the plate"] = 1.0,
    jpeg: Annotated[int | None, "quality with which the smaller pictures and plates are packed"] = None,
    views: Annotated[bool, "a line a view"] = False,
) -> dict[str, Any]:
    """Returns the figures of each capture and size."""
    found, lines = {}, list[str]()
    for name, size in itertools.product(captures, sizes):
        report(f"{name} {size:g}", len(found) / (len(captures) * len(sizes)))
        capture, rig = read_capture(shared(f"data/captures/{name}"))
        small, smaller_rig = smaller(capture, rig, size)
        rows = compare(name, worse(small, noise, exposure, jpeg), smaller_rig)
        found[f"{name} {size:g}"] = summarise(rows)
        lines.append(f"{name} {size:g}: " + ", ".join(f"{key} {value:.4g}" for key, value in summarise(rows).items()))
        lines += [f"  {row.view} {row.line()}" for row in rows if views]
    return {"figures": found, "lines": lines}


def worse(capture: Capture, noise: float, exposure: float, jpeg: int | None) -> Capture:
    """The capture with noise, with another exposure of its shot (but not of its plates), and packed as JPEG."""
    if exposure != 1:
        table = np.clip(np.rint(np.arange(256) * exposure ** (1 / 2.3)), 0, 255).astype(np.uint8)
        capture = replace(capture, images={name: table[image] for name, image in capture.images.items()})
    if noise:
        capture = noisier(capture, noise)
    return change_pictures(capture, lambda picture: _packed(picture, jpeg)) if jpeg else capture


def _packed(picture: np.ndarray, quality: int) -> np.ndarray:
    data = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[:, :, ::-1])


def compare(name: str, capture: Capture, rig: Rig) -> list[Row]:
    silhouettes = segment(capture, rig, SegmentationSettings(), report=discard_progress)
    return [compare_view(name, view, silhouettes[view]) for view in rig.names]


def summarise(rows: list[Row]) -> dict[str, float]:
    """Overlap of the views, distances from the true contour (px of the whole size), and what views say."""
    overlap, off = np.array([row.overlap for row in rows]), np.concatenate([row.off_px for row in rows])
    return {
        "iou_median": float(np.median(overlap)),
        "iou_worst": float(overlap.min()),
        "contour_px_median": float(np.median(off)),
        "contour_px_rms": float(np.sqrt((off**2).mean())),
        "contour_px_p95": float(np.quantile(off, 0.95)),
        "far_share": float((off > FAR_PX).mean()),
        "left_out": sum(not row.silhouette.quality.usable for row in rows),
        "warned": sum(bool(row.silhouette.quality.warnings) for row in rows),
    }
