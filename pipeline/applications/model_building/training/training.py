"""Turns corresponded heads into the content of a model file: alignment, principal components, levels, face region."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.applications.model_building.training import model_metrics
from pipeline.head_model.decimation import decimate
from pipeline.head_model.model_file import ModelParts
from pipeline.head_model.pca import Components, align, principal_components
from pipeline.head_model.subdivision import check_manifold, refine, row_count
from rig.progress import Progress

PAPER_FACES = 96_000  # section 3.1; its levels of 95 % and 99 % have 4,800 and 960 triangles
FACE_WEIGHT = 4.0  # decimation keeps the face region this much more exactly than skull and neck
USED_MODES = 60  # section 4.4


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Training:
    """Holds corresponded heads (mm, in any common pose, y up, z to the front), and what a model contains besides
    shape."""

    name: str
    licence: str
    source: str
    notice: str
    subjects: Mapping[str, int]
    heads: Float[np.ndarray, "N V0 3"]
    faces: Int[np.ndarray, "F 3"]
    landmarks: Mapping[str, int]
    subdivisions: int


def train(training: Training, *, report: Progress | None = None) -> ModelParts:
    """Computes a model's parts: rigid Procrustes alignment (no scale), PCA, levels, generalisation and specificity.

    Raises NotAManifold."""
    say = report or (lambda stage, fraction: None)
    check_manifold(training.faces)
    say("aligning", 0.0)
    heads = in_head_frame(training.heads, training.landmarks)
    heads = align(heads, above_neck(heads[0], training.landmarks))
    heads = centred(heads, training.landmarks)
    say("principal components", 0.0)
    components = principal_components(heads)
    region = face_region(components.mean, training.landmarks)
    used = min(USED_MODES, len(components.modes))
    figures = {
        "generalisation_mm": model_metrics.generalisation(components, region, [used], report=report)[used],
        "specificity_mm": model_metrics.specificity(components.mean, components.modes[:used], heads, region),
        "modes_used": used,
    }
    return finish(training, components, region, figures, report=report)


def finish(
    training: Training,
    components: Components,
    region: Bool[np.ndarray, " V0"],
    figures: Mapping[str, float],
    *,
    report: Progress | None = None,
) -> ModelParts:
    """Builds the parts of a model from its components. Decimated levels are chosen on the mean head."""
    say = report or (lambda stage, fraction: None)
    say("decimating", 0.0)
    decimated = levels_of(components.mean, training.faces, region, training.landmarks, training.subdivisions)
    say("decimating", 1.0)
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


def levels_of(
    mean: Float[np.ndarray, "V0 3"],
    faces: Int[np.ndarray, "F 3"],
    region: Bool[np.ndarray, " V0"],
    landmarks: Mapping[str, int],
    subdivisions: int,
) -> dict[str, tuple[Int[np.ndarray, " K"], Int[np.ndarray, "G 3"]]]:
    """Computes the levels of 95 % and 99 % reduction: their vertices as rows of the full level, and their faces. Every
    landmark is kept.

    They have 5 % and 1 % of the triangles of the full level, or of the paper's 96,000 if a model has fewer."""
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


def in_head_frame(heads: Float[np.ndarray, "N V 3"], landmarks: Mapping[str, int]) -> Float[np.ndarray, "N V 3"]:
    """Returns every head shifted (not rotated) so that its mean tragion is the origin, inside the head between the
    ears."""
    ears = heads[:, [landmarks["tragion_right"], landmarks["tragion_left"]]].mean(1)
    return heads - ears[:, None]


def centred(heads: Float[np.ndarray, "N V 3"], landmarks: Mapping[str, int]) -> Float[np.ndarray, "N V 3"]:
    """Returns all heads shifted alike, so that the origin is in the middle between the mean head's tragia."""
    return heads - heads.mean(0)[[landmarks["tragion_right"], landmarks["tragion_left"]]].mean(0)


def above_neck(head: Float[np.ndarray, "V 3"], landmarks: Mapping[str, int]) -> Float[np.ndarray, " V"]:
    """Returns weights: 1 above a plane from chin to nape, 0 below it, so that the posture of the neck does not rotate
    the head."""
    chin = head[landmarks["gnathion"]]
    slope = 0.35  # the line from under the chin to the nape rises towards the back
    return (head[:, 1] > chin[1] - 3 + slope * (chin[2] - head[:, 2])).astype(float)


def face_region(mean: Float[np.ndarray, "V 3"], landmarks: Mapping[str, int]) -> Bool[np.ndarray, " V"]:
    """Marks the face: in front of the ears, above the jaw line, below the hair."""
    at = {name: mean[index] for name, index in landmarks.items()}
    eye = (at["exocanthion_right"] + at["exocanthion_left"]) / 2
    jaw = (at["gonion_right"] + at["gonion_left"]) / 2
    chin = at["gnathion"]
    x, y, z = mean.T
    along = np.clip((chin[2] - z) / (chin[2] - jaw[2]), 0, 1.5)
    jaw_line = chin[1] + along * (jaw[1] - chin[1]) - 7.0
    half_width = max(abs(at["tragion_left"][0]), abs(at["tragion_right"][0]))
    return (y < eye[1] + 46.0) & (y > jaw_line) & (z > eye[2] - 60.0) & (np.abs(x) < half_width + 6.0)
