"""Reads the heads of many results made with one head model, and builds a new model from them and their standard
deviations.

The heads already have the model's vertices and triangles, so no correspondence is needed. The old model is the prior
population; shapes outside its span come from the heads. Topology, landmarks and expressions stay the same, so the new
model can replace the old one.

The heads update the population, each vertex according to its accuracy. Mean and covariance have a
normal-inverse-Wishart prior from the old model (K. Murphy, *Conjugate Bayesian analysis of the Gaussian distribution*,
2007, section 8), which counts as a given number of heads. The reconstructed heads contain errors. Each head is
therefore replaced by its expected shape in the population, given its standard deviations, together with the covariance
of this shape: a step of expectation maximisation for a Gaussian with known noise. Without this expectation step, errors
in places that a rig's cameras cannot see would count as variation between people."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pipeline.applications.model_building.training.build import FEWEST, Built, compute_cages
from pipeline.applications.model_building.training.training import USED_MODES, above_neck, centred
from pipeline.applications.verification.measured import DOUBTFUL, Measured, identity_of, is_result, read_measured
from pipeline.head_model.model import HeadModel, assemble
from pipeline.head_model.model_file import ModelParts, read_parts, save_model
from pipeline.head_model.model_names import list_models, model_sha256
from pipeline.head_model.pca import Components, orthogonalised
from rig.errors import InputError
from rig.geometry import rigid_fit
from rig.messages.message import Message, compose
from rig.progress import Progress, discard_progress

MEAN_HEADS = 5.0  # as many observed heads as the known mean counts for
SPREAD_HEADS = 20.0  # and the known covariance
PATCHES = 33  # whose errors are independent: neighbours are off together
ROUNDS = 2
MIN_DEVIATION_MM = 0.05  # no vertex is known better


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """Holds a Gaussian distribution of heads (mm): the mean and orthogonal modes, scaled to one standard deviation."""

    mean: Float[np.ndarray, "V 3"]
    modes: Float[np.ndarray, "M V 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Delivered:
    """Holds N heads without expression in the head frame, mm, at true size."""

    names: tuple[str, ...]
    cages: Float[np.ndarray, "N V0 3"]
    deviation_mm: Float[np.ndarray, "N V0"]  # along the normal, above zero


def updated_model(parts: ModelParts, delivered: Delivered, *, name: str, report: Progress) -> ModelParts:
    """Returns the head model ``parts`` after it was updated with heads that were reconstructed with it. The figures
    include the mean distance (mm) between a face and the modes' span before and after, with each head held out once."""
    known = Population(parts.mean.astype(float), parts.modes.astype(float))
    weights = above_neck(known.mean, parts.landmarks)
    heads = np.array([rigid_fit(head, known.mean, weights).apply(head) for head in delivered.cages])
    components = updated(known, heads, delivered.deviation_mm, report=report)
    before, after = held_out_mm(known, heads, parts.face_region)
    modes_used = min(USED_MODES, len(components.modes))
    return replace(
        parts,
        name=name,
        licence=f"{parts.licence}; the rights in the delivered heads apply",
        source=f"{parts.name}, updated by {len(heads)} delivered heads",
        notice=f"{parts.notice} Updated by eigenhead from delivered heads.".strip(),
        subjects={"total": len(heads), "male": 0, "female": 0},  # results do not say
        mean=centred(components.mean[None], parts.landmarks)[0],
        modes=components.modes,
        sigma=components.sigma,
        scores=components.scores,
        figures={"held_out_mm": after, "held_out_before_mm": before, "modes_used": modes_used},
    )


def held_out_mm(
    known: Population, heads: Float[np.ndarray, "N V 3"], face: Bool[np.ndarray, " V"]
) -> tuple[float, float]:
    """Computes the mean distance (mm, over the face) of each head from the span of the first 60 modes, for the known
    population and for one updated with all other heads."""
    far = [
        [_nearest_mm(population, heads[k], face) for population in (known, pooled(known, np.delete(heads, k, axis=0)))]
        for k in range(len(heads))
    ]
    before, after = np.mean(far, axis=0)
    return float(before), float(after)


def _nearest_mm(population: Population, head: Float[np.ndarray, "V 3"], face: Bool[np.ndarray, " V"]) -> float:
    basis = population.modes[:USED_MODES].reshape(min(USED_MODES, len(population.modes)), -1)
    basis = basis / np.linalg.norm(basis, axis=1, keepdims=True)
    offset = (head - population.mean).ravel()
    left = (offset - (basis @ offset) @ basis).reshape(-1, 3)
    return float(np.linalg.norm(left[face], axis=1).mean())


