"""Compares two visits of one person: computes where the head changed by more than the uncertainty of both results, and
writes the comparison files.

The later head is aligned rigidly to the earlier one on the forehead and the bridge of the nose, which neither
expression nor jaw moves. Then each vertex of the earlier head gets its signed distance (mm) to the later head's
surface, positive if the later surface lies outside. A change is significant if it exceeds ``SURE`` standard deviations,
which combine the errors of both surfaces and of the alignment as independent errors.

The files are compare.json, tables, the map of changes as PLY and GLB, pictures, and a PDF.

In the map, red means that the later head lies outside, blue inside, and grey that the change is not significant."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.applications.clinic.patient_files import matrix_document, write_json
from pipeline.applications.clinic.registration import Patch, TrimmedFit, trimmed_fit
from pipeline.applications.clinic.visit import Visit
from pipeline.applications.verification.judgement import weighted_quantiles
from pipeline.applications.verification.reference import Reference
from pipeline.applications.verification.write import HEAT_DARKEST, heat_colours, legend, scale_end
from pipeline.evidence.measurements import Measurement
from pipeline.head_model.landmarks import stacked
from pipeline.results.overlays import Resized, clay, contact_sheet
from pipeline.results.pdf_page import BAD, FAINT, LINE_MM, MARGIN_MM, PdfPage
from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.ply import ply_bytes
from rig.formats.meshes.scene import Part, Scene
from rig.formats.pictures.images import write_image
from rig.geometry import RigidTransform, rigid_fit
from rig.mesh import Mesh
from rig.messages.message import Message, compose

SURE = 2.0  # combined standard deviations
SHARE = 0.8  # of the stable region that must agree: the rest may be hair or a scar
FAR_MM = 25.0  # beyond it there is no match
FACING = 0.3  # least cosine between matched normals
START_NAMES = (
    "glabella",
    "nasion",
    *(
        f"{name}_{side}"
        for name in ("exocanthion", "endocanthion", "frontotemporale", "tragion")
        for side in ("right", "left")
    ),
)
MIN_MARKS = 3
MAX_STABLE_CHANGED = 0.05  # share of the stable region: two deviations leave as much to chance
NOT_THIS_MM = 1.5  # scatter on bone: one person has 0.02 to 0.3 mm, others 0.8 to 2.7; hair may be in the way
PANEL_MM = 50.0  # width of a picture: three rows leave room for the notes
NOTES = (
    "The later head is aligned rigidly to the earlier one on the forehead and the bridge of the nose. Distances are "
    "those of the earlier surface to the later one, positive where the later lies outside. Grey: below {sure:g} "
    "combined standard deviations of both surfaces and the alignment, taken as independent, or without a counterpart.",
    "Volumes are those between the surfaces where the change is sure. Measurements are each result's own; their errors "
    "are taken as independent, though two results of one rig share some, so that small changes may be surer than said.",
    "No medical device: a change is what two reconstructions differ in, whatever the reason (expression, hair, "
    "swelling, posture).",
)

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


@dataclass(frozen=True, slots=True)
class RegionChange:
    """Holds the statistics of the change (mm) in a region, weighted by area. ``changed_share`` is the fraction of the
    area with a significant change; ``volume_ml`` is the volume between both surfaces, positive if the head grew."""

    mean_mm: float
    median_mm: float  # of the distances, as ``p95_mm``
    p95_mm: float
    largest_mm: float  # largest significant change, signed; 0 if there is none
    changed_share: float
    volume_ml: float


@dataclass(frozen=True, slots=True)
class LengthChange:
    """Holds a measurement in both visits, and its change (later minus earlier) with its standard deviation (mm; None if
    a result has no standard deviation)."""

    earlier: Measurement
    later: Measurement
    change_mm: float
    std_mm: float | None

    @property
    def is_sure(self) -> bool:
        """Returns whether the measurement changed by more than ``SURE`` standard deviations."""
        return self.std_mm is not None and abs(self.change_mm) > SURE * self.std_mm


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Holds the differences between two visits. Arrays are indexed by the earlier head's vertices; ``distance_mm`` is
    NaN where the later head lacks a corresponding surface point."""

    earlier: Visit
    later: Visit
    fit: TrimmedFit  # later_from_earlier, of the stable region
    distance_mm: Float[np.ndarray, " v"]
    std_mm: Float[np.ndarray, " v"]
    regions: Mapping[str, RegionChange]
    lengths: Mapping[str, LengthChange]

    @property
    def changed(self) -> Bool[np.ndarray, " v"]:
        """Returns a mask of the vertices where the surface changed significantly."""
        return np.abs(np.nan_to_num(self.distance_mm)) > SURE * self.std_mm

    @property
    def sure_mm(self) -> Float[np.ndarray, " v"]:
        """Returns the distances (mm), with NaN where the change is not significant."""
        return np.where(self.changed, self.distance_mm, np.nan)

    @property
    def warnings(self) -> tuple[Message, ...]:
        """Returns the reasons to doubt the comparison: warnings of both results, and a significant change of the
        forehead and the bridge of the nose."""
        share, doubts = self.regions["stable"].changed_share, (*self.earlier.warnings, *self.later.warnings)
        return (*doubts, compose("maybe-other-person", share=share)) if share > MAX_STABLE_CHANGED else doubts


