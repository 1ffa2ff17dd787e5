"""Captures with more noise than they were taken with."""

from dataclasses import replace

import numpy as np

from rig.capture import Capture


def noisier(capture: Capture, levels: float) -> Capture:
    """The capture with white noise of that standard deviation (8-bit levels) on pictures and plates."""
    rng = np.random.default_rng(3)

    def worse(image: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(image + rng.normal(0.0, levels, image.shape)), 0, 255).astype(np.uint8)

    return replace(
        capture,
        images={name: worse(image) for name, image in capture.images.items()},
        backgrounds={name: tuple(map(worse, plates)) for name, plates in capture.backgrounds.items()},
    )
