"""Writes the folder of a verification: report.json, certificate.pdf, and one file with the certificate's pictures."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.applications.verification.judgement import FORM_SHARE, Check, Judgement
from pipeline.applications.verification.measured import Measured
from pipeline.applications.verification.reference import Reference
from pipeline.applications.verification.report import Occasion, VerificationReport, report_document
from pipeline.results.overlays import Resized, clay
from pipeline.results.pdf_page import BAD, FAINT, GOOD, LINE_MM, MARGIN_MM, WIDTH_MM, PdfPage
from rig.files import write_atomically
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh

AZIMUTHS_DEG = (-50.0, 0.0, 50.0)
PANEL = (420, 460)
HEAT_DARKEST = 0.7  # of a colour, so that shading leaves the scale readable
PAPER = (255, 255, 255)
UNTOLD = (190, 190, 190)  # grey: unknown deviation
# Blue, white, red: ColorBrewer's RdBu (https://colorbrewer2.org), which the colour-blind can read.
RAMP = np.array([[33, 102, 172], [103, 169, 207], [247, 247, 247], [239, 138, 98], [178, 24, 43]], float)
STEPS_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # the ends that a scale may have
SHOWN = 0.95  # share of the face that lies within the ends of the scale
TOLD = 8  # captures that fit on page one
FIGURES = {  # name of the limit: (words, digits, unit)
    "face_rms_mm": ("Deviation of the face, RMS, worst capture", 3, "mm"),
    "features_rms_mm": ("Deviation of eyes, nose and mouth, RMS, the worst of them", 3, "mm"),
    "probing_form_mm": ("Probing error, form: range of the face's deviations", 2, "mm"),
    "size_error_percent": ("Probing error, size: scale against the reference", 3, "%"),
    "distance_mm": ("Distance error of the landmarks, RMS, worst capture", 2, "mm"),
    "repeatability_mm": ("Repeatability: scatter of the face along its normal, RMS", 3, "mm"),
    "least_covered": ("Share of the face that the reference covers (at least)", 3, ""),
}
NOTES = (
    "Each head is laid on the reference by a rigid motion, without scale: least squares of the distances along the "
    "reference's normals over the face, by area. Deviations are signed distances of the head's surface to the "
    "reference, positive outside; places at the rim of the scan or farther than 10 mm are not judged.",
    f"Probing error, form: range of the deviations of {FORM_SHARE:.1%} of the face's area. Size: a best fit with a "
    "free scale, afterwards. Distance error: distances between anthropometric landmarks less those of the reference; "
    "the placing of the landmarks on both is part of it. Scatter: standard deviation of every vertex over the captures "
    "in all three directions, after rigid alignment on each other; by normal: its part across the surface, which is "
    "the repeatability; stated: the deviation across the surface that the results state, shared errors included.",
    "After the kinds of figures of VDI/VDE 2634 part 3, with a mannequin in place of its spheres; this is no test by "
    "an accredited laboratory, and no uncertainty of the reference scan is taken off.",
)


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """Holds three rows of pictures (reference, result, error), seen from ``AZIMUTHS_DEG``. ``end_mm`` is the error (mm)
    at the ends of the colour scale."""

    reference: tuple[Resized, ...]
    result: tuple[Resized, ...]
    error: tuple[Resized, ...]
    end_mm: float


def draw(first: Measured, reference: Reference, judgement: Judgement) -> Pictures:
    """Draws the pictures of reference, result and error. ``first`` is the head of the first capture in ``judgement``.
    The head is coloured with the mean error over all captures."""
    head = first.head_from_world.apply(first.mesh_world.vertices)
    fitted = Mesh(head, first.mesh_world.faces)
    head_from_reference = first.head_from_world @ judgement.captures[0].fit.reference_from_world.inverse()
    scan = Mesh(head_from_reference.apply(reference.mesh.vertices), reference.mesh.faces)
    box = (head.min(axis=0), head.max(axis=0))
    end_mm = scale_end(judgement.repeated_mm[first.regions["face"]])
    heat = heat_colours(judgement.repeated_mm, end_mm)

    def views(mesh: Mesh, **colour: Any) -> tuple[Resized, ...]:
        return tuple(clay(mesh, azimuth_deg=of, panel=PANEL, box=box, paper=PAPER, **colour) for of in AZIMUTHS_DEG)

    return Pictures(views(scan), views(fitted), views(fitted, colours=heat, darkest=HEAT_DARKEST), end_mm)


def scale_end(deviation_mm: Float[np.ndarray, " n"]) -> float:
    """Returns the end of a colour scale (mm): the smallest of ``STEPS_MM`` that exceeds most of the deviations."""
    known = np.abs(deviation_mm[np.isfinite(deviation_mm)])
    wanted = float(np.quantile(known, SHOWN)) if len(known) else 0.0
    return next((step for step in STEPS_MM if step >= wanted), STEPS_MM[-1])


def heat_colours(deviation_mm: Float[np.ndarray, " v"], end_mm: float) -> UInt8[np.ndarray, "v 3"]:
    """Returns a colour for each deviation: blue where the result lies inside the reference, red outside, white where
    they agree, grey where the deviation is unknown. The colours saturate at an error of ``end_mm``."""
    place = np.clip(np.nan_to_num(deviation_mm) / end_mm, -1.0, 1.0)
    stops = np.linspace(-1.0, 1.0, len(RAMP))
    colours = np.stack([np.interp(place, stops, RAMP[:, channel]) for channel in range(3)], axis=1)
    colours[~np.isfinite(deviation_mm)] = UNTOLD
    return np.round(colours).astype(np.uint8)


def legend(width: int = 600, height: int = 24) -> Resized:
    """Draws the colour scale from ``-end_mm`` to ``end_mm``, left to right."""
    bar = heat_colours(np.linspace(-1.0, 1.0, width), 1.0)[None]
    return np.asarray(cv2.resize(bar, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)


def write_verification(
    folder: Path, first: Measured, reference: Reference, judgement: Judgement, occasion: Occasion
) -> VerificationReport:
    """Writes verification files, report.json last, and returns its content. ``first`` is the first capture's head."""
    document, pictures = report_document(judgement, reference, occasion), draw(first, reference, judgement)
    rows = [np.hstack(row) for row in (pictures.reference, pictures.result, pictures.error)]
    write_image(folder / "error.png", np.vstack(rows))
    write_atomically(folder / "certificate.pdf", certificate_pdf(document, judgement, pictures))
    write_atomically(folder / "report.json", json.dumps(document, indent=1, allow_nan=False).encode())
    return document


