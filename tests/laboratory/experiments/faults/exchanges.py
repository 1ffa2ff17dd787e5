"""Measures how often exchanged pictures are detected and repaired, and how often good ones are called exchanged.

``exchanges`` simulates captures of random heads, every other one without hair, the rest with hair, strands and a shirt,
with cameras off by what a calibration leaves. In each, the files of two cameras are exchanged, those of three are
rotated, or one camera's files are copied over another's. They go through ``assign_images`` as in a job, with given
masks. An exchange counts as repaired if the fit ends within ``WORST_RATIO`` of the error of the same capture
unexchanged; if every silhouette is the same again, so is the fit. A picture that was copied over is lost for good. So
it is also recorded whether the capture ended like the unexchanged one without that view (``lost_view_only``).
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from pipeline.head_model.model import HeadModel, with_modes
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview import tangency
from pipeline.segmentation.segment import segment
from pipeline.settings import FittingSettings
from pipeline.view_checks import camera_assignment, image_assignment, rig_agreement
from pipeline.view_checks.image_assignment import ExchangedPictures, ImageAssignment, assign_images
from rig.capture import Capture, reassign_images
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.subject import random_look
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.subjects import (
    Planted,
    binary_silhouettes,
    fit_contour,
    mean_error_mm,
    off_by,
    random_subjects,
    worn_silhouettes,
)

CALIBRATION_PX = 0.11  # prior of ``off_by``: a head moves by 0.2 px (2D RMS) in each image
WORST_RATIO = 1.1  # of the fit's error after an exchange to that without
KINDS = ("pair", "triple", "duplicate")
ASKED = (camera_assignment, rig_agreement, image_assignment, tangency)


def exchanges(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 12) -> Outcome:
    """Simulates captures whose pictures are filed under the wrong cameras. Returns the shares of these exchanges that
    are detected and repaired, by kind of exchange."""
    records = bench.records("exchanges", key_of(model.sha256, *ASKED, *CONTOUR))
    span, rows, seed = with_modes(model, 60), [], 18
    for i, subject in enumerate(random_subjects(subjects, seed=seed)):
        bench.report(subject.name, i / subjects)
        rng = np.random.default_rng([seed, i])
        compute = partial(_exchanged_row, span, subject, renderer, rng, worn=bool(i % 2))
        rows.append(records.row(subject.name, compute))
    found: dict[str, float] = {"captures": len(rows)}
    for kind in KINDS:
        for quantity in ("named", "repaired"):
            found[f"{kind}_{quantity}_share"] = float(np.mean([row[kind][quantity] for row in rows]))
        found[f"{kind}_worst_ratio"] = max(row[kind]["ratio"] for row in rows)
    found["duplicate_lost_view_only_share"] = float(np.mean([row["duplicate"]["lost_view_only"] for row in rows]))
    found["good_called_exchanged"] = sum(bool(row["good_codes"]) for row in rows)
    return {"figures": found, "rows": rows}


def _exchanged_row(
    model: HeadModel, subject: Planted, renderer: Renderer, rng: np.random.Generator, *, worn: bool
) -> Row:
    true_rig = default_layout()
    capture = _filed(_seen(model, subject, true_rig, renderer, rng, worn=worn))
    rig = off_by(true_rig, CALIBRATION_PX, rng)
    good = _assigned(capture, rig)
    base_mm = _error_mm(model, subject, good.silhouettes, rig)
    row: Row = {"worn": worn, "good_codes": [warning.code for warning in good.warnings], "error_mm": base_mm}
    for kind in KINDS:
        filed = _planted(kind, rig, rng)
        plates_follow = reassign_images(capture, pictures=filed, plates=filed)
        try:
            found = _assigned(plates_follow, rig)
        except ExchangedPictures as refusal:
            named = all(name in str(refusal) for name in filed)
            row[kind] = {"filed": filed, "named": named, "repaired": False, "ratio": 0.0, "told": [str(refusal)]}
            row[kind]["lost_view_only"] = False
            continue
        same = all(_same(good.silhouettes[name], found.silhouettes[name]) for name in rig.names)
        ratio = 1.0 if same else _error_mm(model, subject, found.silhouettes, rig) / base_mm
        warnings = [warning.text for warning in found.warnings]
        named = _is_named(kind, filed, found)
        row[kind] = {"filed": filed, "named": named, "repaired": ratio <= WORST_RATIO, "ratio": ratio, "told": warnings}
        row[kind]["lost_view_only"] = _only_lost(good.silhouettes, found.silhouettes, filed)
    return row


def _seen(
    model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer, rng: np.random.Generator, *, worn: bool
) -> dict[str, Silhouette]:
    style, seen = random_look(rng).hair, (model, subject, rig, renderer)
    return binary_silhouettes(*seen) if not worn or style is None else worn_silhouettes(*seen, style, rng)


def _filed(silhouettes: Mapping[str, Silhouette]) -> Capture:
    """Ready masks, and as pictures the masks themselves: all that is asked of them is which are the same."""
    masks = {name: silhouette.mask for name, silhouette in silhouettes.items()}
    pictures = {name: np.repeat(mask[:, :, None], 3, axis=2).astype(np.uint8) * 255 for name, mask in masks.items()}
    return Capture(pictures, {}, masks)


def _assigned(capture: Capture, rig: Rig) -> ImageAssignment:
    def segmented(shot: Capture) -> dict[str, Silhouette]:
        return segment(shot, rig, report=lambda stage, fraction: None)

    return assign_images(capture, rig, segmented, exchanged="repair")


def _planted(kind: str, rig: Rig, rng: np.random.Generator) -> dict[str, str]:
    """For each camera whose file is another's, that other."""
    one, two, three = rng.choice(rig.names, 3, replace=False).tolist()
    return {"pair": {one: two, two: one}, "triple": {one: two, two: three, three: one}, "duplicate": {one: two}}[kind]


def _is_named(kind: str, filed: Mapping[str, str], found: ImageAssignment) -> bool:
    """Whether the cameras of an exchange are named, and no others; of a duplicate, the one that lost its picture."""
    if kind == "duplicate":
        (lost,) = filed
        texts = [warning.text for warning in found.warnings if warning.code == "picture-duplicated"]
        return len(texts) == 1 and texts[0].startswith(f"{lost} ")
    return dict(found.pictures) == {picture: holder for holder, picture in filed.items()}


def _only_lost(good: Mapping[str, Silhouette], found: Mapping[str, Silhouette], filed: Mapping[str, str]) -> bool:
    """Whether the camera whose picture is gone takes no part, and all others have their own silhouettes."""
    return all(not found[name].quality.usable if name in filed else _same(good[name], found[name]) for name in good)


def _same(one: Silhouette, two: Silhouette) -> bool:
    return one.quality.usable == two.quality.usable and np.array_equal(one.mask, two.mask)


def _error_mm(model: HeadModel, subject: Planted, silhouettes: Mapping[str, Silhouette], rig: Rig) -> float:
    return mean_error_mm(model, fit_contour(model, subject.start, silhouettes, rig, FittingSettings()), subject)
