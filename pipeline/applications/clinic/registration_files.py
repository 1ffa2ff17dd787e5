"""Writes a head on a patient's surface: head.ply and landmarks.mrk.json in its axes, what is left, and the motion."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.applications.clinic.patient_files import (
    HEAD_FILE,
    LANDMARK_FILE,
    matrix_document,
    patient_landmarks,
    write_json,
    write_patient_mesh,
)
from pipeline.applications.clinic.registration import Registration
from pipeline.applications.verification.pictures import heat_colours

FORMAT = "eigenhead-registration/1"
REGISTRATION_FILE = "registration.json"
COLOUR_END_MM = 2.0  # distance at which a colour of residual.ply is full


def write_registration(folder: Path, found: Registration) -> dict[str, Any]:
    """Writes head.ply, residual.ply, landmarks.mrk.json and registration.json, and returns what the last says. Raises
    OSError."""
    motion, axes = found.fit.motion, found.surface.axes
    write_patient_mesh(folder / HEAD_FILE, found.visit, motion, axes)
    write_patient_mesh(
        folder / "residual.ply",
        found.visit,
        motion,
        axes,
        colours=heat_colours(found.distance_mm, COLOUR_END_MM),
        quality=np.nan_to_num(found.distance_mm),
        comments=("quality: signed distance from the surface, mm; grey: nothing of it there",),
    )
    write_json(folder / LANDMARK_FILE, patient_landmarks(found.visit, motion, axes))
    document = registration_document(found)
    write_json(folder / REGISTRATION_FILE, document)
    return document


def registration_document(found: Registration) -> dict[str, Any]:
    """Returns what registration.json says."""
    motion, surface = found.fit.motion, found.surface
    deviations = np.sqrt(np.diag(found.fit.covariance))
    return {
        "format": FORMAT,
        "surface": {
            "name": surface.reference.name,
            "sha256": surface.reference.sha256,
            "axes": surface.axes,
            "axes_stated": surface.stated,
        },
        "head": {"name": found.visit.measured.name, "model": found.visit.identity.model},
        "start": found.start,
        "patient_from_world": matrix_document(motion),
        "patient_from_head": matrix_document(motion @ found.visit.measured.head_from_world.inverse()),
        "std_turn_deg": np.degrees(deviations[:3]).tolist(),
        "std_shift_mm": deviations[3:].tolist(),
        "figures": found.figures(),
    }
