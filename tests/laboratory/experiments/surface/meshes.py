"""Counts turned, folded and crossing triangles of heads, before and after ``pipeline.fusion.untangling``.

Heads are random: all modes of a fit (eigenheads and kernel, within 2.5 standard deviations) with five expressions at
random weights, ``fitted``; and ``displaced``, the same under a random displacement along their normals, twice what the
fine stage takes for likely. Counts are absolute: what the model's own mean head has is not excepted. Folders of results
have only an after.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float
from scipy.sparse.linalg import SuperLU, splu

from pipeline.detail.smooth_field import SmoothField, smooth_field
from pipeline.detail.solve import solving_nodes
from pipeline.fusion import crossing_kernels, crossings, untangling
from pipeline.fusion.untangling import MeshFaults, Topology, clean_mean_head, head_topology, mesh_faults, topology_of
from pipeline.head_model.gaussian_process import model_basis
from pipeline.head_model.model import HeadModel
from pipeline.settings import Settings
from rig.errors import InputError
from rig.formats.meshes.ply import read_head_ply
from rig.mesh import vertex_normals
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of

SUBJECTS = 20  # heads of each model
MAX_COEFFICIENT, EXPRESSIONS = 2.5, 5
DISPLACED_MM, LENGTH_MM = 1.5, 5.0  # standard deviation, and over which length it fades: the fine stage's own
COUNTS = ("turned", "folded", "crossing")


def meshes(
    models: Mapping[str, HeadModel], folders: Sequence[Path] = (), *, bench: Bench, subjects: int = SUBJECTS
) -> Outcome:
    """Runs this module's experiment. Returns the counts for random heads of the models, and for the head.ply of each
    folder. Raises InputError if a folder has none."""
    missing = [str(path) for path in folders if not (path / "head.ply").is_file()]
    if missing:
        raise InputError(", ".join(missing), ["has no head.ply: name folders of results"])
    digests = [model.sha256 for model in models.values()]
    records = bench.records("meshes", key_of(*digests, Settings(), untangling, crossings, crossing_kernels))
    rows: list[Row] = []
    for i, (name, model) in enumerate(models.items()):
        drawn = RandomHeads(model_basis(model, Settings()))
        for k in range(subjects):
            bench.report(f"{name} {k + 1}", (i + k / subjects) / len(models))
            for kind in ("fitted", "displaced"):
                key = f"{name} {kind} {k}"
                rows.append({"heads": f"{name}, {kind}"} | records.row(key, lambda d=drawn, k=k, t=kind: d.row(k, t)))
    rows += [{"heads": path.name} | _result_row(path / "head.ply") for path in folders]
    groups = {
        name: [row for row in rows if row["heads"] == name] for name in dict.fromkeys(row["heads"] for row in rows)
    }
    figures = {f"{name}_{key}": value for name, group in groups.items() for key, value in _figures(group).items()}
    return {"figures": figures, "rows": rows, "markdown": _table(groups)}


class RandomHeads:
    """Draws heads of a model, and measures what ``untangle`` makes of each."""

    def __init__(self, model: HeadModel) -> None:
        self._model, self._topology, self._rest = model, head_topology(model), clean_mean_head(model)
        self._field: tuple[SmoothField, SuperLU] | None = None

    def row(self, seed: int, kind: str) -> Row:
        """Returns the counts before and after, how far vertices move, and the seconds of the processor."""
        rng = np.random.default_rng(seed)
        vertices = self._fitted(rng)
        if kind == "displaced":
            vertices += self._displacement(rng)[:, None] * vertex_normals(vertices, self._topology.faces)
        began = time.process_time()
        clean = untangling.untangle(vertices, self._topology, self._rest)
        cpu_s = time.process_time() - began
        moved_mm = np.linalg.norm(clean - vertices, axis=1)
        return {
            **_counts(vertices, self._topology, "before"),
            **_counts(clean, self._topology, "after"),
            "moved_share": float((moved_mm > 0.0).mean()),
            "moved_mean_mm": float(moved_mm.sum() / max(1, np.count_nonzero(moved_mm))),
            "moved_max_mm": float(moved_mm.max()),
            "cpu_s": cpu_s,
        }

    def _fitted(self, rng: np.random.Generator) -> Float[np.ndarray, "v 3"]:
        model = self._model
        coefficients = np.clip(rng.standard_normal(len(model.modes)), -MAX_COEFFICIENT, MAX_COEFFICIENT)
        coefficients[model.posed] = 0.0
        posed = rng.permutation(model.posed)[:EXPRESSIONS]
        coefficients[posed] = rng.uniform(0.0, 1.0, len(posed))
        return model.vertices(coefficients)

    def _displacement(self, rng: np.random.Generator) -> Float[np.ndarray, " v"]:
        fine = solving_nodes(self._model).fine
        if self._field is None:
            field = smooth_field(fine.shape @ self._rest, fine.faces, LENGTH_MM)
            self._field = field, splu(sparse.csc_array(field.operator), permc_spec="MMD_AT_PLUS_A")
        field, factor = self._field
        white = np.sqrt(field.mass / field.precision_scale) * rng.standard_normal(len(field.mass))
        return DISPLACED_MM * (fine.operator @ factor.solve(white))


def _counts(vertices: Float[np.ndarray, "v 3"], topology: Topology, when: str) -> dict[str, int]:
    faults: MeshFaults = mesh_faults(vertices.astype(np.float32).astype(float), topology)
    return {f"{name}_{when}": getattr(faults, name) for name in COUNTS}


def _result_row(path: Path) -> Row:
    mesh, _ = read_head_ply(path)
    return dict(_counts(mesh.vertices, topology_of(mesh.faces, len(mesh.vertices)), "after"))


def _figures(group: list[Row]) -> dict[str, float]:
    """Returns the means over a group's rows; of what is left afterwards, and of the farthest move, the largest."""
    names = [name for name in group[0] if name != "heads"]
    largest = {f"{name}_after" for name in COUNTS} | {"moved_max_mm"}
    return {
        name: float((np.max if name in largest else np.mean)([row[name] for row in group])) for name in names
    }  # fmt: skip


def _table(groups: Mapping[str, list[Row]]) -> str:
    columns = (*(f"{name}_before" for name in COUNTS), *(f"{name}_after" for name in COUNTS))
    moved = ("moved_share", "moved_mean_mm", "moved_max_mm", "cpu_s")
    header = (
        *("heads", "number", "turned before, mean", "folded", "crossing", "turned after, most", "folded", "crossing"),
        *("share moved", "mean move, mm", "farthest", "CPU s"),
    )
    found = {name: _figures(group) for name, group in groups.items()}
    table = [
        [name, len(groups[name]), *(figures.get(column) for column in (*columns, *moved))]
        for name, figures in found.items()
    ]
    return markdown.table(header, table)
