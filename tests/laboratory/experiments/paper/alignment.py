"""Measures how often the alignment is found without feature points.

Random heads with hair and a shirt are turned by up to 30 degrees (yaw), 15 (pitch) and 15 (roll), and moved up to 60 mm
off the rig's centre. Each has another world frame, and its front camera is the one that the operator names. An
alignment is right if it is within 2 degrees and 3 mm of the truth after the fit: Procrustes of the face region against
its true vertices, and the distance of their means.
"""

import time
from dataclasses import replace

import numpy as np

from pipeline.alignment import silhouette_search
from pipeline.alignment.silhouette_search import search_alignment
from pipeline.head_model.model import HeadModel, with_modes
from pipeline.settings import Settings
from rig.errors import EigenheadError
from rig.geometry import RigidTransform, Similarity, nearest_rotation, rotation_from_vector, vector_from_rotation
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.subject import random_look
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.subjects import Planted, fit_contour, worn_silhouettes

TURN_DEG, OFF_MM = (30.0, 15.0, 15.0), 60.0  # yaw, pitch, roll; any direction
RIGHT_DEG, RIGHT_MM = 2.0, 3.0


def alignment(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 200) -> Outcome:
    """Returns the share of right alignments, their errors, and the seconds of the search."""
    records = bench.records("alignment", key_of(model.sha256, Settings(), *CONTOUR, silhouette_search))
    span, rows = with_modes(model, 60), []
    for seed in range(subjects):
        rows.append({"draw": seed} | records.row(str(seed), lambda s=seed: draw(span, s, renderer), seed / subjects))
    right = [row for row in rows if row["right"]]
    figures = {
        "draws": len(rows),
        "right_share": len(right) / len(rows),
        "search_seconds": float(np.mean([row["seconds"] for row in rows])),
    }
    for quantity in ("turn_deg", "off_mm") if right else ():
        values = np.array([row[quantity] for row in right])
        figures |= {f"{quantity}_mean": float(values.mean()), f"{quantity}_largest_of_right": float(values.max())}
    return {"figures": figures, "rows": rows, "wrong": [row["draw"] for row in rows if not row["right"]]}


def draw(model: HeadModel, seed: int, renderer: Renderer) -> Row:
    """Runs the search on one random subject in its own world frame."""
    rng = np.random.default_rng([77, seed])
    rig = default_layout()
    subject = random_sitter(rig, rng)
    style = random_look(rng).hair
    assert style is not None
    silhouettes = worn_silhouettes(model, subject, rig, renderer, style, rng)
    other = RigidTransform(rotation_from_vector(rng.standard_normal(3)), 300.0 * rng.standard_normal(3))
    foreign = Rig(tuple(replace(c, camera_from_world=c.camera_from_world @ other.inverse()) for c in rig))
    began = time.perf_counter()
    try:
        start = search_alignment(
            model, silhouettes, foreign, Settings(), front="cam00", stated=True, report=lambda s, f: None
        ).world_from_head
    except EigenheadError as error:
        return {"right": False, "error": str(error), "seconds": time.perf_counter() - began}
    seconds = time.perf_counter() - began
    fit = fit_contour(model, start, silhouettes, foreign, Settings().fitting)
    region = model.levels["full"].face_region
    true = other.apply(subject.vertices(model))[region]
    found = fit.world_from_head.apply(model.vertices(fit.coefficients))[region]
    a, b = true - true.mean(axis=0), found - found.mean(axis=0)
    turn = float(np.degrees(np.linalg.norm(vector_from_rotation(nearest_rotation(b.T @ a)))))
    off = float(np.linalg.norm(true.mean(axis=0) - found.mean(axis=0)))
    return {"right": turn < RIGHT_DEG and off < RIGHT_MM, "turn_deg": turn, "off_mm": off, "seconds": seconds}


def random_sitter(rig: Rig, rng: np.random.Generator) -> Planted:
    """Draws a head of the model, turned and shifted as far as a subject in the rig may be."""
    coefficients = np.clip(rng.standard_normal(60), -2, 2)
    yaw, pitch, roll = rng.uniform(-1, 1, 3) * np.radians(TURN_DEG)
    about = [rotation_from_vector(angle * np.eye(3)[axis]) for axis, angle in ((1, yaw), (0, pitch), (2, roll))]
    direction = rng.standard_normal(3)
    offset = OFF_MM * rng.uniform() * direction / np.linalg.norm(direction)
    pose = Similarity(1.0, about[0] @ about[1] @ about[2], rig.centre_world() + offset)
    return Planted("sitter", coefficients, pose, pose)
