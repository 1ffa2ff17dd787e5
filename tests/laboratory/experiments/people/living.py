"""Judges heads of living people, whose true surface nobody knows, by photographs of many calibrated cameras.

All cameras with the masks that the folder has make the reference. Fewer cameras (the most frontal ones), photographs
alone, half of the size and JPEG of quality 60 are compared with it, the two halves of the cameras with each other:
distances (mm) from the face to the other surface, as delivered and in the region of ``repeat`` figures (80 mm behind
the foremost point, 65 mm to either side, -85 to 55 mm high). Views that a row did not use are compared by colour (dB).
Planted faults are in ``guards``. Folders hold recognisable people: rows have figures and nothing else.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.results.reconstruction import Reconstruction
from pipeline.segmentation.segment import segment
from pipeline.settings import OutputSettings, Settings
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.image import ImageRgb
from rig.render.renderer import Renderer
from rig.rig import Rig
from server.tasks.photographs import read_scaled_capture
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.faults.real import psnr_db, surface_of
from tests.laboratory.experiments.people.guards import codes_of
from tests.laboratory.experiments.people.people import run_job
from tests.laboratory.experiments.people.view_subsets import azimuths_deg, frontal_views
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of

COUNTS = (16, 11, 8, 5, 3)  # of cameras
JPEG_QUALITY = 60
QUIET = {"unknown-key"}  # says nothing about the pictures


@dataclass(frozen=True, slots=True)
class Shot:
    """Holds one row before it is computed."""

    name: str
    read: Callable[[], tuple[Capture, Rig]]


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """Holds a person's folder, the reference head, and the silhouettes of all its cameras."""

    folder: Path
    capture: Capture
    rig: Rig
    head: Reconstruction
    silhouettes: dict[str, Silhouette]


def living(
    folders: Sequence[Path],
    model: HeadModel,
    *,
    renderer: Renderer,
    bench: Bench,
    only: Annotated[Sequence[str], "words that rows must contain; may be repeated"] = (),
) -> Outcome:
    """Runs this module's experiment. Returns a row for each head, and the figures ``good``, ``refused`` and
    ``false_warnings`` (the median of a capture)."""
    settings = replace(Settings(), outputs=OutputSettings(surface="head"))
    run = partial(run_job, model=model, settings=settings, renderer=renderer)
    records, rows = bench.records("living", key_of(model.sha256, settings)), list[Row]()
    for folder in folders:
        capture, rig = read_scaled_capture(folder)
        subject = Subject(folder, capture, rig, run(capture, rig), segment(capture, rig, report=bench.report))
        shots = [one for one in shots_of(subject) if all(word in one.name for word in only)]
        for number, shot in enumerate(shots):
            rows.append(records.row(shot.name, partial(judge, shot, subject, run), number / len(shots)))
        if not only:
            rows.append(records.row(f"{folder.name} halves", partial(judge_halves, subject, run)))
    header = ("name", "median", "mean", "p95", "dB", "seconds", "told")
    text = markdown.table(header, [[row.get(name) for name in header] for row in rows])
    return {"figures": figures_of(rows), "rows": rows, "markdown": text, "lines": text.splitlines()}


def shots_of(subject: Subject) -> Iterator[Shot]:
    """Yields the rows of a person."""
    for count in (count for count in COUNTS if count <= len(subject.rig)):
        names = frontal_views(subject.rig, subject.head.head.fit.world_from_head, count)
        for evidence in ("masks", "photographs"):
            some = partial(read_views, subject.folder, names, evidence)
            name = f"{subject.folder.name} {count} {evidence}"
            if (count, evidence) != (len(subject.rig), "masks"):
                yield Shot(name, some)
            if count == 11:
                yield Shot(f"{name} half", partial(some, share=0.5))
                yield Shot(f"{name} jpeg", partial(change_pictures, some, compress))


