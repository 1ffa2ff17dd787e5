"""Computes the content of a model file from corresponded heads: alignment, principal components, decimated meshes, face
region. The module also measures a model's compactness, generalisation and specificity (R. Davies, *Learning Shape:
Optimal Models for Analysing Natural Variability*, 2002, chapter 5). No single measure suffices: a model of one head is
compact and specific, and a model that allows any shape generalises well."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.head_model.decimation import decimate
from pipeline.head_model.model_file import ModelParts
from pipeline.head_model.pca import Components, align, principal_components
from pipeline.head_model.subdivision import check_manifold, refine, row_count
from rig.progress import Progress, discard_progress

PAPER_FACES = 96_000  # section 3.1; its levels of 95 % and 99 % have 4,800 and 960 triangles
FACE_WEIGHT = 4.0  # decimation keeps the face region this much more exactly than skull and neck
USED_MODES = 60  # section 4.4


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Training:
    """Holds corresponded heads (mm, in any common pose, y up, z out of the face), and the training's other inputs."""

    name: str
    licence: str
    source: str
    notice: str
    subjects: Mapping[str, int]
    heads: Float[np.ndarray, "N V0 3"]
    faces: Int[np.ndarray, "F 3"]
    landmarks: Mapping[str, int]
    subdivisions: int


def train(training: Training, *, report: Progress) -> ModelParts:
    """Computes a model's parts: rigid Procrustes alignment (no scale), PCA, decimated meshes, quality figures.

    Raises NotAManifold if the faces form no manifold."""
    check_manifold(training.faces)
    report("aligning", 0.0)
    ears = training.heads[:, [training.landmarks["tragion_right"], training.landmarks["tragion_left"]]].mean(1)
    heads = training.heads - ears[:, None]  # the origin inside each head, between its ears
    heads = align(heads, above_neck(heads[0], training.landmarks))
    heads = centred(heads, training.landmarks)
    report("principal components", 0.0)
    components = principal_components(heads)
    region = face_region(components.mean, training.landmarks)
    used = min(USED_MODES, len(components.modes))
    figures = {
        "generalisation_mm": generalisation(components, region, [used], report=report)[used],
        "specificity_mm": specificity(components.mean, components.modes[:used], heads, region),
        "modes_used": used,
    }
    return finish(training, components, region, figures, report=report)


def finish(
    training: Training,
    components: Components,
    region: Bool[np.ndarray, " V0"],
    figures: Mapping[str, float],
    *,
    report: Progress = discard_progress,
) -> ModelParts:
    """Builds the parts of a model file from its principal components. Decimated meshes are chosen on the mean head."""
    report("decimating", 0.0)
    decimated = decimate_levels(components.mean, training.faces, region, training.landmarks, training.subdivisions)
    report("decimating", 1.0)
    return ModelParts(
        name=training.name,
        licence=training.licence,
        source=training.source,
        notice=training.notice,
        subjects=training.subjects,
        mean=components.mean,
        modes=components.modes,
        sigma=components.sigma,
        landmarks=training.landmarks,
        faces=training.faces,
        face_region=region,
        subdivisions=training.subdivisions,
        decimated=decimated,
        figures=figures,
        scores=components.scores,
    )


def decimate_levels(
    mean: Float[np.ndarray, "V0 3"],
    faces: Int[np.ndarray, "F 3"],
    region: Bool[np.ndarray, " V0"],
    landmarks: Mapping[str, int],
    subdivisions: int,
) -> dict[str, tuple[Int[np.ndarray, " K"], Int[np.ndarray, "G 3"]]]:
    """Computes two decimated meshes with 95 % and 99 % fewer triangles: their vertices as indices into the finest mesh,
    and their faces. Decimation keeps every landmark.

    The meshes have 5 % and 1 % of the triangles of the finest mesh, or of the paper's 96,000 if a model has fewer."""
    full, full_faces = refine(faces, len(mean), subdivisions)
    targets = tuple(round(max(len(full_faces), PAPER_FACES) * share) for share in (0.05, 0.01))
    steps = 0
    while steps < subdivisions and len(faces) * 4**steps < 4 * targets[0]:
        steps += 1
    rough, rough_faces = refine(faces, len(mean), steps)
    count = row_count(rough)
    importance = np.where(rough @ region.astype(float) > 0.5, FACE_WEIGHT, 1.0)
    fixed = np.zeros(count, bool)
    fixed[list(landmarks.values())] = True
    # subdivision appends vertices, so the coarse level's indices are valid in the full level too
    places = (full[np.arange(count)]) @ mean
    p95, p99 = decimate(places, rough_faces, targets, importance=importance, fixed=fixed)
    return {"p95": p95, "p99": p99}


