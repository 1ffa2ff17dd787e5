"""Judges reconstructions from real photographs: a head from eleven views, compared with views that were not used.

The true surface is not known. Known are the photographs that were left out (their colours, and their outlines where
somebody drew them), and points on which two neighbouring views agree, those left out included. Cameras and masks are
estimated from all photographs; the surface from the eleven alone.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.geometry.projection import depth_map, picture
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.imaging.masks import erode
from pipeline.imaging.silhouette import Silhouette, signed_distance
from pipeline.multiview.scene_tracks import find_scene_points
from pipeline.reconstruct import reconstruct
from pipeline.results.reconstruction import Reconstruction
from pipeline.segmentation.segment import segment
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from rig.camera import Camera
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.captures.capture_folder import capture_root
from rig.mesh import Mesh
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.rig import Rig, spread_views
from server.tasks.photographs import read_or_calibrate
from server.tasks.prepare import prepare_kernels
from tests.laboratory.experiments.records import Bench, Outcome, Row

USED = 11
SIDE_DEG = 100.0  # from the front view's direction: the eleven, and the views they are judged by, look from there
INSIDE_PX = 8  # of the outline: points and colours nearer to it than that may be another thing's
GAIN_STEPS = 4  # of the robust fit of a view's exposure
CLIPPED = 250


@dataclass(frozen=True, slots=True, eq=False)
class RealCapture:
    """Holds a capture with more views than are used. ``drawn``: masks by hand, True = subject, of some of its views."""

    name: str
    capture: Capture
    rig: Rig
    drawn: Mapping[str, Bool[np.ndarray, "_ _"]]
    front: str | None = None


def real(
    folders: Sequence[Path],
    model: HeadModel,
    *,
    renderer: Renderer,
    bench: Bench,
    front: Annotated[str | None, "the view that the subject faces"] = None,
    outlines: Annotated[Path | None, "outlines drawn by hand, outlines.json, of a single folder"] = None,
) -> Outcome:
    """Runs this module's experiment. Returns a row for every folder, and their figures. By default a folder's own
    outlines.json is read. Estimated cameras are written to ``folder``. Raises InputError if a folder has no more views
    than are used, or ``outlines`` is given for several folders."""
    if outlines is not None and len(folders) > 1:
        raise InputError("--outlines", ["belongs to one folder; put outlines.json into each of several"])
    settings, rows = Settings(), list[Row]()
    prepare_kernels(bench.report, settings)
    with TemporaryDirectory() as scratch:
        captures = [
            read_real_capture(each, (bench.folder or Path(scratch)) / each.name, front, outlines, bench.report)
            for each in folders
        ]
    for one in captures:
        rows.append({"name": one.name, **judge(model, one, renderer=renderer, settings=settings, report=bench.report)})
    figures = {
        f"{row['name']}_{key}": float(value)
        for row in rows
        for key, value in row.items()
        if isinstance(value, float | int) and not isinstance(value, bool)
    }
    return {"figures": figures, "rows": rows}


def read_real_capture(
    folder: Path, kept: Path, front: str | None, outlines: Path | None, report: Progress
) -> RealCapture:
    """Reads a folder. Its masks and drawn outlines serve as the reference, its feature points are not used. Estimated
    cameras are written to ``kept``. Raises InputError."""
    prepared = read_or_calibrate(folder, kept, front=front, report=report)
    default = capture_root(folder) / "outlines.json"
    path = outlines or (default if default.is_file() else None)
    outlined = {} if path is None else json.loads(path.read_text()).get("outlines")
    if outlined is None:
        raise InputError("outlines.json", ["has no outlines"])
    drawn = {name: _filled(outlined[name], prepared.rig[name]) for name in prepared.rig.names if name in outlined}
    # A mask that the folder has serves as reference too; an outline drawn by hand replaces it.
    drawn = {**prepared.capture.masks, **drawn}
    return RealCapture(folder.name, replace(prepared.capture, features={}), prepared.rig, drawn, front)


def _filled(polygons: list, camera: Camera) -> Bool[np.ndarray, "h w"]:
    """Returns the mask of polygons in pixels, of which a pixel inside an even number is background."""
    mask = np.zeros((camera.intrinsics.height, camera.intrinsics.width), np.uint8)
    sixteenths = [np.rint(np.array(one) * 16.0).astype(np.int32) for one in polygons]
    return cv2.fillPoly(mask, sixteenths, 1, shift=4).view(bool)


def judge(
    model: HeadModel, real_capture: RealCapture, *, renderer: Renderer, settings: Settings, report: Progress
) -> Row:
    """Reconstructs the bust from eleven views, and compares it with the others."""
    started = time.perf_counter()
    silhouettes = segment(real_capture.capture, real_capture.rig, report=report)
    seconds_masks = time.perf_counter() - started
    near = views_in_front(real_capture.rig, real_capture.front)
    sound = [name for name in near if silhouettes[name].quality.usable]
    if len(sound) <= USED:
        raise InputError(
            real_capture.name, [f"{len(sound)} views of use on the front side; more than {USED} are needed"]
        )
    used = choose(real_capture, sound, silhouettes)
    rig = real_capture.rig.subset(used)
    found = {name: silhouettes[name] for name in rig.names}

    def ready(*_: object, **__: object) -> dict[str, Silhouette]:
        return found

    chosen = replace(settings, front=real_capture.front if real_capture.front in used else None)
    shot = Capture({name: real_capture.capture.images[name] for name in rig.names})
    started = time.perf_counter()
    done = reconstruct(ReconstructionContext(shot, rig, model, chosen, renderer, report, segment=ready))
    seconds = time.perf_counter() - started
    mesh, colours = surface_of(done)
    held_out = [real_capture.rig[name] for name in near if name not in used]
    outline = {
        c.name: outline_px(c, mesh, real_capture.drawn[c.name]) for c in held_out if c.name in real_capture.drawn
    }
    of_masks = {c.name: outline_px(c, mesh, silhouettes[c.name].mask) for c in held_out if c.name in sound}
    psnr = {
        c.name: psnr_db(c, mesh, colours, real_capture.capture.images[c.name], silhouettes[c.name]) for c in held_out
    }
    away = distances_mm(real_capture, near, silhouettes, mesh)
    return {
        "views": len(real_capture.rig),
        "used": used,
        "held_out": len(held_out),
        "surface": "bust" if done.bust is not None else "head",
        "outline_px": _median(outline),
        "outline_views": len(outline),
        "outline_of_masks_px": _median(of_masks),
        "psnr_db": _median(psnr),
        "points": len(away),
        "points_mm": float(np.median(away)) if len(away) else None,
        "points_90_mm": float(np.quantile(away, 0.9)) if len(away) else None,
        "seconds_masks": seconds_masks,
        "seconds": seconds,
        "outline_px_of": outline,
        "psnr_db_of": psnr,
        "warnings": [f"{warning.code}: {warning.text}" for warning in done.warnings],
    }


def choose(real_capture: RealCapture, sound: list[str], silhouettes: Mapping[str, Silhouette]) -> list[str]:
    """Chooses the eleven views: spread evenly, if possible none with a drawn outline, and none that cuts the subject
    off."""
    undrawn = [name for name in sound if name not in real_capture.drawn]
    whole = [name for name in undrawn if not silhouettes[name].quality.cut_off]
    enough = next((names for names in (whole, undrawn) if len(names) >= USED), sound)
    return spread_views(real_capture.rig.subset(enough), USED)


def views_in_front(rig: Rig, front: str | None) -> list[str]:
    """Returns the views that look from the front view's side."""
    away = np.stack([camera.centre_world for camera in rig]) - rig.centre_world()
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    ahead = away[rig.names.index(front or rig.front_camera())]
    return [n for n, cosine in zip(rig.names, away @ ahead, strict=True) if cosine > np.cos(np.radians(SIDE_DEG))]


