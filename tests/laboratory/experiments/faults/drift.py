"""Measures how often a camera that was turned is named, and how often a good one is.

Every capture is another random head of the model's span with hair and a shirt, and another calibration error. One
random camera is turned by ``TURN_DEG`` about an axis across its view. Conditions in which no camera moved:

- nothing wrong;
- every mask dilated by ``LOOSE_PX``, or the mask of one camera alone;
- three views that cut the subject off;
- a close-up with twice the pixels per millimetre, most of whose tangent planes touch the crown, with tight and loose
  masks.

A camera may be named as moved (its view is left out), or as one that moved or has a loose mask (the view is kept).
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipeline.head_model.model import HeadModel, with_modes
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview import tangency
from pipeline.view_checks import camera_drift
from pipeline.view_checks.camera_drift import find_drift
from rig.camera import Camera
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.subject import random_look
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.support.spoilt_captures import LOOSE_PX, close_up, knocked, loosened
from tests.support.subjects import Planted, off_by, random_subjects, worn_silhouettes

TURN_DEG = 0.2
CALIBRATION_PX = 0.11  # prior of ``off_by``: a head moves by 0.2 px (2D RMS) in each image
CUT_VIEWS, CUT_SHARE = 3, 0.3  # of width and height: how far such a view is aimed beside the subject
CONDITIONS = ("turned", "good", "loose", "loose_one", "cut_off", "close_up", "close_up_loose")


def drift(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 20) -> Outcome:
    """Runs this module's experiment. Returns the share of turned cameras that are named, and of good cameras that are,
    by condition and by warning."""
    records = bench.records("drift", key_of(model.sha256, camera_drift, tangency, TURN_DEG, LOOSE_PX))
    span, rows = with_modes(model, 60), []
    for i, subject in enumerate(random_subjects(subjects, seed=17)):
        rng = np.random.default_rng([17, i])
        rows.append(records.row(subject.name, lambda s=subject, r=rng: draw(span, s, renderer, r), i / subjects))
    found = figures(rows)
    return {"figures": found, "rows": rows, "markdown": as_markdown(found)}


def draw(model: HeadModel, subject: Planted, renderer: Renderer, rng: np.random.Generator) -> Row:
    """Draws one capture. Returns the code of the warning for every camera that is named, by condition."""
    rig = default_layout()
    turned, near, *cut = rng.permutation(rig.names)[: 2 + CUT_VIEWS].tolist()
    others = {near: _renamed(close_up(rig[near]), "near")}
    others |= {name: _renamed(aimed_beside(rig[name], rng), "cut off") for name in cut}
    style = random_look(rng).hair
    assert style is not None
    seen = worn_silhouettes(model, subject, Rig((*rig, *others.values())), renderer, style, rng, strands=False)
    wide = loosened(seen)
    believed = off_by(rig, CALIBRATION_PX, rng)
    plain = {name: seen[name] for name in rig.names}
    cut_rig, cut_seen = _with(believed, seen, {name: others[name] for name in cut})
    near_rig, near_seen = _with(believed, seen, {near: others[near]})
    _, near_wide = _with(believed, wide, {near: others[near]})
    cases = {
        "turned": (plain, knocked(believed, turned, TURN_DEG, rng)),
        "good": (plain, believed),
        "loose": ({name: wide[name] for name in rig.names}, believed),
        "loose_one": (plain | {turned: wide[turned]}, believed),
        "cut_off": (cut_seen, cut_rig),
        "close_up": (near_seen, near_rig),
        "close_up_loose": (near_wide, near_rig),
    }
    said = {condition: said_of(masks, cameras) for condition, (masks, cameras) in cases.items()}
    return {"name": subject.name, "turned_camera": turned, "close_up_camera": near, "said": said}


def said_of(silhouettes: Mapping[str, Silhouette], rig: Rig) -> dict[str, str]:
    """Returns the codes of the warnings about cameras, by camera."""
    return {found.camera: found.warning().code for found in find_drift(silhouettes, rig)}


def aimed_beside(camera: Camera, rng: np.random.Generator) -> Camera:
    """Returns the camera with its picture shifted in a random direction, so that its border cuts the subject off."""
    k, around = camera.intrinsics, rng.uniform(0.0, 2.0 * np.pi)
    right, down = CUT_SHARE * k.width * np.cos(around), CUT_SHARE * k.height * np.sin(around)
    return replace(camera, intrinsics=replace(k, cx=k.cx + right, cy=k.cy + down))


def _renamed(camera: Camera, suffix: str) -> Camera:
    return replace(camera, name=f"{camera.name} {suffix}")


def _with(rig: Rig, seen: Mapping[str, Silhouette], instead: Mapping[str, Camera]) -> tuple[Rig, dict[str, Silhouette]]:
    """The rig with the lenses of other cameras in place of its own, and what it sees then; poses stay as believed."""
    cameras = [replace(c, intrinsics=instead[c.name].intrinsics) if c.name in instead else c for c in rig]
    return Rig(tuple(cameras)), {n: seen[instead[n].name if n in instead else n] for n in rig.names}


def figures(rows: list[Row]) -> dict[str, float]:
    """Counts, over all captures, how often the turned camera was named, and how often a good one was, by condition."""
    turned = [row["said"]["turned"].get(row["turned_camera"]) for row in rows]
    found: dict[str, float] = {
        "captures": len(rows),
        "turned_named": sum(what is not None for what in turned),
        "turned_called_moved": sum(what == "camera-moved" for what in turned),
    }
    for condition in CONDITIONS:
        culprit = [{row["turned_camera"]} if condition == "turned" else set() for row in rows]
        others = [
            [what for name, what in row["said"][condition].items() if name not in known]
            for row, known in zip(rows, culprit, strict=True)
        ]
        found[f"{condition}_good_called_moved"] = sum("camera-moved" in said for said in others)
        found[f"{condition}_good_called_loose_or_moved"] = sum("mask-loose" in said for said in others)
    return found


def as_markdown(found: Mapping[str, float]) -> str:
    """Returns a Markdown table: for each condition, the number of captures in which a good camera is named."""
    whats = ("moved", "loose_or_moved")
    rows = [[name, *(found[f"{name}_good_called_{what}"] for what in whats)] for name in CONDITIONS]
    summary = f"turned cameras named: {found['turned_named']:.0f} of {found['captures']:.0f}, "
    table = markdown.table(("condition", "a good camera called moved", "called loose or moved"), rows)
    return f"{table}\n{summary}called moved: {found['turned_called_moved']:.0f}\n"