def updated(
    known: Population,
    heads: Float[np.ndarray, "N V 3"],
    deviation_mm: Float[np.ndarray, "N V"],
    *,
    report: Progress = discard_progress,
) -> Components:
    """Returns the population updated with N observed heads, which are aligned to its mean.

    ``deviation_mm`` is the standard deviation of each vertex along an axis, above zero. ``scores`` are those of the
    heads' average in the new modes."""
    expected, spread = heads, np.zeros((0, *known.mean.shape))
    now = pooled(known, expected, spread)
    for k in range(ROUNDS):
        expected, spread = _expected(now, heads, deviation_mm)
        now = pooled(known, expected, spread)
        report("updating the population", (k + 1) / ROUNDS)
    flat = now.modes.reshape(len(now.modes), -1)
    sigma = np.linalg.norm(flat, axis=1)
    scores = (expected - now.mean).reshape(len(heads), -1) @ (flat / sigma[:, None] ** 2).T
    return Components(now.mean, now.modes, sigma, scores)


def pooled(
    known: Population, heads: Float[np.ndarray, "N V 3"], spread: Float[np.ndarray, "S V 3"] | None = None
) -> Population:
    """Returns the posterior mean of the population's mean and covariance. The rows of ``spread`` are a square root of
    the heads' additional covariance, summed over all heads."""
    count, average = len(heads), heads.mean(axis=0)
    mean = (count * average + MEAN_HEADS * known.mean) / (count + MEAN_HEADS)
    between = np.sqrt(count * MEAN_HEADS / (count + MEAN_HEADS)) * (average - known.mean)
    scatter = [heads - average, np.sqrt(SPREAD_HEADS) * known.modes, between[None]]
    rows = np.concatenate(scatter if spread is None else [*scatter, spread]) / np.sqrt(count - 1 + SPREAD_HEADS)
    return Population(mean, orthogonalised(rows)[0])


def _expected(
    population: Population, heads: Float[np.ndarray, "N V 3"], deviation_mm: Float[np.ndarray, "N V"]
) -> tuple[Float[np.ndarray, "N V 3"], Float[np.ndarray, "M V 3"]]:
    """Returns the expected shape of each head, given the population and the head's standard deviations, and a square
    root of the summed covariance of these shapes."""
    count, vertices = population.modes.shape[:2]
    weight = np.sqrt(min(1.0, PATCHES / vertices)) / deviation_mm
    coefficients, covariance = np.zeros((len(heads), count)), np.zeros((count, count))
    for k, head in enumerate(heads):
        basis = (population.modes * weight[k][:, None]).reshape(count, -1)
        found = np.linalg.inv(np.eye(count) + basis @ basis.T)
        coefficients[k] = found @ (basis @ ((head - population.mean) * weight[k][:, None]).ravel())
        covariance += found
    flat = population.modes.reshape(count, -1)
    expected = (coefficients @ flat).reshape(heads.shape) + population.mean
    return expected, (np.linalg.cholesky(covariance).T @ flat).reshape(-1, vertices, 3)


def build_from_results(folder: Path, out: Path, *, name: str, report: Progress = discard_progress) -> Built:
    """Builds a model from all results in or below ``folder`` and saves it as ``out``. Results with warnings that
    question the head are left out.

    Raises InputError with all faults, if results are damaged or of several models, or if fewer than 3 remain."""
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
    """Returns the folders of all results in or below ``folder``, sorted; links are followed, and each result is listed
    once. Raises InputError if the folder contains no result."""
    places: dict[str, Path] = {}
    for place, below, _ in os.walk(folder, followlinks=True):
        if places.setdefault(os.path.realpath(place), Path(place)) != Path(place):
            below.clear()
    found = tuple(sorted(filter(is_result, places.values())))
    if not found:
        raise InputError(str(folder), [compose("results-none")])
    return found


def read_delivered(
    folder: Path, folders: tuple[Path, ...], model: HeadModel, *, report: Progress = discard_progress
) -> tuple[Delivered, dict[str, Message]]:
    """Reads results that were made with ``model``. Returns the heads, and the reasons why results were left out, by
    their path below ``folder``. Raises InputError that lists every damaged result."""
    names, points, deviations, skipped, faults = [], [], [], {}, []
    used: dict[frozenset[str], str] = {}  # by the digests of a result's pictures
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
        if (first := used.setdefault(measured.pictures or frozenset([name]), name)) != name:
            skipped[name] = compose("result-of-same-capture", other=first)
            continue
        names.append(name)
        points.append(_neutral_points(model, measured))
        deviations.append(np.maximum(measured.stated_mm[: len(model.mean)], MIN_DEVIATION_MM))
        report("reading results", (k + 1) / len(folders))
    if faults:
        raise InputError(str(folder), faults)
    empty = np.zeros((0, *model.mean.shape))
    cages = compute_cages(np.array(points), model) if points else empty
    return Delivered(tuple(names), cages, np.array(deviations) if points else empty[:, :, 0]), skipped


def _model_of(folder: Path, folders: tuple[Path, ...]) -> ModelParts:
    """Returns the one head model with which all results were made. Raises InputError."""
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
    """Returns the head's surface points at the coarsest mesh's vertices, without the expression (head frame, mm)."""
    count = len(model.mean)
    known = {name: weight for name, weight in measured.expression.items() if name in model.expressions.names}
    moved = (model.levels["full"].operator @ model.expressions.moved(known))[:count]
    return measured.head_from_world.apply(measured.mesh_world.vertices[:count]) - moved
