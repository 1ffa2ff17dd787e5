"""Reads the heads of many results of one model, and builds a model from them."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.applications.model_building.training.build import FEWEST, Built, cages_through
from pipeline.applications.model_building.training.delivered import Delivered, updated_model
from pipeline.applications.verification.measured import DOUBTFUL, Measured, identity_of, is_result, read_measured
from pipeline.head_model.model import HeadModel, assemble
from pipeline.head_model.model_file import ModelParts, read_parts, save_model
from pipeline.head_model.model_names import list_models, model_sha256
from rig.errors import InputError
from rig.messages.message import Message, compose
from rig.progress import Progress

MIN_DEVIATION_MM = 0.05  # no vertex is known better


def build_from_results(folder: Path, out: Path, *, name: str, report: Progress | None = None) -> Built:
    """Builds a model from all results below ``folder`` and saves it as ``out``. Results whose warnings doubt the head
    are left out.

    Raises InputError, naming every fault, if results are damaged or of several models, or fewer than 3 are sound."""
    folders = find_results(folder)
    parts = _model_of(folder, folders)
    delivered, skipped = read_delivered(folder, folders, assemble(parts, ""), report=report)
    if len(delivered.names) < FEWEST:
        why = [compose("located", where=name, fault=fault) for name, fault in skipped.items()]
        raise InputError(str(folder), [compose("results-few", count=len(delivered.names), least=FEWEST), *why])
    trained = updated_model(parts, delivered, name=name, report=report)
    save_model(out, trained)
    return Built(trained, delivered.names, {}, {each: fault.text for each, fault in skipped.items()})


def find_results(folder: Path) -> tuple[Path, ...]:
    """Returns the folders of all results in or below ``folder``, in order. Raises InputError if there is none."""
    reports = sorted(folder.rglob("report.json"))
    found = tuple(path.parent for path in reports if is_result(path.parent))
    if not found:
        raise InputError(str(folder), [compose("results-none")])
    return found


def read_delivered(
    folder: Path, folders: tuple[Path, ...], model: HeadModel, *, report: Progress | None = None
) -> tuple[Delivered, dict[str, Message]]:
    """Reads results that ``model`` made. Returns the heads, and why results were left out, by their place below
    ``folder``. Raises InputError naming every damaged result."""
    names, points, deviations, skipped, faults = [], [], [], {}, []
    for k, place in enumerate(folders):
        name = place.relative_to(folder).as_posix() if place != folder else place.name
        try:
            measured = read_measured(place, model, name)
        except InputError as error:
            faults += error.located(f"{name}/{Path(error.subject).name}")
            continue
        doubts = tuple(code for code in measured.warnings if code in DOUBTFUL)
        if doubts:
            skipped[name] = compose("result-doubtful", warnings=doubts)
            continue
        names.append(name)
        points.append(_neutral_points(model, measured))
        deviations.append(np.maximum(measured.stated_mm[: len(model.mean)], MIN_DEVIATION_MM))
        if report:
            report("reading results", (k + 1) / len(folders))
    if faults:
        raise InputError(str(folder), faults)
    empty = np.zeros((0, *model.mean.shape))
    cages = cages_through(np.array(points), model) if points else empty
    return Delivered(tuple(names), cages, np.array(deviations) if points else empty[:, :, 0]), skipped


def _model_of(folder: Path, folders: tuple[Path, ...]) -> ModelParts:
    """Returns the one model that made all results. Raises InputError."""
    made: dict[tuple[str, str], list[str]] = {}
    for place, identity in zip(folders, map(identity_of, folders), strict=True):
        made.setdefault((identity.model, identity.sha256), []).append(place.relative_to(folder).as_posix())
    if len(made) > 1:
        models = tuple(f"{name} [{', '.join(places[:3])}]" for (name, _), places in sorted(made.items()))
        raise InputError(str(folder), [compose("results-of-models", models=models)])
    ((name, sha256),) = made
    for path in list_models().values():
        if model_sha256(path) == sha256:
            return read_parts(path)[0]
    raise InputError(str(folder), [compose("results-of-other-version", model=name)])


def _neutral_points(model: HeadModel, measured: Measured) -> Float[np.ndarray, "V0 3"]:
    """Returns the surface points at the cage's vertices, without the expression, in the head frame."""
    count = len(model.mean)
    known = {name: weight for name, weight in measured.expression.items() if name in model.expressions.names}
    moved = (model.levels["full"].operator @ model.expressions.moved(known))[:count]
    return measured.head_from_world.apply(measured.mesh_world.vertices[:count]) - moved
