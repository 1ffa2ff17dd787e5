"""Reads the head, its standard deviations and its landmarks from a result folder, for verification."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from pipeline.head_model.subdivision import vertex_areas
from pipeline.results.report_types import Report as ReportDocument
from rig.errors import InputError
from rig.formats.meshes.ply import read_head_ply
from rig.geometry import RigidTransform
from rig.mesh import Mesh
from rig.messages.message import compose

# Codes of warnings that question the head.
DOUBTFUL = ("face-elsewhere", "no-face", "pose-doubtful", "scale-assumed", "scale-implausible")


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Holds one reconstructed head. ``stated_mm`` is the standard deviation of each vertex along the normal, as the
    result states it."""

    name: str
    mesh_world: Mesh
    stated_mm: Float[np.ndarray, " v"]
    areas: Float[np.ndarray, " v"]  # mm2 that each vertex stands for
    regions: Mapping[str, Bool[np.ndarray, " v"]]
    landmarks: Mapping[str, Float[np.ndarray, " 3"]]  # world
    head_from_world: RigidTransform
    warnings: tuple[str, ...] = ()  # codes
    expression: Mapping[str, float] = field(default_factory=dict)  # weights by the model's names
    pictures: frozenset[str] = frozenset()  # SHA-256 of the photographs


@dataclass(frozen=True, slots=True)
class ResultIdentity:
    """Holds the name of the head model that made a result, and the SHA-256 of the model's file."""

    model: str
    sha256: str


def is_result(folder: Path) -> bool:
    """Returns whether a folder holds the result of a reconstruction: a report.json and a head.ply."""
    return (folder / "report.json").is_file() and (folder / "head.ply").is_file()


def identity_of(folder: Path) -> ResultIdentity:
    """Returns the head model with which a result was made. Raises InputError if report.json does not name it."""
    try:
        model = read_report(folder)["model"]
        return ResultIdentity(str(model["name"]), str(model["sha256"]))
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder.name}/report.json", [f"lacks {error}"]) from error


def read_measured(folder: Path, model: HeadModel, name: str) -> Measured:
    """Reads a result folder that was made with ``model``. Raises InputError with all invalid files and fields."""
    report = read_report(folder)
    mesh, stated_mm = read_head_ply(folder / "head.ply")
    full = model.levels["full"]
    if len(mesh.vertices) != full.count or not np.array_equal(mesh.faces, full.faces):
        raise InputError(f"{name}/head.ply", [f"has not the vertices of the model {model.name}; name its --model"])
    try:
        marks = {key: np.array(of["position"], float) for key, of in report["landmarks"].items()}
        place = report["world_from_head"]
        rotation = np.array(place["rotation"], float)
        translation = place["scale"] * np.array(place["translation"], float)
        codes = tuple(str(warning["code"]) for warning in report["warnings"])
        expression = {str(each["name"]): float(each["weight"]) for each in report.get("expression", ())}
        inputs = report.get("inputs", {}).items()
        pictures = frozenset(str(sha256) for name, sha256 in inputs if name.startswith("images/"))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{name}/report.json", [f"is no report that can be read ({error!r})"]) from error
    return Measured(
        name=name,
        mesh_world=mesh,
        stated_mm=stated_mm,
        areas=vertex_areas(mesh.vertices, mesh.faces),
        regions=head_regions(model),
        landmarks=marks,
        head_from_world=RigidTransform(rotation, translation).inverse(),
        warnings=codes,
        expression=expression,
        pictures=pictures,
    )


def read_report(folder: Path) -> ReportDocument:
    """Returns the decoded report.json of a result without checking its contents. Raises InputError."""
    try:
        return json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError) as error:
        below = sorted(path.name for path in folder.glob("*") if is_result(path))
        if below:
            several = compose("results-below", names=below[:3], count=len(below), first=str(folder / below[0]))
            raise InputError(str(folder), [several]) from error
        raise InputError(f"{folder}/report.json", [compose("report-missing")]) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{folder.name}/report.json", [f"cannot be read ({error})"]) from error
