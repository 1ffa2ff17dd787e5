"""A model from 138 scans of 100,000 points: how long it takes, and whether it is as good as from known vertices.

python -m tests.laboratory model_build --subjects 138 --halves

The default database's heads are scanned (noise 0.1 mm, landmarks marked to 0.5 mm an axis, holes) and written as PLY;
``eigenhead model build`` is timed on the folder. ``seconds`` is by the clock, ``cpu_seconds`` what its processes used;
on a machine of one's own with two cores the first is little more than half of the second.

Generalisation (leave one out, 60 modes, face region, mm) stands beside that of the shipped model, made of the same
heads with known vertices. The shipped model is also the registration's prior and has seen these heads, so ``--halves``
repeats the correspondence with each half of the heads registered by a model of the other half.
"""

import resource
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
from jaxtyping import Float

from pipeline.applications.model_building.correspondence.scans import Scan
from pipeline.applications.model_building.correspondence.synthetic_scanner import Scanner, scan_head
from pipeline.applications.model_building.training.build import build_model, corresponded_cages
from pipeline.applications.model_building.training.training import Training, train
from pipeline.head_model.model import HeadModel
from pipeline.head_model.model_file import read_parts
from pipeline.head_model.model_names import model_path
from tests.laboratory.benchmarks.correspondence import without
from tests.support.landmark_files import write_landmarks

SPACING_MM = 1.12  # 100,000 points


def run(
    model: HeadModel,
    scratch: Path,
    *,
    subjects: int = 138,
    halves: Annotated[bool, "register each half with a model of the other, too"] = False,
) -> dict[str, Any]:
    """Returns the figures of this module."""
    scanner = Scanner(spacing_mm=SPACING_MM)
    chosen = np.random.default_rng(1).permutation(138)[:subjects].tolist()
    scans = [_scan(model, k, scanner) for k in chosen]
    figures = {"subjects": subjects, "points": float(np.mean([len(scan.vertices) for scan in scans]))}
    for scan in scans:
        trimesh.Trimesh(scan.vertices, scan.faces, process=False).export(scratch / f"{scan.name}.ply")
        write_landmarks(scratch / f"{scan.name}.json", scan.landmarks)
    began, used = time.perf_counter(), _cpu_seconds()
    built = build_model(scratch, scratch / "built.npz", name="built").parts
    figures |= {"seconds": time.perf_counter() - began, "cpu_seconds": _cpu_seconds() - used}
    known = _generalisation((model.mean + np.tensordot(model.scores, model.modes, 1))[chosen].astype(float))
    found = {"scans": built.figures["generalisation_mm"]}
    if halves:
        of = [range(0, subjects, 2), range(1, subjects, 2)]
        apart = [corresponded_cages([scans[i] for i in half], without([chosen[i] for i in half])) for half in of]
        found["halves"] = _generalisation(np.concatenate(apart))
    for name, value in found.items():
        figures |= {f"{name}_generalisation_mm": value, f"{name}_of_known": value / known}
    figures |= {"known_generalisation_mm": known}
    return {"figures": {name: round(value, 4) for name, value in figures.items()}}


def _scan(model: HeadModel, subject: int, scanner: Scanner) -> Scan:
    head = model.vertices(model.scores[subject].astype(float))
    rng = np.random.default_rng(subject)
    return scan_head(f"subject{subject}", head, model.levels["full"].faces, model.landmarks, scanner, rng)


def _generalisation(cages: Float[np.ndarray, "N V 3"]) -> float:
    parts = read_parts(model_path("default"))[0]
    training = Training(
        name="x", licence="", source="", notice="", subjects={}, heads=cages, faces=parts.faces,
        landmarks=parts.landmarks, subdivisions=parts.subdivisions,
    )  # fmt: skip
    return train(training).figures["generalisation_mm"]


def _cpu_seconds() -> float:
    process, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return process.ru_utime + process.ru_stime + children.ru_utime + children.ru_stime
