"""Measures how much of the visible hair the head's own vertices can show, pushed out to it (head_hair.ply).

``covered`` is the share of bust.ply's hair within 2 mm of the shell, ``bare`` of the head without it, ``carried`` of
ICT-FaceKit's mesh as a template that the shell carries. ``truth`` and ``bust_truth`` are the shares of the true visible
hair within 2 mm of the shell and of bust.ply: no shell can have more of it than the bust.
``sunk_mm`` is how deep its deepest vertex lies inside the skin.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pipeline.applications.templates.registration import register
from pipeline.detail.hair_shell import covered_share
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import reconstruct
from pipeline.results.clay import clay
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.errors import EigenheadError
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.progress import discard_progress
from rig.render.renderer import Renderer
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.paper.detail import read_known
from tests.laboratory.experiments.pictures import labelled
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.laboratory.experiments.surface.templates import foreign
from tests.laboratory.experiments.surface.visible_surface import score_visible

SETTINGS = Settings(outputs=OutputSettings(surface="hair"))
AZIMUTHS_DEG = (0.0, 60.0)


def hair_shells(
    model: HeadModel, facekit: HeadModel, captures: Mapping[str, Path], *, renderer: Renderer, bench: Bench
) -> Outcome:
    """Runs this module's experiment on captures with a truth beside them. Returns ``<capture>_covered`` and so on."""
    records = bench.records("hair-shell", key_of(model.sha256, facekit.sha256, SETTINGS))
    pictures: dict[str, np.ndarray] = {}
    rows: list[Row] = []

    def one(name: str, path: Path) -> Row:
        row, pictures[name] = hair_row(path, model, facekit, renderer)
        return row

    for number, (name, path) in enumerate(captures.items()):
        bench.report(name, number / len(captures))
        rows.append({"capture": name} | records.row(name, lambda n=name, p=path: one(n, p)))
    figures = {f"{row['capture']}_{name}": value for row in rows for name, value in row.items() if name != "capture"}
    names = ("covered", "bare", "carried", "truth", "bust_truth", "highest_mm", "sunk_mm")
    table = markdown.table(("capture", *names), [[row["capture"], *(row[name] for name in names)] for row in rows])
    return {"figures": figures, "rows": rows, "markdown": table, "pictures": pictures}


def hair_row(path: Path, model: HeadModel, facekit: HeadModel, renderer: Renderer) -> tuple[Row, np.ndarray]:
    """Runs the job on one capture. Returns its figures, and a picture of bust and shell in clay."""
    known = read_known(path)
    found = reconstruct(ReconstructionContext(known.capture, known.rig, model, SETTINGS, renderer))
    if found.bust is None or found.hair is None:
        raise EigenheadError(f"{known.name}: no bust ({'; '.join(str(warning) for warning in found.warnings)})")
    head, bust, part = found.mesh_world, found.bust.mesh_world, found.bust.surface.part
    shell = Mesh(found.hair.shell.vertices_world, head.faces)
    mesh, _ = foreign(facekit, facekit.vertices(np.zeros(0)), 0)
    binding = register(mesh, model, name="facekit", report=discard_progress).surface_binding
    carried = Mesh(binding.on(shell.vertices, head.faces), mesh.triangles())
    hits = SurfaceIndex(head.vertices, head.faces).closest(shell.vertices)
    row: Row = {
        "covered": found.hair.shell.covered,
        "bare": covered_share(head, bust, part),
        "carried": covered_share(carried, bust, part),
        "truth": score_visible(known.visible, shell).recall["hair"]["within_2mm"],
        "bust_truth": score_visible(known.visible, bust).recall["hair"]["within_2mm"],
        "highest_mm": float(found.hair.shell.height_mm.max()),
        "sunk_mm": float(np.maximum(-np.einsum("nx,nx->n", shell.vertices - hits.points, hits.normals), 0.0).max()),
    }
    in_head = found.head.fit.world_from_head.inverse()
    return row, _picture({"bust.ply": bust, "head_hair.ply": shell, "carried": carried, "head.ply": head}, in_head)


def _picture(meshes: Mapping[str, Mesh], head_from_world: Similarity) -> np.ndarray:
    placed = {name: Mesh(head_from_world.apply(mesh.vertices), mesh.faces) for name, mesh in meshes.items()}
    head = placed["head.ply"].vertices
    box = (head.min(axis=0) - 25.0, head.max(axis=0) + 25.0)
    rows = [
        np.hstack([labelled(clay(mesh, azimuth_deg=turn, box=box), name) for name, mesh in placed.items()])
        for turn in AZIMUTHS_DEG
    ]
    return np.vstack(rows)