def compare(earlier: Visit, later: Visit) -> Comparison:
    """Compares two visits of one person. Raises InputError if the later result is not a head of the same person."""
    head, surface = earlier.measured, Reference.of(later.measured.mesh_world, {}, later.measured.name)
    normals = head.mesh_world.normals()
    stable = earlier.stable & (earlier.views > 0)
    patch = Patch(head.mesh_world.vertices[stable], normals[stable], head.areas[stable])
    fit = trimmed_fit(patch, surface.index, _start(earlier, later), share=SHARE, beside=surface.beside)
    if fit is None or fit.std_mm > NOT_THIS_MM:
        off = float("inf") if fit is None else fit.std_mm
        other = compose("not-same-person", earlier=head.name, off_mm=off)
        raise InputError(later.measured.name, [other, *earlier.warnings, *later.warnings])
    there, facing = fit.motion.apply(head.mesh_world.vertices), normals @ fit.motion.rotation.T
    hits = surface.index.closest(there, facing=facing)
    known = (hits.distances < FAR_MM) & ~surface.beside(hits) & (np.einsum("nx,nx->n", facing, hits.normals) > FACING)
    side = np.einsum("nx,nx->n", hits.points - there, facing)
    distance = np.where(known, np.copysign(hits.distances, side), np.nan)
    later_std = np.einsum(
        "nk,nk->n", later.measured.stated_mm[later.measured.mesh_world.faces[hits.triangles]], hits.weights
    )
    std = np.sqrt(head.stated_mm**2 + later_std**2 + fit.std_along(there, facing) ** 2)
    changed = np.abs(np.nan_to_num(distance)) > SURE * std
    regions = _regions(earlier, distance, changed)
    return Comparison(earlier, later, fit, distance, std, regions, length_changes(earlier, later))


def length_changes(earlier: Visit, later: Visit) -> dict[str, LengthChange]:
    """Returns the change of every measurement that both results contain."""
    found = {}
    for name, before in earlier.measurements.items():
        after = later.measurements.get(name)
        if after is None:
            continue
        std = None
        if before.std_mm is not None and after.std_mm is not None:
            std = float(np.hypot(before.std_mm, after.std_mm))
        found[name] = LengthChange(before, after, after.value_mm - before.value_mm, std)
    return found


def _start(earlier: Visit, later: Visit) -> RigidTransform:
    """Returns later_from_earlier, computed from common landmarks or, without any, from the two head frames."""
    marks = earlier.measured.landmarks, later.measured.landmarks
    names = [name for name in START_NAMES if all(name in of for of in marks)]
    if len(names) < MIN_MARKS:
        return later.measured.head_from_world.inverse() @ earlier.measured.head_from_world
    return rigid_fit(stacked(marks[0], names), stacked(marks[1], names))


def _regions(
    earlier: Visit, distance: Float[np.ndarray, " v"], changed: Bool[np.ndarray, " v"]
) -> dict[str, RegionChange]:
    found, known = {}, np.isfinite(distance)
    masks = {"whole": np.ones(len(distance), bool), "stable": earlier.stable, **earlier.measured.regions}
    for name, mask in masks.items():
        rows = mask & known
        if not rows.any():
            continue
        values, areas, sure = distance[rows], earlier.measured.areas[rows], changed[rows]
        largest = values[sure][np.argmax(np.abs(values[sure]))] if sure.any() else 0.0
        median, p95 = weighted_quantiles(np.abs(values), areas, (0.5, 0.95))
        found[name] = RegionChange(
            float(np.average(values, weights=areas)),
            median,
            p95,
            float(largest),
            float(areas[sure].sum() / areas.sum()),
            float((values * areas)[sure].sum() / 1000.0),
        )
    return found


