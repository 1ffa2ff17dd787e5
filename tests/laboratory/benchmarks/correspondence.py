"""Correspondence against the truth over the face region, from simulated scans with 1 mm point spacing (section 3.2).

python -m tests.laboratory correspondence --subjects 8

Heads of the default database are scanned (noise 0.1 mm, landmarks marked to 0.5 mm a axis, holes in hair and ears) and
put into correspondence. A reference vertex lies somewhere on its own true head; the same place of the mesh on another
true head is where it must be there.

Three rows, because the refinement's prior is a head model and the scanned heads come from one: ``paper`` uses no
prior; ``held_out`` a prior built from all other subjects of the database; ``in_span`` the shipped model, which has
seen these very subjects, and so flatters.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.applications.model_building.correspondence.correspondence import Correspondence, Matching, correspond
from pipeline.applications.model_building.correspondence.synthetic_scanner import Scanner, scan_head
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel, assemble
from pipeline.head_model.model_file import read_parts
from pipeline.head_model.model_names import model_path
from pipeline.head_model.pca import principal_components


def without(subjects: list[int]) -> HeadModel:
    """The default model rebuilt from all of its subjects but the given ones."""
    parts, _ = read_parts(model_path("default"))
    others = [k for k in range(len(parts.scores)) if k not in subjects]
    heads = parts.mean + np.tensordot(parts.scores[others], parts.modes, 1)
    c = principal_components(heads.astype(float))
    return assemble(replace(parts, mean=c.mean, modes=c.modes, sigma=c.sigma, scores=c.scores), "held out")


def errors(found: Correspondence, truths: list[np.ndarray], model: HeadModel) -> np.ndarray:
    """Vertex errors (mm) over the face region, of every scan but the reference; void vertices left out."""
    faces, region = model.levels["full"].faces, model.levels["cage"].face_region
    ours = [frame.inverse().apply(head) for head, frame in zip(found.heads, found.frame_from_scan, strict=True)]
    place = SurfaceIndex(truths[found.reference], faces).closest(ours[found.reference])
    out = []
    for k, truth in enumerate(truths):
        if k == found.reference:
            continue
        wanted = np.einsum("nc,ncx->nx", place.weights, truth[faces[place.triangles]])
        use = region & ~found.void[k] & ~found.void[found.reference]
        out.append(np.linalg.norm(ours[k] - wanted, axis=1)[use])
    return np.concatenate(out)


def run(model: HeadModel, *, subjects: int = 8, seed: int = 5) -> dict[str, Any]:
    """Median, 95th percentile and mean of each row, mm."""
    chosen = np.random.default_rng(seed).permutation(138)[:subjects].tolist()
    truths = [model.vertices(model.scores[k].astype(float)) for k in chosen]
    scanner = Scanner(
        turn_rad=0, shift_mm=0
    )  # the rigid part is exact either way; this keeps truth and scan in one frame
    scans = [
        scan_head(f"subject {k}", v, model.levels["full"].faces, model.landmarks, scanner, np.random.default_rng(k))
        for k, v in zip(chosen, truths, strict=True)
    ]
    rows = {
        "paper": (model, Matching(refine=False)),
        "held_out": (without(chosen), Matching()),
        "in_span": (model, Matching()),
    }
    figures = {}
    for name, (template, matching) in rows.items():
        e = errors(correspond(scans, template, matching), truths, model)
        figures |= {
            f"{name}_median_mm": round(float(np.median(e)), 3),
            f"{name}_p95_mm": round(float(np.quantile(e, 0.95)), 3),
            f"{name}_mean_mm": round(float(e.mean()), 3),
        }
    return {"figures": figures}
