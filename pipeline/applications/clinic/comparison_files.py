"""Writes a comparison: compare.json, tables, the map of differences as PLY and GLB, pictures, and a PDF.

Colours are those of a certificate: red where the later head lies outside, blue where it lies inside, and grey where the
difference is below what both results are sure of.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.applications.clinic.comparison import SURE, Comparison
from pipeline.applications.clinic.comparison_pdf import comparison_pdf
from pipeline.applications.clinic.patient_files import matrix_document, write_json
from pipeline.applications.clinic.visit import Visit
from pipeline.applications.verification.pictures import HEAT_DARKEST, heat_colours, scale_end
from pipeline.results.clay import clay
from pipeline.results.overlays import Resized, contact_sheet
from rig.atomic_write import write_atomically
from rig.formats.meshes.glb import glb_bytes
from rig.formats.meshes.ply import ply_bytes
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh

FORMAT = "eigenhead-comparison/1"
AZIMUTHS_DEG = (-60.0, 0.0, 60.0)
FILES = (
    "compare.json",
    "regions.csv",
    "measurements.csv",
    "difference.ply",
    "difference.glb",
    "difference.npz",
    "difference.png",
    "comparison.pdf",
)


def write_comparison(folder: Path, comparison: Comparison, date: str) -> dict[str, Any]:
    """Writes all ``FILES``, compare.json last, and returns what it says; ``date`` (ISO) is that of the comparison.
    Raises OSError."""
    document = comparison_document(comparison, date)
    end_mm = document["scale_end_mm"]
    colours = heat_colours(comparison.sure_mm, end_mm)
    _write_meshes(folder, comparison, colours)
    rows = pictures(comparison, colours)
    write_image(folder / "difference.png", contact_sheet([[(title, view) for view in row] for title, row in rows]))
    write_atomically(folder / "comparison.pdf", comparison_pdf(document, rows))
    write_table(folder / "regions.csv", {name: asdict(of) for name, of in comparison.regions.items()}, "region")
    write_table(folder / "measurements.csv", document["measurements"], "measurement")
    write_json(folder / "compare.json", document)
    return document


def comparison_document(comparison: Comparison, date: str) -> dict[str, Any]:
    """Returns what compare.json says."""
    fit = comparison.fit
    return {
        "format": FORMAT,
        "version": version("eigenhead"),
        "date": date,
        "earlier": _source(comparison.earlier),
        "later": _source(comparison.later),
        "alignment": {
            "region": "forehead and bridge of the nose",
            "later_from_earlier": matrix_document(fit.motion),
            "std_mm": fit.std_mm,
            "kept_share": fit.kept_share,
        },
        "warnings": [warning.document() for warning in comparison.warnings],
        "sure": SURE,
        "changed_share": comparison.regions["whole"].changed_share,
        "scale_end_mm": scale_end(comparison.sure_mm),
        "regions": {name: asdict(of) for name, of in comparison.regions.items()},
        "measurements": {
            name: {
                "earlier_mm": of.earlier.value_mm,
                "earlier_std_mm": of.earlier.std_mm,
                "later_mm": of.later.value_mm,
                "later_std_mm": of.later.std_mm,
                "change_mm": of.change_mm,
                "std_mm": of.std_mm,
                "sure": of.is_sure,
            }
            for name, of in comparison.lengths.items()
        },
    }


def pictures(comparison: Comparison, colours: UInt8[np.ndarray, "v 3"]) -> list[tuple[str, list[Resized]]]:
    """Draws the earlier head, the later one in its place, and the differences, each from ``AZIMUTHS_DEG``."""
    before, after = comparison.earlier.measured, comparison.later.measured
    head = before.head_from_world.apply(before.mesh_world.vertices)
    back = before.head_from_world @ comparison.fit.motion.inverse()
    box = (head.min(axis=0), head.max(axis=0))
    earlier = Mesh(head, before.mesh_world.faces)
    later = Mesh(back.apply(after.mesh_world.vertices), after.mesh_world.faces)
    return [
        ("earlier", [clay(earlier, azimuth_deg=turn, box=box) for turn in AZIMUTHS_DEG]),
        ("later", [clay(later, azimuth_deg=turn, box=box) for turn in AZIMUTHS_DEG]),
        (
            "later less earlier; grey: not sure",
            [clay(earlier, colours=colours, azimuth_deg=turn, box=box, darkest=HEAT_DARKEST) for turn in AZIMUTHS_DEG],
        ),
    ]


def write_table(path: Path, rows: Mapping[str, Mapping[str, Any]], first: str) -> None:
    """Writes rows by name as CSV; None is an empty cell."""
    text = io.StringIO()
    columns = list(next(iter(rows.values()), {}))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([first, *columns])
    writer.writerows([name, *(_cell(row[column]) for column in columns)] for name, row in rows.items())
    write_atomically(path, text.getvalue().encode())


def _cell(value: object) -> object:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.4f}" if isinstance(value, float) else value


def _source(visit: Visit) -> dict[str, str]:
    return {"name": visit.measured.name, "model": visit.identity.model, "model_sha256": visit.identity.sha256}


def _write_meshes(folder: Path, comparison: Comparison, colours: UInt8[np.ndarray, "v 3"]) -> None:
    before, changed = comparison.earlier.measured, comparison.changed
    mesh, distance = before.mesh_world, np.nan_to_num(comparison.distance_mm)
    comments = ["unit mm", "quality: signed distance to the later head, mm", "views: 1 where the change is sure"]
    data = ply_bytes(
        mesh, normals=mesh.normals(), colours=colours, quality=distance, views=changed.astype(np.uint8),
        comments=comments,
    )  # fmt: skip
    write_atomically(folder / "difference.ply", data)
    head = Mesh(before.head_from_world.apply(mesh.vertices), mesh.faces)
    write_atomically(folder / "difference.glb", glb_bytes(head, normals=head.normals(), colours=colours))
    packed = io.BytesIO()
    np.savez_compressed(
        packed,
        distance_mm=_single(comparison.distance_mm),
        std_mm=_single(comparison.std_mm),
        changed=changed.astype(np.uint8),
    )
    write_atomically(folder / "difference.npz", packed.getvalue())


def _single(values: Float[np.ndarray, " v"]) -> np.ndarray:
    return values.astype(np.float32)
