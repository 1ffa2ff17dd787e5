"""Writes the report of a silhouette refinement: one self-contained HTML page, and the same content as JSON."""

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.report import STYLE, table, write_list
from calibration.silhouette_refinement.refine import Refinement, robust_rms
from rig.formats.cameras.cameras_json import document_from_rig
from rig.geometry import vector_from_rotation
from rig.messages.message import Message, documents_of, texts_of
from rig.rig import Rig

BINS, HISTOGRAM_WIDTH, HISTOGRAM_HEIGHT = 24, 420.0, 160.0


@dataclass(frozen=True, slots=True, eq=False)
class RefinementRun:
    """Holds a refinement with the rig before it, the names of its captures, and warnings."""

    refinement: Refinement
    start: Rig
    captures: tuple[str, ...]
    warnings: tuple[Message, ...] = ()

    def document(self) -> dict[str, Any]:
        """Returns the document that ``refine --json`` prints. Residuals in the document are robust RMS values (px)."""
        refinement = self.refinement
        return {
            "kept": refinement.kept,
            "reason": refinement.reason.text,
            "reason_message": refinement.reason.document(),
            "captures": list(self.captures),
            "held_out": {
                "before_px": refinement.before_px,
                "after_px": refinement.after_px,
                "noise_px": refinement.noise_px,
                "equations": len(refinement.after.px),
            },
            "cameras": {name: _camera(self, name) for name in self.start.names},
            "warnings": texts_of(self.warnings),
            "warning_messages": documents_of(self.warnings),
            "rig": document_from_rig(refinement.rig),
        }


def refinement_page(run: RefinementRun) -> str:
    """Returns the report as an HTML page."""
    refinement = run.refinement
    verdict = "kept" if refinement.kept else "rejected: the calibration stays as it was"
    kind = "good" if refinement.kept else "bad"
    cameras = run.document()["cameras"]
    head = (
        "camera", "held-out RMS before px", "after px", "equations", "change at the subject px", "turn mrad",
        "shift mm", "focal length",
    )  # fmt: skip
    rows = [
        (
            escape(name),
            f"{row['before_px']:.3f}",
            f"{row['after_px']:.3f}",
            str(row["equations"]),
            f"{row['change_px']:.3f}",
            f"{row['turn_mrad']:.3f}",
            f"{row['shift_mm']:.3f}",
            f"{100 * row['focal_change']:+.3f} %",
        )
        for name, row in cameras.items()
    ]
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><title>Silhouette refinement</title>",
        f"<style>{STYLE}</style><h1>Silhouette refinement</h1>",
        f"<p>The change is <b class='{kind}'>{verdict}</b>: {escape(refinement.reason.text)}.</p>",
        f"<p>Captures: {escape(', '.join(run.captures))}. Each was judged with the cameras where the others alone put "
        "them.</p>",
        write_list("Warnings", run.warnings),
        "<h2>Cameras</h2>",
        "<p>Residuals are tangencies of the silhouettes of captures held out, robust RMS; the change is the proposed "
        "one, whether or not it is kept. A turn and a shift that make up for each other at the subject may both be "
        "large where the change at the subject is small.</p>",
        table(head, rows),
        "<h2>Held-out residuals</h2>",
        f"<p>Before: outline. After: filled. Noise {refinement.noise_px:.2f} px.</p>",
        _histogram(refinement.before.px, refinement.after.px),
        "</html>",
    ]
    return "\n".join(parts)


def _camera(run: RefinementRun, name: str) -> dict[str, float]:
    """Returns a camera's tangency residuals before and after the refinement (px), and the change of its pose."""
    refinement, start, end = run.refinement, run.start[name], run.refinement.proposed[name]
    motion = end.camera_from_world @ start.camera_from_world.inverse()
    after = refinement.after.of(name)
    return {
        "before_px": robust_rms(refinement.before.of(name), refinement.noise_px) if len(after) else 0.0,
        "after_px": robust_rms(after, refinement.noise_px) if len(after) else 0.0,
        "equations": len(after),
        "change_px": refinement.change_px[name],
        "turn_mrad": 1000.0 * float(np.linalg.norm(vector_from_rotation(motion.rotation))),
        "shift_mm": float(np.linalg.norm(end.centre_world - start.centre_world)),
        "focal_change": end.intrinsics.fx / start.intrinsics.fx - 1.0,
    }


def _histogram(before: Float[np.ndarray, " n"], after: Float[np.ndarray, " m"]) -> str:
    most = max(0.5, float(np.quantile(np.abs(np.concatenate([before, after])), 0.98)))
    edges = np.linspace(-most, most, BINS + 1)
    counts = [np.histogram(np.clip(px, -most, most), edges)[0] for px in (before, after)]
    top = max(1, *(int(count.max()) for count in counts))
    step = HISTOGRAM_WIDTH / BINS
    bars = []
    for count, style in zip(counts, ("fill='none' stroke='#b3261e'", "fill='#1f4e8c' fill-opacity='0.6'"), strict=True):
        for i, number in enumerate(count.tolist()):
            height = (HISTOGRAM_HEIGHT - 20.0) * number / top
            bars.append(
                f"<rect x='{i * step:.1f}' y='{HISTOGRAM_HEIGHT - 20.0 - height:.1f}' width='{step - 1:.1f}' "
                f"height='{height:.1f}' {style}/>"
            )
    for at, text in ((0.0, f"{-most:.2f} px"), (0.5, "0"), (1.0, f"{most:.2f} px")):
        anchor = {0.0: "start", 0.5: "middle", 1.0: "end"}[at]
        bars.append(
            f"<text x='{at * HISTOGRAM_WIDTH:.0f}' y='{HISTOGRAM_HEIGHT - 4:.0f}' font-size='12' "
            f"text-anchor='{anchor}'>{text}</text>"
        )
    size = f"width='{HISTOGRAM_WIDTH:.0f}' height='{HISTOGRAM_HEIGHT:.0f}'"
    return f"<svg {size} viewBox='0 0 {HISTOGRAM_WIDTH:.0f} {HISTOGRAM_HEIGHT:.0f}' role='img'>{''.join(bars)}</svg>"
