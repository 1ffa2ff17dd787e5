"""Writes a head in a patient's axes: head.ply with ``SPACE`` in its header, landmarks.mrk.json and frame.json.

3D Slicer reads the axes from the comment ``SPACE=LPS`` or ``SPACE=RAS`` in the PLY and from ``coordinateSystem`` in the
landmark list, so head, landmarks and volumes overlay each other."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.applications.clinic.anatomical_frame import POINTS, AnatomicalFrame, head_axes
from pipeline.applications.clinic.registration import Registration
from pipeline.applications.clinic.visit import Visit
from pipeline.applications.model_building.correspondence.scans import plain_name
from pipeline.applications.verification.write import heat_colours
from pipeline.results.head_files import uncertainty
from rig.files import write_atomically
from rig.formats.meshes.markups import Axes, MarkupPoint, markups_document, read_markups
from rig.formats.meshes.ply import write_ply
from rig.geometry import RigidTransform
from rig.mesh import Mesh

FORMAT = "eigenhead-patient-frame/1"
FRAME_FILE, HEAD_FILE, LANDMARK_FILE = "frame.json", "head.ply", "landmarks.mrk.json"
GREY = 200


def write_patient_files(folder: Path, visit: Visit, frame: AnatomicalFrame) -> dict[str, Any]:
    """Writes head.ply, landmarks.mrk.json and frame.json, and returns the content of frame.json. Raises OSError."""
    write_patient_mesh(folder / HEAD_FILE, visit, frame.patient_from_world, frame.axes)
    write_json(folder / LANDMARK_FILE, patient_landmarks(visit, frame.patient_from_world, frame.axes))
    document = frame_document(visit, frame)
    write_json(folder / FRAME_FILE, document)
    return document


def frame_document(visit: Visit, frame: AnatomicalFrame) -> dict[str, Any]:
    """Returns the content of frame.json for a frame."""
    return {
        "format": FORMAT,
        "axes": frame.axes,
        "unit": "mm",
        "plane": frame.plane,
        "points": dict(frame.sources),
        "tilt_deg": frame.tilt_deg,
        "tilt_std_deg": frame.tilt_std_deg,
        "patient_from_world": matrix_document(frame.patient_from_world),
        "patient_from_head": matrix_document(frame.patient_from_world @ visit.measured.head_from_world.inverse()),
    }


def matrix_document(motion: RigidTransform) -> list[list[float]]:
    """Returns a rigid transform as the four rows of its matrix, for column vectors in mm."""
    return [*np.column_stack([motion.rotation, motion.translation]).tolist(), [0.0, 0.0, 0.0, 1.0]]


def patient_landmarks(visit: Visit, patient_from_world: RigidTransform, axes: Axes) -> dict[str, Any]:
    """Returns the landmarks as a 3D Slicer point list in ``axes``."""
    points = {
        name: MarkupPoint(patient_from_world.apply(point), uncertainty(visit.landmark_std_mm.get(name)))
        for name, point in visit.measured.landmarks.items()
    }
    return markups_document(points, axes)


def write_patient_mesh(
    path: Path,
    visit: Visit,
    patient_from_world: RigidTransform,
    axes: Axes,
    *,
    colours: UInt8[np.ndarray, "v 3"] | None = None,
    quality: Float[np.ndarray, " v"] | None = None,
    comments: tuple[str, ...] = (),
) -> None:
    """Writes the head in a patient's axes, with the given or else the result's colours and standard deviations."""
    mesh = visit.measured.mesh_world
    moved = Mesh(patient_from_world.apply(mesh.vertices), mesh.faces)
    base = np.full(mesh.vertices.shape, GREY, np.uint8) if mesh.colours is None else mesh.colours
    write_ply(
        path,
        moved,
        normals=moved.normals(),
        colours=base if colours is None else colours,
        quality=visit.measured.stated_mm if quality is None else quality,
        views=visit.views,
        comments=[f"SPACE={axes}", "unit mm", *comments],
    )


def marked_points(path: Path | None, visit: Visit, axes: Axes) -> dict[str, Float[np.ndarray, " 3"]]:
    """Returns the points of the Frankfurt plane that a point list contains, in the world frame. The list's coordinates
    are those of head.ply in an export without the Frankfurt plane. Raises InputError if the point list is unusable."""
    if path is None:
        return {}
    world_from_patient = head_axes(visit.measured, axes).patient_from_world.inverse()
    named = {plain_name(label): point for label, point in read_markups(path, axes).items()}
    return {name: world_from_patient.apply(named[name]) for name in POINTS if name in named}


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Writes a JSON document, under a temporary name first."""
    write_atomically(path, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


REGISTRATION_FORMAT = "eigenhead-registration/1"
REGISTRATION_FILE = "registration.json"
COLOUR_END_MM = 2.0  # distance at which a colour of residual.ply is full


def write_registration(folder: Path, found: Registration) -> dict[str, Any]:
    """Writes head.ply, residual.ply, landmarks.mrk.json and registration.json; returns the content of
    registration.json. Raises OSError."""
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
    """Returns the content of registration.json."""
    motion, surface = found.fit.motion, found.surface
    deviations = np.sqrt(np.diag(found.fit.covariance))
    return {
        "format": REGISTRATION_FORMAT,
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