def read_views(folder: Path, names: Sequence[str], evidence: str, share: float = 1.0) -> tuple[Capture, Rig]:
    """Reads some views of a capture, with masks or without; ``share``: of the picture's width."""
    capture, rig = read_scaled_capture(folder)
    if share < 1.0:
        pixels = max(camera.intrinsics.width * camera.intrinsics.height for camera in rig)
        capture, rig = read_scaled_capture(folder, pixels_most=round(pixels * share**2))
    masks = {name: capture.masks[name] for name in names} if evidence == "masks" else {}
    return Capture({name: capture.images[name] for name in names}, masks=masks), rig.subset(names)


def compress(image: ImageRgb) -> ImageRgb:
    """Returns a picture as JPEG leaves it."""
    data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1])


Read = Callable[[], tuple[Capture, Rig]]


def change_pictures(read: Read, change: Callable[[ImageRgb], ImageRgb]) -> tuple[Capture, Rig]:
    """Returns a capture whose pictures are changed."""
    capture, rig = read()
    return replace(capture, images={name: change(image) for name, image in capture.images.items()}), rig


def judge(shot: Shot, subject: Subject, run: Callable[[Capture, Rig], Reconstruction]) -> Row:
    """Runs one job and compares its head with the reference."""
    (capture, rig), began = shot.read(), time.perf_counter()
    row: Row = {"name": shot.name}
    try:
        done = run(capture, rig)
    except EigenheadError as refusal:
        codes = codes_of(refusal.message)
        return row | {"refused": True, "codes": sorted(codes), "told": f"refused: {refusal}"[:120]}
    codes = sorted({warning.code for warning in done.warnings} - QUIET)
    row |= {"seconds": time.perf_counter() - began, "told": ", ".join(codes) or "-"}
    row |= {"codes": sorted({code for warning in done.warnings for code in codes_of(warning)} - QUIET)}
    others = [camera for camera in subject.rig if camera.name not in rig.names]
    surface, images = surface_of(done), subject.capture.images
    decibels = [psnr_db(c, *surface, images[c.name], subject.silhouettes[c.name]) for c in others]
    return row | distances(subject.head, done) | ({"dB": float(np.median(decibels))} if decibels else {})


def judge_halves(subject: Subject, run: Callable[[Capture, Rig], Reconstruction]) -> Row:
    """Compares the heads of two disjoint halves of the cameras, every fourth and its neighbour around the head."""
    around = np.argsort(azimuths_deg(subject.rig, subject.head.head.fit.world_from_head), kind="stable")
    halves = []
    for of_half in ((0, 3), (1, 2)):
        names = tuple(subject.rig.names[row] for place, row in enumerate(around) if place % 4 in of_half)
        halves.append(run(*read_views(subject.folder, names, "masks")))
    codes = sorted({warning.code for half in halves for warning in half.warnings} - QUIET)
    row = {"name": f"{subject.folder.name} halves", "codes": codes, "told": ", ".join(codes) or "-"}
    return row | distances(halves[0], halves[1])


def distances(of: Reconstruction, to: Reconstruction) -> Row:
    """Computes the distances (mm) from the face of one head to the surface of another, both as delivered."""
    vertices, surface = of.mesh_world.vertices, to.mesh_world
    hit = SurfaceIndex(surface.vertices, surface.faces, 1.0).closest(vertices[face_of(of)])
    return {
        "median": float(np.median(hit.distances)),
        "mean": float(hit.distances.mean()),
        "p95": float(np.quantile(hit.distances, 0.95)),
    }


def face_of(head: Reconstruction) -> Bool[np.ndarray, " v"]:
    """Returns which vertices are the face, as ``repeat`` figures count it."""
    pose = head.head.fit.world_from_head
    at: Float[np.ndarray, "v 3"] = pose.inverse().apply(head.mesh_world.vertices)
    ahead = (head.mesh_world.normals() @ pose.rotation)[:, 2] > 0.1
    high = (at[:, 1] > -85.0) & (at[:, 1] < 55.0)
    return high & ahead & (np.abs(at[:, 0]) < 65.0) & (at[:, 2] > at[:, 2].max() - 80.0)


def figures_of(rows: Sequence[Row]) -> dict[str, float]:
    """Counts what was refused and warned of."""
    return {
        "good": float(len(rows)),
        "refused": float(sum("refused" in row for row in rows)),
        "false_warnings": float(np.median([len(row["codes"]) for row in rows])) if rows else 0.0,
    }