def certificate_pdf(report: VerificationReport, judgement: Judgement, pictures: Pictures) -> bytes:
    """Returns the certificate as a PDF of two pages. The same report and pictures give the same bytes of the PDF."""
    pdf = PdfPage("eigenhead: verification of a studio", report["date"])
    pdf.add_page()
    _figures_page(pdf, report, judgement)
    pdf.add_page()
    _pictures_page(pdf, pictures)
    return bytes(pdf.output())


def _figures_page(pdf: PdfPage, report: VerificationReport, judgement: Judgement) -> None:
    pdf.line_of("Verification of a studio against a reference scan", size=16, bold=True)
    open_ = sum(check.passed is None for check in judgement.checks)
    verdict = ("PASSED" if judgement.passed else "NOT PASSED") + (f", {open_} figure(s) not judged" if open_ else "")
    pdf.line_of(verdict, size=14, bold=True, ink=GOOD if judgement.passed else BAD)
    scan, model = report["reference"], report["model"]
    pdf.line_of(f"{report['date']}   eigenhead {report['version']}   {len(report['captures'])} capture(s)")
    pdf.line_of(f"Reference {scan['name']}: {scan['triangles']:,} triangles, {len(scan['landmarks'])} landmarks, "
                f"sha256 {scan['sha256'][:16]}")  # fmt: skip
    pdf.line_of(f"Head model {model['name']}, sha256 {model['sha256'][:16]}")
    pdf.ln(2)
    pdf.line_of("Figures and limits", size=11, bold=True)
    rows = [_check_row(check) for check in judgement.checks]
    inks = {i: FAINT if c.passed is None else GOOD if c.passed else BAD for i, c in enumerate(judgement.checks)}
    pdf.table_of(("", "found", "limit", ""), rows, (104, 26, 26, 22), inks)
    _regions_table(pdf, report)
    _captures_table(pdf, report)
    _distances_table(pdf, report)


