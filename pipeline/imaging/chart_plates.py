"""Handles clean plates in which a colour chart is held up: they define colours, and do not show the empty studio.

To search a plate for a chart takes a tenth to a third of a second, so that only plates that may have one are searched.
"""

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.imaging.colour_chart import Chart, find_chart

Plate = UInt8[np.ndarray, "h w 3"]

CELLS = (64, 48)  # of a plate, compared
DIFFERENT = 24.0  # levels, mean of a cell: black, white and coloured patches differ by more, light that drifts by less
MIN_CELLS = 4  # a chart of 50 px in a thousand has 6


def empty_plates(plates: tuple[Plate, ...]) -> tuple[Plate, ...]:
    """Returns the plates that show no colour chart, or all plates if every one shows a chart."""
    if len(plates) < 2 or not _differ(plates):
        return plates
    return tuple(plate for plate in plates if find_chart(plate) is None) or plates


def charts_in(plates: tuple[Plate, ...]) -> list[Chart]:
    """Finds the colour charts in one camera's plates. If the plates look alike, only the first is searched."""
    searched = plates if len(plates) > 1 and _differ(plates) else plates[:1]
    return [chart for chart in map(find_chart, searched) if chart is not None]


def _differ(plates: tuple[Plate, ...]) -> bool:
    small = np.stack([cv2.resize(plate, CELLS, interpolation=cv2.INTER_AREA) for plate in plates]).astype(np.float32)
    levels = small.mean(axis=(1, 2, 3), keepdims=True)
    small *= levels.mean() / np.maximum(levels, 1.0)  # another exposure is no chart
    spread = (small.max(axis=0) - small.min(axis=0)).max(axis=2)
    return int(np.count_nonzero(spread > DIFFERENT)) >= MIN_CELLS
