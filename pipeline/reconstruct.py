"""Capture to textured head (section 4): the composition that the worker, the command line and the tests all call."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from pipeline.alignment import feature_alignment
from pipeline.alignment_search import search_alignment
from pipeline.atlas import paint_atlas
from pipeline.drift import find_drift
from pipeline.eigenheads.kernel import with_kernel
from pipeline.eigenheads.model import HeadModel, with_modes
from pipeline.evidence import camera_figures, start_masks
from pipeline.fitting.contour import finish, solve_contour
from pipeline.fitting.fit import Fit
from pipeline.fitting.photo import refine_with_photographs
from pipeline.fitting.posterior import vertex_deviation_mm
from pipeline.fitting.schedule import fit_simplex
from pipeline.measurements import landmarks, measurements
from pipeline.reconstruction import Detail, Reconstruction, ReportWarning
from pipeline.segmentation import segment
from pipeline.settings import Settings
from pipeline.silhouette import Silhouette
from pipeline.texture import texture
from pipeline.unwrap import unwrap
from pipeline.zbuffer import depth_maps
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.geometry import Similarity
from rig.layout import Rig
from rig.mesh import Mesh
from rig.render.renderer import Renderer

VIEWS_LEAST = 3
Report = Callable[[str, float], None]
Segment = Callable[..., dict[str, Silhouette]]


class TooFewViews(EigenheadError):
    """Not enough usable silhouettes."""

    def __init__(self, silhouettes: Mapping[str, Silhouette]) -> None:
        poor = {name: s.quality.warnings for name, s in silhouettes.items() if not s.quality.usable}
        told = "; ".join(f"{name}: {', '.join(reasons) or 'unusable'}" for name, reasons in poor.items())
        super().__init__(
            f"only {len(silhouettes) - len(poor)} of {len(silhouettes)} views have a usable silhouette, "
            f"{VIEWS_LEAST} are needed ({told}). Take new clean plates with the same light, or supply masks/"
        )


@dataclass
class Clock:
    """Seconds by stage, and the one place that reports it."""

    report: Report
    seconds: dict[str, float] = field(default_factory=dict)
    _stage: str = ""
    _since: float = field(default_factory=time.perf_counter)

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now
        if stage:
            self.report(stage, 0.0)


def reconstruct(
    capture: Capture,
    rig: Rig,
    model: HeadModel,
    settings: Settings,
    *,
    renderer: Renderer,
    report: Report,
    segment: Segment = segment,
) -> Reconstruction:
    """Capture to textured head (section 4). Reads and writes no files. A caller that keeps silhouettes gives a
    ``segment`` of its own.

    Raises EigenheadError where there is no answer (too few usable views, feature points that determine nothing), and
    Cancelled when ``report`` does.
    """
    started = time.perf_counter()
    clock = Clock(report)
    clock("segmentation")
    silhouettes = segment(capture, rig, settings.segmentation, report=report)
    if sum(silhouette.quality.usable for silhouette in silhouettes.values()) < VIEWS_LEAST:
        raise TooFewViews(silhouettes)
    silhouettes, moved = without_moved_cameras(silhouettes, rig)
    clock("alignment")
    model = basis(model, settings)
    front = front_camera(rig, settings)
    start, warnings = align(model, capture, silhouettes, rig, settings, front, report)
    clock("fit")
    fit, model, detail = fit_head(model, start, capture, silhouettes, rig, settings, renderer, report)
    clock("texture")
    full = model.levels["full"]
    mesh = Mesh(fit.world_from_head.apply(model.vertices(fit.coefficients)), full.faces)
    normals, depths = mesh.normals(), depth_maps(rig, mesh)
    coloured = texture(mesh, normals, capture, silhouettes, rig, depths, settings.texture)
    atlas = None
    if settings.outputs.atlas:
        clock("atlas")
        layout = unwrap(model.vertices(np.zeros(0)), full.faces)
        atlas = paint_atlas(layout, mesh, normals, coloured, capture, silhouettes, rig, depths, settings.texture)
    clock("evidence")
    before = start_masks(model, start, rig)
    fitted_masks = {name: np.isfinite(depth) for name, depth in depths.items()}
    figures = camera_figures(model, fit, silhouettes, rig, fitted_masks, before)
    quality = vertex_deviation_mm(model, fit)
    clock("")
    report("done", 1.0)
    return Reconstruction(
        fit=fit,
        model_name=model.name,
        model_sha256=model.sha256,
        mesh_world=mesh,
        normals=normals,
        colours=coloured.colours,
        views=coloured.views,
        quality_mm=quality,
        silhouettes=silhouettes,
        start_masks=before,
        fitted_masks=fitted_masks,
        cameras=figures,
        landmarks=landmarks(model, fit),
        measurements=measurements(model, fit),
        front=front,
        settings=settings,
        digests=capture.digests,
        seconds=clock.seconds | {"total": time.perf_counter() - started},
        warnings=(*view_warnings(silhouettes), *moved, *warnings, *coloured.warnings),
        gains=coloured.gains,
        detail=detail,
        atlas=atlas,
    )


def without_moved_cameras(
    silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[dict[str, Silhouette], list[ReportWarning]]:
    """Views of cameras that no longer stand where they were calibrated take no part; each is named."""
    kept, warnings = dict(silhouettes), []
    for drift in find_drift(silhouettes, rig):
        quality = replace(silhouettes[drift.camera].quality, usable=False)
        kept[drift.camera] = replace(silhouettes[drift.camera], quality=quality)
        warnings.append(ReportWarning("camera-moved", str(drift)))
    return kept, warnings


def basis(model: HeadModel, settings: Settings) -> HeadModel:
    """The modes that the settings ask for: the eigenheads in use, and the kernel's where the detail goes beyond."""
    span = settings.detail == "span" or settings.method == "simplex"
    return _basis(model, min(settings.fitting.modes, len(model.modes)), kernel=not span)