def _check_row(check: Check) -> tuple[str, str, str, str]:
    words, digits, unit = FIGURES[check.name]
    found = "-" if check.value is None else f"{check.value:.{digits}f} {unit}"
    verdict = {None: "not judged", True: "met", False: "missed"}[check.passed]
    return words, found, f"{check.limit:g} {unit}", verdict


def _regions_table(pdf: PdfPage, report: VerificationReport) -> None:
    pdf.line_of("Error by region, mm: what all captures have in common, and how they scatter", size=11, bold=True)
    rows = []
    for name, of in report["repeated"].items():
        scattered = report["repeatability"].get(name)
        spread = ("rms_mm", "normal_rms_mm", "stated_mm")
        around = ("-" if scattered is None else f"{scattered[key]:.3f}" for key in spread)
        errors = (of["mean_mm"], of["rms_mm"], of["median_mm"], of["p95_mm"])
        rows.append((name, f"{of['covered']:.0%}", *(f"{value:.3f}" for value in errors), *around))
    header = ("region", "covered", "mean", "RMS", "median", "95 %", "scatter", "by normal", "stated")
    pdf.table_of(header, rows, (22, 19.5, 19.5, 19.5, 19.5, 19.5, 19.5, 19.5, 19.5), {})


def _captures_table(pdf: PdfPage, report: VerificationReport) -> None:
    pdf.line_of("Captures, each by its own best fit", size=11, bold=True)
    rows = []
    for name, of in list(report["captures"].items())[:TOLD]:
        fit, face, distance = of["alignment"], of["regions"].get("face"), of["distance_rms_mm"]
        rows.append((
            name[:28], fit["start"], f"{np.degrees(np.linalg.norm(fit['rotation_vector'])):.2f}",
            f"{np.linalg.norm(fit['translation']):.1f}", "-" if face is None else f"{face['rms_mm']:.3f}",
            f"{of['probing_form_mm']:.2f}", f"{of['size_error_percent']:+.3f}",
            "-" if distance is None else f"{distance:.2f}",
        ))  # fmt: skip
    header = ("capture", "fit from", "turn, deg", "shift, mm", "face RMS", "form", "size, %", "distance")
    pdf.table_of(header, rows, (38, 20, 20, 20, 20, 20, 20, 20), {})
    more = len(report["captures"]) - TOLD
    if more > 0:
        pdf.line_of(f"and {more} more in report.json", ink=FAINT)


def _distances_table(pdf: PdfPage, report: VerificationReport) -> None:
    """Draws the table of landmark distances (mean over all captures), with as many rows as fit on the page."""
    captures = list(report["captures"].values())
    names = list(captures[0]["distances"])
    if not names:
        pdf.line_of("The reference has no landmarks: distances are not judged.", ink=FAINT)
        return
    pdf.line_of("Landmark distances, mm, mean of the captures", size=11, bold=True)
    rows = []
    for name in names:
        of = [one["distances"][name] for one in captures]
        measured, true = float(np.mean([d["measured_mm"] for d in of])), of[0]["reference_mm"]
        rows.append((name.replace("_", " "), f"{measured:.2f}", f"{true:.2f}", f"{measured - true:+.2f}"))
    room = int((pdf.h - MARGIN_MM - pdf.get_y()) / LINE_MM) - 1
    pdf.table_of(("", "measured", "reference", "error"), rows[: max(room, 0)], (82, 32, 32, 32), {})


def _pictures_page(pdf: PdfPage, pictures: Pictures) -> None:
    pdf.line_of("Reference, result and error", size=14, bold=True)
    width = WIDTH_MM / len(AZIMUTHS_DEG)
    for title, row in (
        ("Reference scan", pictures.reference),
        ("Result, first capture", pictures.result),
        ("Error that all captures have in common, mm (grey: not judged)", pictures.error),
    ):
        pdf.line_of(title, bold=True)
        pdf.pictures_of(row, width)
    pdf.scale_of(legend(), (f"-{pictures.end_mm:g} inside", f"+{pictures.end_mm:g} outside"))
    for note in NOTES:
        pdf.line_of(note, size=7.5, ink=FAINT)