def write_comparison(folder: Path, comparison: Comparison, date: str) -> dict[str, Any]:
    """Writes all ``FILES``, compare.json last, and returns the content of compare.json; ``date`` (ISO) is the date of
    the comparison. Raises OSError."""
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
    """Returns the content of compare.json."""
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
    """Draws the earlier head, the aligned later head, and the changes, each from the directions ``AZIMUTHS_DEG``."""
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
    """Writes a table with named rows as CSV; None becomes an empty cell."""
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
    head = Part("head", Mesh(before.head_from_world.apply(mesh.vertices), mesh.faces, colours))
    write_atomically(folder / "difference.glb", scene_glb_bytes(Scene([head])))
    packed = io.BytesIO()
    np.savez_compressed(
        packed,
        distance_mm=comparison.distance_mm.astype(np.float32),
        std_mm=comparison.std_mm.astype(np.float32),
        changed=changed.astype(np.uint8),
    )
    write_atomically(folder / "difference.npz", packed.getvalue())


def comparison_pdf(document: Mapping[str, Any], rows: Sequence[tuple[str, Sequence[Resized]]]) -> bytes:
    """Returns the comparison as PDF. The same document and pictures give the same bytes of the PDF.

    Args:
        document: the content of compare.json.
        rows: titles, each with a row of pictures.
    """
    pdf = PdfPage("eigenhead: comparison of two visits", document["date"])
    pdf.add_page()
    _tables_page(pdf, document)
    pdf.add_page()
    _pictures_page(pdf, document, rows)
    return bytes(pdf.output())


def _tables_page(pdf: PdfPage, document: Mapping[str, Any]) -> None:
    pdf.line_of("Comparison of two visits", size=16, bold=True)
    earlier, later, fit = document["earlier"], document["later"], document["alignment"]
    pdf.line_of(f"{document['date']}   eigenhead {document['version']}")
    pdf.line_of(f"Earlier {earlier['name']} ({earlier['model']}), later {later['name']} ({later['model']})")
    pdf.line_of(
        f"Aligned on {fit['region']}: scatter {fit['std_mm']:.3f} mm, {fit['kept_share']:.0%} of it used. "
        f"Changed for sure: {document['changed_share']:.1%} of the surface."
    )
    for warning in document["warnings"]:
        pdf.line_of(f"Doubtful: {warning['message']}", ink=BAD)
    pdf.ln(2)
    pdf.line_of("Change by region, mm", size=11, bold=True)
    regions = [
        (
            name, f"{of['mean_mm']:+.2f}", f"{of['median_mm']:.2f}", f"{of['p95_mm']:.2f}", f"{of['largest_mm']:+.2f}",
            f"{of['changed_share']:.1%}", f"{of['volume_ml']:+.2f}",
        )
        for name, of in document["regions"].items()
    ]  # fmt: skip
    header = ("region", "mean", "median", "95 %", "largest", "changed", "volume, ml")
    pdf.table_of(header, regions, (40, 23, 23, 23, 23, 23, 23), {})
    pdf.line_of("Measurements, mm", size=11, bold=True)
    lengths = list(document["measurements"].items())
    table = [
        (
            name.replace("_", " "), f"{of['earlier_mm']:.1f}", f"{of['later_mm']:.1f}", f"{of['change_mm']:+.1f}",
            "-" if of["std_mm"] is None else f"{of['std_mm']:.1f}", "changed" if of["sure"] else "not sure",
        )
        for name, of in lengths
    ]  # fmt: skip
    room = int((pdf.h - MARGIN_MM - pdf.get_y()) / LINE_MM) - 1
    inks = {row: BAD if of["sure"] else FAINT for row, (_, of) in enumerate(lengths)}
    pdf.table_of(("", "earlier", "later", "change", "std", ""), table[:room], (68, 22, 22, 22, 22, 22), inks)


def _pictures_page(pdf: PdfPage, document: Mapping[str, Any], rows: Sequence[tuple[str, Sequence[Resized]]]) -> None:
    pdf.line_of("Both visits, and what changed", size=14, bold=True)
    for title, row in rows:
        pdf.line_of(title, bold=True)
        pdf.pictures_of(row, PANEL_MM)
    pdf.ln(1)
    end = document["scale_end_mm"]
    pdf.scale_of(legend(), (f"-{end:g} mm inside", f"+{end:g} mm outside"))
    for note in NOTES:
        pdf.line_of(note.format(sure=document["sure"]), size=7.5, ink=FAINT)