def surface_of(done: Reconstruction) -> tuple[Mesh, UInt8[np.ndarray, "v 3"]]:
    """Returns the bust, or the head if there is none."""
    if done.bust is None:
        return done.mesh_world, done.texturing.vertices.colours
    return done.bust.mesh_world, done.bust.colours


def outline_px(camera: Camera, mesh: Mesh, mask: Bool[np.ndarray, "h w"]) -> float:
    """Returns the median distance (px) of the surface's outline from the mask's, where neither is cut off by the
    image's border."""
    shown = np.isfinite(depth_map(camera, mesh.vertices, mesh.faces)[0])
    distance = np.abs(signed_distance(mask))
    rim = shown & ~erode(shown, 1)
    for line in (rim[:2], rim[-2:], rim[:, :2], rim[:, -2:]):
        line[...] = False
    return float(np.median(np.abs(distance[rim] - 0.5))) if rim.any() else float("inf")


def psnr_db(
    camera: Camera,
    mesh: Mesh,
    colours: UInt8[np.ndarray, "v 3"],
    image: UInt8[np.ndarray, "h w 3"],
    silhouette: Silhouette,
) -> float:
    """Computes the PSNR (dB) between the surface in its vertex colours and a photograph, inside both outlines, with the
    exposure fitted."""
    drawn = picture(camera, mesh.vertices, mesh.faces, colours).astype(np.float64)
    shown = np.isfinite(depth_map(camera, mesh.vertices, mesh.faces)[0])
    inside = erode(shown, INSIDE_PX) & (silhouette.distance < -INSIDE_PX) & (image.max(axis=2) < CLIPPED)
    ours, theirs = drawn[inside], image[inside].astype(np.float64)
    if not len(ours):
        return 0.0
    weight = np.ones(len(ours))
    gain = np.ones(3)
    for _ in range(GAIN_STEPS):
        gain = (weight[:, None] * ours * theirs).sum(axis=0) / (weight[:, None] * ours**2).sum(axis=0)
        miss = np.abs(gain * ours - theirs).max(axis=1)
        weight = 1 / np.maximum(miss, 4.0)
    return float(10 * np.log10(255**2 / ((gain * ours - theirs) ** 2).mean()))


def distances_mm(
    real_capture: RealCapture, views: list[str], silhouettes: Mapping[str, Silhouette], mesh: Mesh
) -> Float[np.ndarray, " n"]:
    """Returns the distances (mm) between the surface and points on which neighbouring ``views`` agree, where their
    masks show the subject."""
    points = find_scene_points(real_capture.capture.images, real_capture.rig.subset(views))
    subject = np.zeros(len(points.points), int)
    for name in points.rows:
        at = np.rint(points.pixels[name]).astype(int)
        distance = silhouettes[name].distance[at[:, 1], at[:, 0]]
        np.add.at(subject, points.rows[name][distance < -INSIDE_PX], 1)
    on_subject = points.points[subject == 2]
    return SurfaceIndex(mesh.vertices, mesh.faces).closest(on_subject).distances if len(on_subject) else np.zeros(0)


def _median(values: Mapping[str, float]) -> float | None:
    return float(np.median(list(values.values()))) if values else None
