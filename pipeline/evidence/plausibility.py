"""Checks whether a finished fit is plausible. Each check of plausibility has its own warning code.

The checks only add warnings to a result; ``settings.fail_on`` names the codes that become failures. The comments on the
thresholds give the values of two good captures: a real scan with closed eyes and hair (scale 1.024), and a random head
of another population (1.053).
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.contour_fit.fit import Fit
from pipeline.evidence.camera_metrics import CameraFigures
from pipeline.head_model.model import HeadModel
from pipeline.warnings import ReportWarning
from rig.errors import EigenheadError
from rig.messages.message import compose

MAX_SIZE = 2.9  # standard deviations of the heads' own size, which good heads exceed once in 268
MAX_SCALE_OFF = 0.07  # of size; 0.053 of a head from another population, more of a rig whose unit is wrong
MAX_UNSEEN = 0.12  # share of the face's vertices: 0.14 to 0.24 where three or four cameras stand on one side, 0.10 at
# most with a camera in front and one at each side, 0.01 before eleven
MAX_OUTSIDE_PX_PER_WIDTH = 0.003  # 3 px of 1024; at most 0.6 in 66 cameras of six good captures
OUTSIDE_TIMES_MEDIAN = 6.0  # and this many times what the other cameras have
UNEXPLAINED_SHARE = 0.9  # median over the views of the rim that the fit did not believe: 0.15 to 0.45 of nine captures
# with hair and beards, and of one whose face is turned by 90 degrees; 1.0 of a head three times too small
UNEXPLAINED_MM = 5.0  # and median over the views of the rim's RMS distance from its outline: 1 to 4 there, 40 here


class UnexplainedOutlines(EigenheadError):
    """Reports a fitted head that agrees with hardly any outline and is therefore wrong."""


class ImplausibleResult(EigenheadError):
    """Reports a result with warnings that are failures according to the settings."""

    def __init__(self, warnings: Sequence[ReportWarning]) -> None:
        reasons = [compose("warning-of-code", warning=warning.code, text=warning) for warning in warnings]
        super().__init__(compose("result-refused", warnings=reasons))


def plausibility_warnings(
    fit: Fit, model: HeadModel, cameras: Mapping[str, CameraFigures], widths_px: Mapping[str, int]
) -> list[ReportWarning]:
    """Returns the warnings about a result: an unlikely scale or size, or a poor contour.

    Args:
        fit: coefficients in standard deviations; scale relative to the model's own size.
        model: with the modes of the fit.
        cameras: contour residuals of every camera.
        widths_px: of the pictures, by camera.
    """
    return [*(_scale(fit.world_from_head.scale) or _size(*size_of(fit, model))), *_contours(cameras, widths_px)]


def unexplained_outlines(cameras: Mapping[str, CameraFigures], pixels_mm: Mapping[str, float]) -> ReportWarning | None:
    """Returns a warning if the head's rim misses the outlines in most views; otherwise None.

    Args:
        cameras: contour residuals of every camera.
        pixels_mm: width of a pixel at the head, by camera.
    """
    spoke = {name: of for name, of in cameras.items() if of.used and of.excluded_share is not None}
    misses_mm = [of.contour_rms_px * pixels_mm[name] for name, of in spoke.items() if of.contour_rms_px is not None]
    if not spoke or not misses_mm:
        return None
    shares = [of.excluded_share for of in spoke.values() if of.excluded_share is not None]
    if np.median(shares) < UNEXPLAINED_SHARE or np.median(misses_mm) < UNEXPLAINED_MM:
        return None
    poor = sum(share >= UNEXPLAINED_SHARE for share in shares)
    off_mm = np.median(misses_mm)
    return compose("outlines-unexplained", poor=poor, views=len(shares), off_mm=off_mm)


def unseen_face(views: UInt8[np.ndarray, " v"], face_region: Bool[np.ndarray, " v"]) -> ReportWarning | None:
    """Returns a warning if no camera sees a large part of the face, whose shape then follows the model's prior.

    Args:
        views: number of photographs that coloured each vertex.
        face_region: the face's vertices.
    """
    share = float(np.mean(views[face_region] == 0))
    return compose("face-unseen", share=share) if share > MAX_UNSEEN else None


def refuse(warnings: Iterable[ReportWarning], fail_on: Sequence[str]) -> None:
    """Raises ImplausibleResult if any warning has a code listed in ``fail_on``."""
    fatal = [warning for warning in warnings if warning.code in fail_on]
    if fatal:
        raise ImplausibleResult(fatal)


def _scale(scale: float) -> list[ReportWarning]:
    if abs(float(np.log(scale))) <= MAX_SCALE_OFF:
        return []
    warning = compose("scale-implausible", finding=compose("head-scale-off", scale=scale))
    return [warning]


def size_of(fit: Fit, model: HeadModel) -> tuple[float, float]:
    """Returns the size of the face relative to the mean face, and its deviation in standard deviations of the
    population. Size is the RMS distance of the face's vertices from their middle."""
    by_mode = size_by_mode(model)
    z = fit.coefficients[: len(by_mode)]
    size = float(np.log(fit.world_from_head.scale) + z @ by_mode[: len(z)])
    return float(np.exp(size)), size / float(np.linalg.norm(by_mode))


@lru_cache(maxsize=2)
def size_by_mode(model: HeadModel) -> Float[np.ndarray, " m"]:
    """Returns the derivative of the logarithm of the face's size by each coefficient; 0 for expressions."""
    face = model.levels["cage"].face_region
    mean = model.mean[face].astype(float)
    mean -= mean.mean(axis=0)
    found = np.einsum("mvc,vc->m", model.modes[:, face], mean) / float((mean**2).sum())
    found[list(model.posed)] = 0.0
    return found


def _size(size: float, sigmas: float) -> list[ReportWarning]:
    if abs(sigmas) <= MAX_SIZE:
        return []
    warning = compose("size-unusual", size=size, sigmas=abs(sigmas))
    return [warning]


def _contours(cameras: Mapping[str, CameraFigures], widths_px: Mapping[str, int]) -> list[ReportWarning]:
    """Returns a warning for each camera in which the head extends much farther beyond the outline than in most cameras.

    A rim inside the outline is not a fault: seen from above, a chin lies in front of the shirt, far inside the outline.
    """
    rms = {name: of.outside_rms_px for name, of in cameras.items() if of.used and of.outside_rms_px is not None}
    if not rms:
        return []
    median = float(np.median([rms[name] / widths_px[name] for name in rms]))
    limit = max(MAX_OUTSIDE_PX_PER_WIDTH, OUTSIDE_TIMES_MEDIAN * median)
    return [
        compose("contour-implausible", camera=name, outside_px=of)
        for name, of in rms.items()
        if of / widths_px[name] > limit
    ]
