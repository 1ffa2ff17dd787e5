"""Builds ``report.json`` of a verification (format ``eigenhead-verification/1``)."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import TypedDict

from pipeline.applications.verification.best_fit import BestFit
from pipeline.applications.verification.judgement import Judged, Judgement, Limits, RegionError
from pipeline.applications.verification.measured import ResultIdentity
from pipeline.applications.verification.reference import Reference
from rig.geometry import vector_from_rotation

FORMAT = "eigenhead-verification/1"


class RegionReport(TypedDict):
    """Describes the errors of a region of the head (mm); ``covered`` is the fraction of its area in the reference."""

    covered: float
    mean_mm: float
    rms_mm: float
    median_mm: float
    p95_mm: float


class AlignmentReport(TypedDict):
    """Describes the motion ``x_reference = rotation @ x_world + translation`` (mm), and its method."""

    method: str
    start: str
    rotation: list[list[float]]
    rotation_vector: list[float]
    translation: list[float]
    rms_mm: float
    points: int
    size_error_percent: float


class DistanceReport(TypedDict):
    """Describes a distance between two landmarks (mm): on the measured head, on the reference, and measured minus
    reference."""

    measured_mm: float
    reference_mm: float
    error_mm: float


class CaptureReport(TypedDict):
    """Describes the judgement of one capture. ``warnings`` are the warning codes of its result."""

    alignment: AlignmentReport
    probing_form_mm: float
    size_error_percent: float
    distance_rms_mm: float | None
    distances: dict[str, DistanceReport]
    regions: dict[str, RegionReport]
    warnings: list[str]


class CheckReport(TypedDict):
    """Describes a figure and its limit; ``value`` and ``passed`` are null if the captures or the reference do not
    provide the figure."""

    value: float | None
    limit: float
    passed: bool | None


class ReferenceReport(TypedDict):
    """Describes the reference scan: its name and digest, its size, and the names of its landmarks."""

    name: str
    sha256: str
    vertices: int
    triangles: int
    landmarks: list[str]


class VerificationReport(TypedDict):
    """Describes ``report.json`` of a verification."""

    format: str
    version: str
    date: str
    passed: bool
    checks: dict[str, CheckReport]
    model: dict[str, str]
    reference: ReferenceReport
    limits: dict[str, float]
    captures: dict[str, CaptureReport]
    repeated: dict[str, RegionReport]
    repeatability: dict[str, dict[str, float]]


@dataclass(frozen=True, slots=True)
class Occasion:
    """Holds the report's content besides the judgement: the day of the test (ISO 8601), the model, and the limits."""

    date: str
    model: ResultIdentity
    limits: Limits


def report_document(judgement: Judgement, reference: Reference, occasion: Occasion) -> VerificationReport:
    """Returns ``report.json`` of a verification, as JSON types."""
    return {
        "format": FORMAT,
        "version": version("eigenhead"),
        "date": occasion.date,
        "passed": judgement.passed,
        "checks": {
            check.name: {"value": check.value, "limit": check.limit, "passed": check.passed}
            for check in judgement.checks
        },
        "model": {"name": occasion.model.model, "sha256": occasion.model.sha256},
        "reference": {
            "name": reference.name,
            "sha256": reference.sha256,
            "vertices": len(reference.mesh.vertices),
            "triangles": len(reference.mesh.faces),
            "landmarks": sorted(reference.landmarks),
        },
        "limits": asdict(occasion.limits),
        "captures": {one.name: _capture(one) for one in judgement.captures},
        "repeated": _regions(judgement.repeated),
        "repeatability": {name: dict(figures) for name, figures in judgement.repeatability.items()},
    }


def _capture(one: Judged) -> CaptureReport:
    return {
        "alignment": _alignment(one.fit, one.size_error_percent),
        "probing_form_mm": one.probing_form_mm,
        "size_error_percent": one.size_error_percent,
        "distance_rms_mm": one.distance_rms_mm,
        "distances": {
            name: {"measured_mm": measured, "reference_mm": true, "error_mm": measured - true}
            for name, (measured, true) in one.distances_mm.items()
        },
        "regions": _regions(one.regions),
        "warnings": list(one.warnings),
    }


def _alignment(fit: BestFit, size_error_percent: float) -> AlignmentReport:
    motion = fit.reference_from_world
    return {
        "method": "rigid, least squares of the distances along the reference's normals over the face, by area",
        "start": fit.start,
        "rotation": motion.rotation.tolist(),
        "rotation_vector": vector_from_rotation(motion.rotation).tolist(),
        "translation": motion.translation.tolist(),
        "rms_mm": fit.rms_mm,
        "points": fit.points,
        "size_error_percent": size_error_percent,
    }


def _regions(regions: Mapping[str, RegionError]) -> dict[str, RegionReport]:
    return {
        name: {
            "covered": of.covered,
            "mean_mm": of.mean_mm,
            "rms_mm": of.rms_mm,
            "median_mm": of.median_mm,
            "p95_mm": of.p95_mm,
        }
        for name, of in regions.items()
    }