@lru_cache(maxsize=2)  # models are few, jobs are many, and others keep what they make of the same model
def _basis(model: HeadModel, modes: int, *, kernel: bool) -> HeadModel:
    return with_kernel(model, modes) if kernel else with_modes(model, modes)


def front_camera(rig: Rig, settings: Settings) -> str:
    """The camera that the subject faces: the stated one, or the middle of the fan."""
    if settings.front is None:
        return rig.front_camera()
    if settings.front not in rig:
        raise EigenheadError(f"front camera {settings.front!r} is not in the rig; it has {', '.join(rig.names)}")
    return settings.front


def align(
    model: HeadModel,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: Settings,
    front: str,
    report: Report,
) -> tuple[Similarity, list[ReportWarning]]:
    """world_from_head of the mean head: from feature points (section 4.2), or found from the silhouettes."""
    if not capture.features:
        return search_alignment(model, silhouettes, rig, settings, front=front, report=report), []
    found = feature_alignment(model, capture.features, rig, settings.alignment)
    return found.world_from_head, [ReportWarning("features", remark) for remark in found.remarks]


def fit_head(
    model: HeadModel,
    start: Similarity,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: Settings,
    renderer: Renderer,
    report: Report,
) -> tuple[Fit, HeadModel, Detail]:
    """Section 4.4 by the solver that the settings name: the fit, the model with the modes that it has, and how deep it
    went."""
    if settings.method == "simplex":
        # The simplex never moves the pose, and what seven points leave (3 degrees, 5 mm) would all become shape.
        posed = solve_contour(model, start, silhouettes, rig, settings.fitting, features=capture.features)
        place = posed.state.world_from_head
        fit = fit_simplex(model, place, silhouettes, rig, settings.fitting, renderer=renderer, report=report)
        return fit, model, Detail("span", "the simplex searches the eigenheads alone")
    solved = solve_contour(model, start, silhouettes, rig, settings.fitting, features=capture.features, report=report)
    detail = Detail("span" if settings.detail == "span" else "kernel", "the settings ask for it")
    if settings.detail in (None, "photo"):
        solved, detail = refine_with_photographs(solved, capture.images, settings.photo)
    return finish(solved), solved.problem.model, detail


def view_warnings(silhouettes: Mapping[str, Silhouette]) -> list[ReportWarning]:
    found = []
    for name, silhouette in silhouettes.items():
        code = "view" if silhouette.quality.usable else "view-left-out"
        found += [ReportWarning(code, f"{name}: {text}") for text in silhouette.quality.warnings]
    return found
