"""The folder of a verification: report.json, certificate.pdf, and the certificate's pictures in one."""

import json
from pathlib import Path

import numpy as np

from pipeline.applications.verification.certificate import certificate_pdf
from pipeline.applications.verification.judgement import Judgement
from pipeline.applications.verification.measured import Measured
from pipeline.applications.verification.pictures import draw
from pipeline.applications.verification.reference import Reference
from pipeline.applications.verification.report import Occasion, VerificationReport, report_document
from rig.atomic_write import write_atomically
from rig.formats.pictures.images import write_image


def write_verification(
    folder: Path, first: Measured, reference: Reference, judgement: Judgement, occasion: Occasion
) -> VerificationReport:
    """Writes the files of a verification, report.json last, and returns the report. ``first`` is the head of the first
    capture."""
    document, pictures = report_document(judgement, reference, occasion), draw(first, reference, judgement)
    rows = [np.hstack(row) for row in (pictures.reference, pictures.result, pictures.error)]
    write_image(folder / "error.png", np.vstack(rows))
    write_atomically(folder / "certificate.pdf", certificate_pdf(document, judgement, pictures))
    write_atomically(folder / "report.json", json.dumps(document, indent=1, allow_nan=False).encode())
    return document
