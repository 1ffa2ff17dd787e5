"""Finds a colour chart in a photograph (the 24 patches of a ColorChecker Classic, by OpenCV's mcc module), and computes
a camera's colour correction from it.

Colours in this module are linear light, 0 to 1, in the picture's colour channels. The true colours of the patches come
from OpenCV's colour correction model (X-Rite's values, in linear sRGB under D65: the white patch is 0.91)."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rig.camera import Camera
from rig.colour_space import linear_from_srgb

Plate = UInt8[np.ndarray, "h w 3"]

CELLS = (64, 48)  # of a plate, compared
DIFFERENT = 24.0  # levels, mean of a cell: black, white and coloured patches differ by more, light that drifts by less
MIN_CELLS = 4  # a chart of 50 px in a thousand has 6
ROWS, COLUMNS = 4, 6
WIDTHS_PX = (1024, 2048)  # of the picture, as it is searched: finds charts of 90 px and more there, then smaller ones
INNER = 0.5  # of a patch's sides: its rim is blurred, and its frame black
CLIPPED = 0.97  # linear level at which a sensor saturates
MIN_PATCHES = 18  # that are not clipped, for nine numbers
MAX_OFF = 0.06  # rms of what the correction leaves of the patches: its own colours in another order leave 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """Holds the centres (px) of a chart's 24 patches, row by row from dark skin to black, and the mean linear colour of
    each patch in the photograph."""

    centres: Float[np.ndarray, "24 2"]
    colours: Float[np.ndarray, "24 3"]


@cache
def true_colours() -> Float[np.ndarray, "24 3"]:
    """Returns the true colours of the patches in linear sRGB, D65."""
    any_colours = np.linspace(0.1, 0.9, 24 * 3).reshape(24, 1, 3)
    model = cv2.ccm.ColorCorrectionModel(any_colours, cv2.ccm.COLORCHECKER_MACBETH)
    model.setLinearization(cv2.ccm.LINEARIZATION_IDENTITY)
    model.compute()
    found = np.asarray(model.getRefLinearRGB(), float).reshape(24, 3)
    found.setflags(write=False)
    return found


def find_chart(picture: UInt8[np.ndarray, "h w 3"]) -> Chart | None:
    """Finds the colour chart in an sRGB picture; None if there is no chart, or if its colours differ too much from the
    true colours."""
    height, width = picture.shape[:2]
    for wanted in WIDTHS_PX:
        scale = wanted / width
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        looked_at = cv2.resize(picture, (wanted, max(1, round(height * scale))), interpolation=way)
        corners = _patches(np.ascontiguousarray(looked_at[:, :, ::-1]))
        if corners is None:
            continue
        corners = (corners + 0.5) / scale - 0.5
        chart = Chart(corners.mean(axis=1), np.array([_mean_colour(picture, patch) for patch in corners]))
        if chart_correction([chart]) is not None:
            return chart
    return None


def _patches(bgr: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "24 4 2"] | None:
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)  # it starts with whatever lies in memory
    detector.setUseDnnModel(False)
    try:
        found = detector.process(bgr, 1)
    except cv2.error:  # an assertion in its grouping of squares, in pictures without a chart
        found = False
    return np.asarray(detector.getBestColorChecker().getColorCharts(), float).reshape(24, 4, 2) if found else None


def _mean_colour(picture: UInt8[np.ndarray, "h w 3"], corners: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, " 3"]:
    middle = corners.mean(axis=0)
    inner = np.rint(middle + INNER * (corners - middle)).astype(np.int32)
    low, high = np.maximum(inner.min(axis=0), 0), inner.max(axis=0) + 1
    part = picture[low[1] : high[1], low[0] : high[0]]
    inside = np.zeros(part.shape[:2], np.uint8)
    if not inside.size:
        return np.zeros(3)
    cv2.fillConvexPoly(inside, inner - low, 1)
    return linear_from_srgb(part[inside > 0] / 255.0).mean(axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class ChartCorrection:
    """Holds the colour correction of a camera. The corrected linear sRGB colour is ``matrix`` @ the camera's linear
    colour; ``off`` is the RMS error of the patches after the correction."""

    matrix: Float[np.ndarray, "3 3"]
    off: float


def chart_correction(charts: list[Chart]) -> ChartCorrection | None:
    """Computes the matrix that best maps the patches of one camera's charts to their true colours, by least squares.
    Returns None if too many patches are clipped or the error stays too large."""
    seen = np.concatenate([chart.colours for chart in charts])
    true = np.concatenate([true_colours()] * len(charts))
    kept = (seen < CLIPPED).all(axis=1)
    if kept.sum() < MIN_PATCHES:
        return None
    # Dark patches should be as accurate as bright ones, relative to their brightness.
    weight = 1.0 / (0.1 + true[kept].mean(axis=1, keepdims=True))
    matrix = np.linalg.lstsq(seen[kept] * weight, true[kept] * weight, rcond=None)[0].T
    off = float(np.sqrt(np.mean((seen[kept] @ matrix.T - true[kept]) ** 2)))
    bright = matrix.sum(axis=1)  # of grey
    return ChartCorrection(matrix, off) if off < MAX_OFF and (bright > 0).all() else None


def chart_normal(chart: Chart, camera: Camera) -> Float[np.ndarray, " 3"]:
    """Returns the unit normal of the chart in the world frame."""
    grid = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2).astype(float)
    flat = np.column_stack([grid, np.zeros(len(grid))])
    _, turn, _ = cv2.solvePnP(flat, camera.undistort(chart.centres), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    towards = -cv2.Rodrigues(turn)[0][:, 2]  # rows go down and columns right: the third axis points away
    towards = towards if towards[2] < 0 else -towards
    return camera.camera_from_world.rotation.T @ towards


def empty_plates(plates: tuple[Plate, ...]) -> tuple[Plate, ...]:
    """Returns the clean plates that show no colour chart, or all plates if every plate shows one."""
    if len(plates) < 2 or not _differ(plates):
        return plates
    return tuple(plate for plate in plates if find_chart(plate) is None) or plates


def find_charts(plates: tuple[Plate, ...]) -> list[Chart]:
    """Finds the colour charts in one camera's clean plates. If the plates are nearly equal, the first is searched."""
    searched = plates if len(plates) > 1 and _differ(plates) else plates[:1]
    return [chart for chart in map(find_chart, searched) if chart is not None]


def _differ(plates: tuple[Plate, ...]) -> bool:
    small = np.stack([cv2.resize(plate, CELLS, interpolation=cv2.INTER_AREA) for plate in plates]).astype(np.float32)
    levels = small.mean(axis=(1, 2, 3), keepdims=True)
    small *= levels.mean() / np.maximum(levels, 1.0)  # another exposure is no chart
    spread = (small.max(axis=0) - small.min(axis=0)).max(axis=2)
    return int(np.count_nonzero(spread > DIFFERENT)) >= MIN_CELLS
