"""Reads one visit of a patient from a result folder: head, landmarks and measurements with standard deviations."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.applications.verification.measured import (
    DOUBTFUL,
    Measured,
    ResultIdentity,
    identity_of,
    read_measured,
    read_report,
)
from pipeline.evidence.measurements import Measurement
from pipeline.head_model.model import load_model
from pipeline.head_model.regions import stable_region
from rig.errors import InputError
from rig.formats.meshes.ply import read_view_counts
from rig.messages.message import Message, compose, read_message


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """Holds one visit: the head, and the landmarks and measurements of its report with standard deviations."""

    measured: Measured
    views: UInt8[np.ndarray, " v"]  # images that coloured each vertex; 0 where it was filled
    landmark_std_mm: Mapping[str, Float[np.ndarray, " 3"]]
    measurements: Mapping[str, Measurement]
    identity: ResultIdentity
    stable: Bool[np.ndarray, " v"]  # forehead and bridge of the nose
    scale_sigma: float = 0.0  # relative standard deviation of all lengths together, which the deviations include
    warnings: tuple[Message, ...] = ()  # of the result, that doubt the head, each with the result's name


def read_visit(folder: Path, model: str | None = None) -> Visit:
    """Reads a result folder; ``model`` (a name or file) replaces the head model that its report names. Raises
    InputError if the folder cannot be used or the model is not installed."""
    identity = identity_of(folder)
    head_model = load_model(model or identity.model)
    measured = read_measured(folder, head_model, folder.resolve().name)
    report = read_report(folder)
    try:
        marks = {name: np.array(of["std"], float) for name, of in report["landmarks"].items() if of["std"]}
        lengths = {name: Measurement(of["value"], of["std"]) for name, of in report["measurements"].items()}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder.name}/report.json", [compose("report-unread", reason=repr(error))]) from error
    views, stable = read_view_counts(folder / "head.ply"), stable_region(head_model)
    doubts = (read_message(warning) for warning in report["warnings"] if warning["code"] in DOUBTFUL)
    warnings = tuple(compose("located", where=measured.name, fault=doubt) for doubt in doubts)
    return Visit(measured, views, marks, lengths, identity, stable, report.get("scale_sigma", 0.0), warnings)
