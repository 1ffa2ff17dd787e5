"""Builds a head model from a folder of raw scans: checks, correspondence (the paper's section 3.2), alignment,
principal components (3.1)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from pipeline.applications.model_building.correspondence.correspondence import WORKERS, correspond, workers
from pipeline.applications.model_building.correspondence.scan_checks import Checked, check
from pipeline.applications.model_building.correspondence.scans import find_scans, read_scan
from pipeline.applications.model_building.training.training import Training, train
from pipeline.head_model.model import HeadModel, assemble
from pipeline.head_model.model_file import ModelParts, read_parts, save_model
from pipeline.head_model.model_names import model_path
from rig.errors import InputError
from rig.progress import Progress

FEWEST = 3  # heads; they give two modes, and each can be left out to measure generalisation
_SHARPENINGS = 4  # steps of the iteration in ``compute_cages``


@dataclass(frozen=True, slots=True, eq=False)
class Built:
    """Holds a model built from scans, and the names of the used, repaired and skipped scans."""

    parts: ModelParts
    used: tuple[str, ...]
    repaired: Mapping[str, tuple[str, ...]]  # what was repaired, by scan
    skipped: Mapping[str, str]  # faults of each omitted scan, by name


def build_model(
    scans_folder: Path, out: Path, *, name: str, on_bad: Literal["stop", "skip"] = "stop", report: Progress
) -> Built:
    """Builds a model from the scans of a folder and saves it as ``out``.

    All scans are checked before any other work. With ``on_bad="stop"``, scans with faults raise one InputError that
    lists them; with ``"skip"`` they are left out. Also raises InputError if fewer than 3 scans remain."""
    parts, sha256 = read_parts(model_path("default"))
    template = assemble(parts, sha256)
    good, skipped = read_checked(scans_folder, template, report)
    if skipped and on_bad == "stop":
        raise InputError(
            str(scans_folder), [*skipped.values(), "mend or remove them, or leave them out with --skip-bad"]
        )
    if len(good) < FEWEST:
        raise InputError(str(scans_folder), [f"{len(good)} sound scans, needed are {FEWEST}", *skipped.values()])
    heads = compute_cages(correspond([entry.scan for entry in good], template, report), template)
    training = Training(
        name=name,
        licence="not stated",
        source=f"{len(good)} raw scans",
        notice="Built by eigenhead from raw scans; the rights in the scans apply.",
        subjects={"total": len(good), "male": 0, "female": 0},  # scans do not say
        heads=heads,
        faces=parts.faces,
        landmarks=template.landmarks,
        subdivisions=parts.subdivisions,
    )
    built = train(training, report=report)
    save_model(out, built)
    repaired = {entry.scan.name: entry.repairs for entry in good if entry.repairs}
    return Built(built, tuple(entry.scan.name for entry in good), repaired, skipped)


def read_checked(folder: Path, template: HeadModel, report: Progress) -> tuple[list[Checked], dict[str, str]]:
    """Returns the faultless scans of a folder, and all others' faults. Raises InputError for an empty folder."""
    paths = find_scans(folder)
    with workers(WORKERS, len(paths)) as crew:
        found = crew.over(partial(_read_and_check, template), paths, "checking scans", report)
    good = [entry for entry in found if isinstance(entry, Checked)]
    return good, {path.stem: fault for path, fault in zip(paths, found, strict=True) if isinstance(fault, str)}


def _read_and_check(template: HeadModel, path: Path) -> Checked | str:
    """Returns the checked scan, or a text that describes its faults."""
    try:
        return check(read_scan(path), template)
    except InputError as fault:
        return str(fault)


def compute_cages(points: Float[np.ndarray, "N V0 3"], template: HeadModel) -> Float[np.ndarray, "N V0 3"]:
    """Computes coarse control meshes, called cages (mm), whose subdivision surface passes through given points.

    A subdivision surface lies inside its cage. The cage C must therefore solve S C = P, with the points P and the
    subdivision matrix's rows S for the cage's vertices. The matrix S nearly removes details as fine as the cage itself,
    so its inverse would amplify noise. A few iterations C += P - S C from the template's details avoid the noise."""
    rows = template.levels["full"].operator[: len(template.mean)]
    mean = template.mean.astype(float)
    away = points - rows @ mean
    cages = away.copy()
    for _ in range(_SHARPENINGS):
        cages += away - np.array([rows @ cage for cage in cages])
    return mean + cages