def centred(heads: Float[np.ndarray, "N V 3"], landmarks: Mapping[str, int]) -> Float[np.ndarray, "N V 3"]:
    """Returns all heads shifted by one vector, so that the origin is midway between the mean head's tragia."""
    return heads - heads.mean(0)[[landmarks["tragion_right"], landmarks["tragion_left"]]].mean(0)


def above_neck(head: Float[np.ndarray, "V 3"], landmarks: Mapping[str, int]) -> Float[np.ndarray, " V"]:
    """Returns vertex weights: 1 above a plane from chin to nape, 0 below it, so that the posture of the neck does not
    affect the head's alignment."""
    chin = head[landmarks["gnathion"]]
    slope = 0.35  # the line from under the chin to the nape rises towards the back
    return (head[:, 1] > chin[1] - 3 + slope * (chin[2] - head[:, 2])).astype(float)


def face_region(mean: Float[np.ndarray, "V 3"], landmarks: Mapping[str, int]) -> Bool[np.ndarray, " V"]:
    """Returns a mask of the face: in front of the ears, above the jaw line, below the hair."""
    at = {name: mean[index] for name, index in landmarks.items()}
    eye = (at["exocanthion_right"] + at["exocanthion_left"]) / 2
    jaw = (at["gonion_right"] + at["gonion_left"]) / 2
    chin = at["gnathion"]
    x, y, z = mean.T
    along = np.clip((chin[2] - z) / (chin[2] - jaw[2]), 0, 1.5)
    jaw_line = chin[1] + along * (jaw[1] - chin[1]) - 7.0
    half_width = max(abs(at["tragion_left"][0]), abs(at["tragion_right"][0]))
    return (y < eye[1] + 46.0) & (y > jaw_line) & (z > eye[2] - 60.0) & (np.abs(x) < half_width + 6.0)


def compactness(sigma: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """Returns, for each m, the fraction of the total variance in the first m modes."""
    return np.cumsum(sigma.astype(float) ** 2) / np.sum(sigma.astype(float) ** 2)


def generalisation(
    components: Components,
    region: Bool[np.ndarray, " V"],
    counts: Iterable[int],
    *,
    report: Progress = discard_progress,
) -> dict[int, float]:
    """Computes, by number of modes, the mean vertex distance (mm, over ``region``) between each head and its best fit
    in the PCA of all others.

    Training heads are represented exactly in the principal axes of the N heads. Each PCA without one head is therefore
    computed in N - 1 dimensions instead of 3 V."""
    counts = list(counts)
    points = components.scores * components.sigma  # mm, orthonormal axes
    axes = (components.modes / components.sigma[:, None, None])[:, region].reshape(len(components.sigma), -1)
    errors = {count: 0.0 for count in counts}
    for k in range(len(points)):
        others = np.delete(points, k, 0)
        centre = others.mean(0)
        _, _, directions = np.linalg.svd(others - centre, full_matrices=False)
        offset = points[k] - centre
        for count in counts:
            used = directions[: min(count, len(points) - 2)]
            left = offset - used.T @ (used @ offset)
            errors[count] += np.linalg.norm((left @ axes).reshape(-1, 3), axis=1).mean() / len(points)
        report("leaving one out", (k + 1) / len(points))
    return {count: float(value) for count, value in errors.items()}


def specificity(
    mean: Float[np.ndarray, "V 3"],
    modes: Float[np.ndarray, "M V 3"],
    heads: Float[np.ndarray, "N V 3"],
    region: Bool[np.ndarray, " V"],
    *,
    draws: int = 200,
    seed: int = 0,
) -> float:
    """Computes the mean distance (mm, over ``region``) between random heads of a model and the nearest of ``heads``."""
    rng = np.random.default_rng(seed)
    known = heads[:, region].astype(np.float32)
    total = 0.0
    for _ in range(draws):
        drawn = (mean + np.tensordot(rng.standard_normal(len(modes)), modes, 1))[region].astype(np.float32)
        total += np.linalg.norm(known - drawn, axis=2).mean(1).min() / draws
    return float(total)
