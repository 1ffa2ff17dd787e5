"""Measures how close the contour solver is to the physical limit: RMSE divided by the Cramer-Rao bound, and the
coverage of its intervals.

Gaussian noise of standard deviation sigma moves the true sub-pixel outline along its normals (with binary masks the
problem would not be regular); the integral of its correlation along the outline is l. Heads without hair, exact
cameras, pose and scale unknown. The bound is ``e^2 = tr(B I^-1 B^T) / V`` over the face's vertices, with I the Fisher
information of the rim at the truth plus the prior's.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

from pipeline.contour_fit.contour import schedule
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.head_problem import build_head_problem
from pipeline.contour_fit.posterior import vertex_deviation_mm
from pipeline.contour_fit.problem import PER_CAMERA, POSE, State, first_evidence, make_problem
from pipeline.head_model.model import HeadModel, with_modes
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from rig.mesh import vertex_normals
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments.records import Outcome, Row
from tests.support.subjects import Planted, exact, exact_silhouettes, face_errors, fit_contour, random_subjects

NOISES_PX, CORRELATION_PX = (0.3, 1.0), 2.0
BAND_PX = 12.0  # the noise reaches this far: no rim sample is farther off at the end
STEP_PX = 0.25  # of the noise along the contour
UNROBUST_PX = 1e3  # a robust scale so wide that the bound knows of no outliers


def limit(
    model: HeadModel, *, renderer: Renderer, report: Callable[[str, float], None], subjects: int = 15, draws: int = 2
) -> Outcome:
    """Runs this module's experiment. Returns, for each noise, the efficiency (error over bound) and the coverage over
    ``subjects`` heads with ``draws`` noises each."""
    span, rig = with_modes(model, 60), exact(default_layout())
    planted = random_subjects(subjects, seed=91)
    rows = []
    for i, subject in enumerate(planted):
        clean = exact_silhouettes(model, subject, rig, renderer)
        for sigma in NOISES_PX:
            bound = bound_mm(span, subject, clean, rig, sigma)
            for draw in range(draws):
                report("limit", (i + draw / draws) / len(planted))
                rows.append(
                    _row(span, subject, clean, rig, sigma=sigma, bound=bound, rng=np.random.default_rng([i, draw]))
                )
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
    *,
    sigma: float,
    bound: float,
    rng: np.random.Generator,
) -> Row:
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
    """Returns settings in which the noise is stated, so that it is not estimated, and residuals of up to four sigma are
    no outliers."""
    return FittingSettings(
        contour_noise_px=sigma, contour_correlation_px=CORRELATION_PX, robust_px=max(1.5, 6.0 * sigma)
    )


def bound_mm(model: HeadModel, subject: Planted, clean: dict[str, Silhouette], rig: Rig, sigma: float) -> float:
    """Returns the Cramer-Rao bound of the RMS face error."""
    settings = settings_for(sigma)
    stage = replace(schedule(settings, len(model.modes))[-1], whole_head=True)
    problem = make_problem(model, subject.world_from_head, clean, rig, settings, {})
    state = State(subject.coefficients, subject.world_from_head, np.zeros((len(rig), PER_CAMERA)))
    whole = build_head_problem(problem, first_evidence(settings), stage, UNROBUST_PX)
    matrix = whole.equations(whole.at(state)).matrix
    kept = stage.modes + POSE
    fit = Fit("bound", subject.coefficients, subject.world_from_head, 0, "", np.linalg.inv(matrix)[:kept, :kept])
    return rms_deviation_mm(model, fit)


def rms_deviation_mm(model: HeadModel, fit: Fit) -> float:
    """Returns the RMS standard deviation (mm) of the face region's vertices that the fit states, sqrt(tr(B C B^T) / V),
    over all three axes."""
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
    """Adds noise to a silhouette: moves its contour along its normals at random, with standard deviation ``sigma`` and
    correlation length ``correlation`` along the contour (px).

    Near the contour every pixel is moved like its nearest contour point. The signed distance thus keeps its slope of 1
    across the contour, which it would not with noise drawn for each pixel of the image.
    """
    points, arc = contour_points(silhouette.distance)
    band = np.abs(silhouette.distance) < BAND_PX
    rows, columns = np.nonzero(band)
    _, nearest = KDTree(points).query(np.stack([columns, rows], axis=1))
    displacement = contour_process(arc, sigma, correlation, rng)
    distance = silhouette.distance.copy()
    distance[band] += displacement[nearest]
    return Silhouette(distance < 0, distance)


def contour_points(distance: Float32[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Returns points (x, y) on the contour, at most STEP_PX apart, and the arc length (px) at each. Between separate
    pieces the arc length jumps by 1,000 px, so that their noise is independent."""
    slopes = np.stack([np.gradient(distance, axis=1), np.gradient(distance, axis=0)], axis=-1)
    pieces, _ = cv2.findContours((distance < 0).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    points, arcs, end = [], [], 0.0
    for piece in pieces:
        pixels = np.concatenate([piece[:, 0], piece[:1, 0]])
        x, y = pixels.T
        feet = pixels - distance[y, x, None] * slopes[y, x]  # from the pixel's centre to the contour
        length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(feet, axis=0), axis=1))]
        fine = np.linspace(0.0, length[-1], int(length[-1] / STEP_PX) + 2)
        points.append(np.stack([np.interp(fine, length, feet[:, axis]) for axis in (0, 1)], axis=1))
        arcs.append(end + fine)
        end += length[-1] + 1000.0
    return np.concatenate(points), np.concatenate(arcs)


def contour_process(
    arc: Float[np.ndarray, " n"], sigma: float, correlation: float, rng: np.random.Generator
) -> Float[np.ndarray, " n"]:
    """Draws a Gaussian process at the arc lengths. Read between pixels it has the standard deviation sigma and the
    correlation exp(-x^2 / 4 a^2), whose integral is ``correlation`` for a = l / (2 sqrt(pi)).

    Bilinear reading is one more filter, a triangle of variance 1/6 px^2; the process itself is narrower and stronger by
    as much.
    """
    read = correlation / (2.0 * np.sqrt(np.pi))
    width = np.sqrt(max(read**2 - 1.0 / 6.0, 0.04))
    smooth = gaussian_filter1d(rng.standard_normal(int(arc[-1] / STEP_PX) + 2), width / STEP_PX, mode="wrap")
    response = gaussian_filter1d(np.eye(1, 201, 100)[0], width / STEP_PX)
    smooth *= sigma * np.sqrt(read / width) / np.sqrt((response**2).sum())
    return np.interp(arc, STEP_PX * np.arange(len(smooth)), smooth)
