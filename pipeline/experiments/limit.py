"""How far the contour solver is from the physical limit: RMSE over the Cramer-Rao bound, and interval coverage.

Gaussian noise is added to the signed distance of the true sub-pixel outline (binary masks are no regular problem): a
random field of standard deviation sigma whose correlation along any line has the integral l. Bare heads, exact cameras,
pose and scale unknown. The bound is ``e^2 = tr(B I^-1 B^T) / V`` over the face's vertices, with I the Fisher
information of the rim at the truth plus the prior.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32

from pipeline.eigenheads.model import HeadModel, with_modes
from pipeline.experiments.subjects import Planted, exact, exact_silhouettes, face_errors, random_subjects
from pipeline.fitting.contour import (
    PER_CAMERA,
    POSE,
    State,
    evaluate,
    fit_contour,
    make_problem,
    normal_equations,
    schedule,
)
from pipeline.fitting.fit import Fit
from pipeline.fitting.posterior import vertex_deviation_mm
from pipeline.settings import FittingSettings
from pipeline.silhouette import Silhouette
from rig.layout import Rig
from rig.mesh import vertex_normals
from rig.render.renderer import Renderer
from rig.studio.layout import default_layout

NOISES_PX, CORRELATION_PX = (0.3, 1.0), 2.0
UNROBUST_PX = 1e3  # a robust scale so wide that the bound knows of no outliers


def limit(
    model: HeadModel, *, renderer: Renderer, report: Callable[[str, float], None], subjects: int = 15, draws: int = 2
) -> dict[str, Any]:
    """eta and coverage over ``subjects`` x ``draws`` for each noise."""
    span, rig = with_modes(model, 60), exact(default_layout())
    planted = random_subjects(subjects, seed=91)
    rows = []
    for i, subject in enumerate(planted):
        clean = exact_silhouettes(model, subject, rig, renderer)
        for sigma in NOISES_PX:
            bound = bound_mm(span, subject, clean, rig, sigma)
            for draw in range(draws):
                report("limit", (i + draw / draws) / len(planted))
                rows.append(_row(span, subject, clean, rig, sigma, bound, np.random.default_rng([i, draw])))
    figures = {}
    for sigma in NOISES_PX:
        of = [row for row in rows if row["sigma_px"] == sigma]
        rmse, bounds = np.array([row["rmse_mm"] for row in of]), np.array([row["bound_mm"] for row in of])
        figures[f"eta_{sigma:g}px"] = float(np.sqrt((rmse**2).mean() / (bounds**2).mean()))
        figures[f"rmse_{sigma:g}px_mm"] = float(np.sqrt((rmse**2).mean()))
        figures[f"bound_{sigma:g}px_mm"] = float(np.sqrt((bounds**2).mean()))
        figures[f"coverage_95_{sigma:g}px"] = float(np.mean([row["covered"] for row in of]))
    figures["coverage_95"] = float(np.mean([row["covered"] for row in rows]))
    return {"figures": figures, "rows": rows}


def _row(
    model: HeadModel,
    subject: Planted,
    clean: dict[str, Silhouette],
    rig: Rig,
    sigma: float,
    bound: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    noisy = {name: with_noise(silhouette, sigma, CORRELATION_PX, rng) for name, silhouette in clean.items()}
    fit = fit_contour(model, subject.start, noisy, rig, settings_for(sigma))
    errors = face_errors(model, fit, subject)
    region = model.levels["full"].face_region
    normals = vertex_normals(subject.vertices(model), model.levels["full"].faces)[region]
    inside = np.abs((errors * normals).sum(axis=1)) < 1.96 * vertex_deviation_mm(model, fit)[region]
    return {
        "name": subject.name,
        "sigma_px": sigma,
        "rmse_mm": float(np.sqrt((errors**2).sum(axis=1).mean())),
        "bound_mm": bound,
        "covered": float(inside.mean()),
    }


def settings_for(sigma: float) -> FittingSettings:
    """The noise is stated, so that nothing is estimated; four sigma is no outlier."""
    return FittingSettings(
        contour_noise_px=sigma, contour_correlation_px=CORRELATION_PX, robust_px=max(1.5, 6.0 * sigma)
    )


def bound_mm(model: HeadModel, subject: Planted, clean: dict[str, Silhouette], rig: Rig, sigma: float) -> float:
    """The Cramer-Rao bound of the RMS face error."""
    settings = settings_for(sigma)
    stage = replace(schedule(settings, len(model.modes))[-1], whole_head=True)
    problem = make_problem(model, subject.world_from_head, clean, rig, settings, {})
    state = State(subject.coefficients, subject.world_from_head, np.zeros((len(rig), PER_CAMERA)))
    rim = evaluate(problem, state, stage, UNROBUST_PX, None).rim
    matrix, _ = normal_equations(problem, state, rim, stage, UNROBUST_PX)
    kept = stage.modes + POSE
    fit = Fit("bound", subject.coefficients, subject.world_from_head, 0, "", np.linalg.inv(matrix)[:kept, :kept])
    return rms_deviation_mm(model, fit)


def rms_deviation_mm(model: HeadModel, fit: Fit) -> float:
    """sqrt(tr(B C B^T) / V) over the face region, all three axes."""
    assert fit.covariance is not None
    factor = np.linalg.cholesky(fit.covariance)
    region = np.flatnonzero(model.levels["full"].face_region)[::7]  # the trace is smooth: every seventh vertex will do
    pose, count = fit.world_from_head, len(fit.coefficients)
    basis = model.basis("full", count, region).astype(float)
    arms = pose.apply(model.vertices(fit.coefficients)[region]) - pose.translation
    total = 0.0
    for axis in range(3):
        unit = np.eye(3)[axis]
        shape = pose.scale * np.einsum("c,mvc->vm", pose.rotation[axis], basis)
        rows = np.concatenate([shape, np.cross(arms, unit), np.broadcast_to(unit, arms.shape), arms[:, [axis]]], axis=1)
        total += float(((rows @ factor) ** 2).sum())
    return float(np.sqrt(total / len(region)))


def with_noise(silhouette: Silhouette, sigma: float, correlation: float, rng: np.random.Generator) -> Silhouette:
    """The silhouette with a random field added to its signed distance."""
    distance = (silhouette.distance + noise_field(silhouette.distance.shape, sigma, correlation, rng)).astype(
        np.float32
    )
    return Silhouette(distance < 0, distance)


def noise_field(
    shape: tuple[int, ...], sigma: float, correlation: float, rng: np.random.Generator
) -> Float32[np.ndarray, "h w"]:
    """White noise smoothed by a Gaussian of width a has the correlation exp(-x^2 / 4 a^2), whose integral is l for
    a = l / (2 sqrt(pi)). Reading it between pixels smooths it once more; the variance there and l are set right."""
    # Bilinear reading is a triangle of variance 1/6 px^2 about each axis in the mean over all places.
    width = float(np.sqrt(max((correlation / (2.0 * np.sqrt(np.pi))) ** 2 - 1.0 / 12.0, 0.04)))
    field = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), width)
    x, y = rng.uniform(1, shape[1] - 2, 20_000), rng.uniform(1, shape[0] - 2, 20_000)
    read = cv2.remap(field, x.astype(np.float32)[None], y.astype(np.float32)[None], cv2.INTER_LINEAR)
    return field * (sigma / float(read.std()))


def line_correlation_px(field: Float[np.ndarray, "h w"]) -> float:
    """Integral of the correlation along lines, read between pixels: what ``noise_field`` promises."""
    height, width = field.shape
    t = np.arange(0, min(height, width) - 4, 0.25)
    lines = []
    for k in range(200):
        angle = np.pi * k / 200
        x, y = width / 2 + (t - t.mean()) * np.cos(angle), height / 2 + (t - t.mean()) * np.sin(angle)
        lines.append(
            cv2.remap(
                field.astype(np.float32), x.astype(np.float32)[None], y.astype(np.float32)[None], cv2.INTER_LINEAR
            )[0]
        )
    values = np.array(lines)
    lags = np.arange(1, 60)
    variance = (values**2).mean()
    return float(0.25 * (1.0 + 2.0 * sum((values[:, lag:] * values[:, :-lag]).mean() / variance for lag in lags)))
