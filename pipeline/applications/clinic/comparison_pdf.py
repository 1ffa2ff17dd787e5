"""The PDF of a comparison: one A4 page of tables, one of pictures."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from pipeline.applications.verification.pictures import legend
from pipeline.results.overlays import Resized
from pipeline.results.pdf_page import BAD, FAINT, LINE_MM, MARGIN_MM, PdfPage

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


def comparison_pdf(document: Mapping[str, Any], rows: Sequence[tuple[str, Sequence[Resized]]]) -> bytes:
    """Returns the PDF. The same document and pictures give the same bytes.

    Args:
        document: what compare.json says.
        rows: of pictures, with their titles.
    """
    pdf = PdfPage()
    pdf.set_creation_date(datetime.fromisoformat(document["date"]).replace(tzinfo=UTC))
    pdf.set_title("eigenhead: comparison of two visits")
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
