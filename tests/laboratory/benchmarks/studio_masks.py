"""Masks of the simulated studio's preset against the truth: contour RMS, IoU, and whether bad views say so.

python -m tests.laboratory studio_masks --captures 20
python -m tests.laboratory studio_masks --captures 10 --bare
python -m tests.laboratory studio_masks --captures 4 --fault shadow --fault camouflage --fault exposure=0.1

``--bare`` strips the captures of their clean plates.

With faults every capture is taken anew with each of them, and a view may be wrong if it says so. Last come the captures
of another program (``RENDERED``), whose masks are known.

Coverage of the subject is the truth: the contour is judged where it is one half at the resolution that a mask has, the
overlap at the lens's own (see tests/pipeline/segmentation/test_segment_studio.py).
"""

import itertools
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from pipeline.segmentation.segment import segment
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from rig.progress import Progress, discard_progress
from rig.render.renderer import Renderer
from rig.studio.sensor.faults import fault_from_text
from rig.studio.sensor.preset import PRESET
from tests.pipeline.segmentation.test_segment import true_mask
from tests.pipeline.segmentation.test_segment_studio import RESOLUTION_PX, coverage, iou, photograph, rms, segmented
from tests.support.shared_data import shared

WORST_PX, LEAST_IOU = 0.8, 0.995
RENDERED = ("scan-a", "draw-b")


def run(
    renderer: Renderer,
    report: Progress,
    *,
    captures: int = 20,
    bare: Annotated[bool, "without clean plates"] = False,
    first: Annotated[int, "seed of the first capture"] = 0,
    fault: Annotated[Sequence[str], "KIND[:CAMERA][=AMOUNT]; may be repeated"] = (),
) -> dict[str, Any]:
    """Returns the figures of this module, and lines about views beyond the limits."""
    faults = [(fault_from_text(text),) for text in fault] or [()]
    rows = []
    for seed, planted in itertools.product(range(first, first + captures), faults):
        report(f"capture {seed}", (seed - first) / captures)
        taken = photograph(seed, renderer, *planted)
        silhouettes = segmented(taken)
        if bare:
            shot = Capture(taken.capture.images)
            silhouettes = segment(shot, taken.rig, report=discard_progress)
        kind = "".join(f" {each.kind}" for each in planted)
        for name, silhouette in silhouettes.items():
            off = rms(silhouette, coverage(taken, name, RESOLUTION_PX))
            overlap = iou(silhouette, coverage(taken, name, PRESET.defocus_px) >= 0.5)
            said = "; ".join(map(str, (*silhouette.quality.warnings, *silhouette.quality.doubts)))
            rows.append((off, overlap, f"{seed}{kind} {name}", said))
    off, overlap = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    bad = (off > WORST_PX) | (overlap < LEAST_IOU)
    lines = [
        f"{len(rows)} views of {captures * len(faults)} captures",
        f"contour RMS px: median {np.median(off):.3f}, 90 % {np.quantile(off, 0.9):.3f}, worst {off.max():.2f}",
        f"IoU: median {np.median(overlap):.4f}, worst {overlap.min():.4f}; {(overlap >= 0.99).mean():.1%} reach 0.99",
    ]
    wrong = sorted((row for row, beyond in zip(rows, bad, strict=True) if beyond), reverse=True)
    silent = sum(not said for _, _, _, said in wrong)
    lines.append(f"views beyond {WORST_PX} px or below {LEAST_IOU}: {len(wrong)}, of which silent: {silent}")
    alarmed = [row for row, beyond in zip(rows, bad, strict=True) if row[3] and not beyond]
    lines.append(f"views within both that say something: {len(alarmed)}")
    lines += [f"  {name}: {off:.2f} px, IoU {share:.4f}, {said}" for off, share, name, said in alarmed]
    lines.append("beyond:")
    lines += [f"  {name}: {off:.2f} px, IoU {share:.4f}, {said or 'nothing said'}" for off, share, name, said in wrong]
    lines += [f"{folder}: {rendered(folder, bare=bare)}" for folder in RENDERED]
    figures = {
        "views": len(rows), "contour_px_median": float(np.median(off)), "contour_px_worst": float(off.max()),
        "iou_median": float(np.median(overlap)), "iou_worst": float(overlap.min()),
        "beyond": len(wrong), "beyond_silent": silent, "within_alarmed": len(alarmed),
    }  # fmt: skip
    return {"figures": figures, "lines": lines}


def rendered(folder: str, *, bare: bool) -> str:
    """Overlap with the true masks of a capture that another program rendered."""
    capture, rig = read_capture(shared(f"data/captures/{folder}"))
    shot = Capture(capture.images) if bare else capture
    silhouettes = segment(shot, rig, report=lambda *_: None)
    overlap = [iou(silhouette, true_mask(name, folder)) for name, silhouette in silhouettes.items()]
    return f"IoU: median {np.median(overlap):.4f}, worst {min(overlap):.4f} of {len(overlap)} views"
