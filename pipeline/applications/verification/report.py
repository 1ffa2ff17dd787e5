"""Builds the document ``report.json`` of a verification (format ``eigenhead-verification/1``)."""

from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

from pipeline.applications.verification.best_fit import BestFit
from pipeline.applications.verification.judgement import Judged, Judgement, Limits
from pipeline.applications.verification.measured import ResultIdentity
from pipeline.applications.verification.reference import Reference
from rig.geometry import vector_from_rotation

FORMAT = "eigenhead-verification/1"


VerificationReport = dict[str, Any]
"""Describes ``report.json``: figures of the judgement by name, each as its class has it."""


@dataclass(frozen=True, slots=True)
class Occasion:
    """Holds the report's content besides the judgement: date of the test (ISO 8601), head model, and limits."""

    date: str
    model: ResultIdentity
    limits: Limits


def report_document(judgement: Judgement, reference: Reference, occasion: Occasion) -> VerificationReport:
    """Returns ``report.json`` of a verification, as JSON types. ``value`` and ``passed`` of a check are null if
    captures and reference do not allow the figure to be computed."""
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
        "repeated": {name: asdict(of) for name, of in judgement.repeated.items()},
        "repeatability": {name: dict(figures) for name, figures in judgement.repeatability.items()},
    }


def _capture(one: Judged) -> dict[str, Any]:
    return {
        "alignment": _alignment(one.fit, one.size_error_percent),
        "probing_form_mm": one.probing_form_mm,
        "size_error_percent": one.size_error_percent,
        "distance_rms_mm": one.distance_rms_mm,
        "distances": {
            name: {"measured_mm": measured, "reference_mm": true, "error_mm": measured - true}
            for name, (measured, true) in one.distances_mm.items()
        },
        "regions": {name: asdict(of) for name, of in one.regions.items()},
        "warnings": list(one.warnings),
    }


def _alignment(fit: BestFit, size_error_percent: float) -> dict[str, Any]:
    """Returns the motion ``x_reference = rotation @ x_world + translation`` (mm), and how it was computed."""
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
