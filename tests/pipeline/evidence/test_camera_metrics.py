"""Figures of a camera: what a mask that is too small or too large does to each."""

import cv2
import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.evidence.camera_metrics import measure_cameras, start_masks
from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from rig.geometry import Similarity
from rig.rig import Rig
from rig.studio.scene.layout import default_layout


def grown(mask: np.ndarray, by_px: int) -> np.ndarray:
    """By so many pixels on all sides, or shrunk where it is negative."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(by_px) + 1,) * 2)
    change = cv2.dilate if by_px > 0 else cv2.erode
    return change(mask.astype(np.uint8), disc) > 0


def known(value: float | None) -> float:
    assert value is not None
    return value


def test_only_what_reaches_beyond_the_outline_contradicts_it() -> None:
    model, place = load_model(), Similarity(1.0, np.eye(3), np.zeros(3))
    rig = Rig(tuple(default_layout())[5:8])  # from the side, where the outline is the face's
    exact = start_masks(model, place, rig)
    small, right, large = rig.names
    masks = {small: grown(exact[small], -4), right: exact[right], large: grown(exact[large], 30)}
    silhouettes = {name: silhouette_from_mask(mask) for name, mask in masks.items()}
    fit = Fit("contour", np.zeros(0), place, 1, "converged")
    found = measure_cameras(model, fit, silhouettes, rig, exact, exact)
    assert found[small].outside_rms_px == pytest.approx(4.0, abs=1.0)
    assert known(found[right].outside_rms_px) < 0.5
    assert found[large].outside_rms_px == 0.0
    assert found[large].contour_rms_px == pytest.approx(30.0, abs=3.0)
    assert known(found[right].iou) > 0.99
    assert found[large].xor_cost == found[large].xor_cost_start
    assert known(found[large].xor_cost) > known(found[right].xor_cost)
