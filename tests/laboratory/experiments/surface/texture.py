"""Measures textures: the head is drawn as a photograph that was not used for anything, the fit included.

Compared are head.glb's texture, head.ply's vertex colours, and the paper's blend (section 4.5: the mean weighted by
normal . viewing direction) in a texture of the same size. Gain and offset of the unused camera are fitted by channel,
and the blur of its lens, for each alike. Only the face counts, three pixels from where it hides itself. A photograph
has noise that no texture can predict: ``_db`` is PSNR with the photograph's noise power (Immerkaer, *Fast Noise
Variance Estimation*, CVIU 1996, by the median) subtracted, ``_raw_db`` without. ``_detail`` is over the tenth of the
pixels with the steepest gradients: eyes, brows, lips.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.geometry.projection import camera_depths, depth_maps, project_points
from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import reconstruct
from pipeline.results.head_files import encoded
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.texturing.layout.uv_unwrap import Layout, model_layout
from pipeline.texturing.paint import paint_head
from pipeline.texturing.vertex_colours import colour_vertices as colour
from rig.camera import Camera
from rig.capture import Capture
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.errors import EigenheadError
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from tests.laboratory.experiments.paper.detail import IN_SPAN_MODES, IN_SPAN_SPREAD, Known, photographed, read_known
from tests.laboratory.experiments.pictures import labelled
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of, means_by
from tests.laboratory.experiments.surface.paper_blend import paper_texture

SUBJECTS = 10
KEPT_BACK = 4  # nearest cameras to the front one that take turns
BLURS_PX = (0.0, 0.4, 0.55, 0.7, 0.85, 1.0, 1.2)
HIDES_MM, EDGE_PX = 3.0, 3
STEEPEST = 0.1  # share of the pixels that are detail
SCALE = 0.02  # linear: residuals beyond it count less for the camera's gain
Image = UInt8[np.ndarray, "h w 3"]


def texture(
    model: HeadModel, captures: Mapping[str, Path], *, renderer: Renderer, bench: Bench, subjects: int = SUBJECTS
) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``; a figure is ``<group>_<quantity>``,
    the mean over the group: ``studio``, or a capture by its name.

    ``model``: fitted; heads are drawn from it, too. ``captures``: folders with a truth beside them, by name.
    ``renderer``: for the studio. ``subjects``: heads in the studio.
    """
    settings = replace(Settings(), outputs=OutputSettings(surface="head"))
    records = bench.records("texture", key_of(model.sha256, settings))
    jobs: list[tuple[str, str, int, Callable[[], Known]]] = []
    for number in range(subjects):
        draw = partial(photographed, model, IN_SPAN_MODES, IN_SPAN_SPREAD, 300 + number, renderer=renderer)
        jobs.append(("studio", f"{number:02}", number, draw))
    jobs += [(name, name, 1, partial(read_known, path)) for name, path in captures.items()]
    rows = []
    for done, (group, name, number, read) in enumerate(jobs):
        picture = None if bench.folder is None else bench.folder / f"texture-{name}.png"
        compute = partial(row_of, read, model, renderer, settings, number, picture)
        rows.append({"name": name, "group": group, **records.row(name, compute, done / len(jobs))})
    return {"figures": means_by(rows, "group"), "rows": rows}


def row_of(
    read: Callable[[], Known],
    model: HeadModel,
    renderer: Renderer,
    settings: Settings,
    number: int,
    picture: Path | None,
) -> Row:
    """Runs one subject without the ``number``-th nearest camera to the front one (counted in turn), and compares with
    that camera."""
    known = read()
    kept = held_out_camera(known.rig, number)
    rig = known.rig.subset(name for name in known.rig.names if name != kept.name)
    images = {name: image for name, image in known.capture.images.items() if name != kept.name}
    capture = replace(known.capture, images=images)
    found = reconstruct(ReconstructionContext(capture, rig, model, settings, renderer))
    atlas, silhouettes = found.texturing.atlas, found.views.silhouettes
    if atlas is None:
        raise EigenheadError(f"{known.name}: no texture")
    photograph, mesh, layout = known.capture.images[kept.name], found.mesh_world, atlas.layout
    face = face_pixels(kept, mesh, model.levels["full"].face_region)
    depths = depth_maps(rig, mesh)
    blend = paper_texture(layout, mesh, capture, silhouettes, rig, depths, filled=atlas.image)
    drawn = {
        "texture": drawn_texture(kept, mesh, layout, atlas.image),
        "vertices": _drawn(kept, mesh.vertices, mesh.faces, found.texturing.vertices.colours.astype(np.float32)),
        "paper": drawn_texture(kept, mesh, layout, blend),
    }
    row: Row = {"camera": kept.name, "size": len(atlas.image)}
    for name, image in drawn.items():
        row |= {f"{name}_{key}": value for key, value in errors(image, photograph, face).items()}
    row |= {
        "gain_over_vertices_db": row["texture_db"] - row["vertices_db"],
        "gain_over_paper_db": row["texture_db"] - row["paper_db"],
    } | seconds(found, model, capture, rig, settings)
    if picture is not None:
        write_image(picture, _side_by_side(photograph, drawn, face, row))
    return row


def held_out_camera(rig: Rig, number: int) -> Camera:
    """Chooses the camera that is not used: one of those that see the face."""
    front = rig[rig.front_camera()]
    order = sorted(rig, key=lambda camera: -float(camera.axis_world @ front.axis_world))
    return order[1 + number % KEPT_BACK]


def seconds(found: Reconstruction, model: HeadModel, capture: Capture, rig: Rig, settings: Settings) -> Row:
    """Returns wall-clock and processor seconds of vertex colours alone, and of what the texture adds, its JPEG
    included."""
    mesh, layout = found.mesh_world, model_layout(model)
    views, depths = found.views.silhouettes, depth_maps(rig, mesh)
    coloured_by = partial(colour, mesh, capture, views, rig, depths, settings=settings.texture)
    times = [(time.perf_counter(), time.process_time())]
    coloured_by()
    times.append((time.perf_counter(), time.process_time()))
    coloured = coloured_by(around=layout.around)
    atlas = paint_head(layout, mesh, coloured, model.levels["full"].face_region, settings)
    if atlas is not None:
        encoded(atlas.image, "jpeg")
    times.append((time.perf_counter(), time.process_time()))
    (wall, cpu), (more_wall, more_cpu) = ((b[0] - a[0], b[1] - a[1]) for a, b in pairwise(times))
    return {"vertices_s": wall, "texture_adds_s": more_wall - wall, "texture_adds_cpu_s": more_cpu - cpu}


def face_pixels(camera: Camera, mesh: Mesh, region: Bool[np.ndarray, " v"]) -> Bool[np.ndarray, "h w"]:
    """Returns where the camera sees the face, away from edges that hide other parts of it."""
    k = camera.intrinsics
    depth, seen = rasterise(
        project_points(camera, mesh.vertices), camera_depths(camera, mesh.vertices), mesh.faces, k.height, k.width
    )
    whole = np.asarray(region[mesh.faces].all(axis=1))
    inside = ((seen >= 0) & whole[seen]).astype(np.uint8)
    filled = np.where(np.isfinite(depth), depth, 1e6).astype(np.float32)
    around = np.ones((3, 3), np.uint8)
    step = np.asarray(cv2.dilate(filled, around)) - np.asarray(cv2.erode(filled, around)) > HIDES_MM
    wide = np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)
    return (cv2.erode(inside, wide) > 0) & (cv2.dilate(step.astype(np.uint8), wide) == 0)


def drawn_texture(camera: Camera, mesh: Mesh, layout: Layout, image: Image) -> Float32[np.ndarray, "h w 3"]:
    """Returns a textured mesh as the camera sees it, unlit."""
    texels = (len(image) * layout.uv - 0.5).astype(np.float32)
    at = _drawn(camera, mesh.vertices[layout.source], layout.faces, texels)
    x, y = (np.nan_to_num(at[:, :, i]) for i in range(2))
    return cv2.remap(np.ascontiguousarray(image), x, y, cv2.INTER_LINEAR).astype(np.float32)


def _drawn(camera: Camera, vertices: np.ndarray, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
    k = camera.intrinsics
    pixels, depths = project_points(camera, vertices), camera_depths(camera, vertices)
    _, seen = rasterise(pixels, depths, faces, k.height, k.width)
    return np.nan_to_num(interpolate(seen, pixels, depths, faces, values))


def errors(drawn: Float32[np.ndarray, "h w 3"], photograph: Image, face: Bool[np.ndarray, "h w"]) -> dict[str, float]:
    """Returns the PSNR (dB) of a drawn face against the photograph, at the best of ``BLURS_PX``, as the module
    describes."""
    tries = [cv2.GaussianBlur(drawn, (0, 0), blur) if blur else drawn for blur in BLURS_PX]
    residuals = [_residual(image[face], photograph[face]) for image in tries]
    best = min(residuals, key=lambda residual: float((residual**2).mean()))
    noise = noise_power(photograph, face)
    steep = _steep(photograph, face)[face]
    power, detail = float((best**2).mean()), float((best[steep] ** 2).mean())
    return {"raw_db": _db(power), "db": _db(power - noise), "detail_db": _db(detail - noise)}


def _db(power: float) -> float:
    return float(10 * np.log10(255**2 / max(power, 0.1)))


def _residual(drawn: Float32[np.ndarray, "n 3"], seen: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Codes that are left after the camera's own gain and offset, channel by channel (Cauchy weights)."""
    out = np.empty(seen.shape)
    ours, theirs = linear_from_srgb(drawn / 255.0), linear_from_srgb(seen / 255.0)
    for channel in range(3):
        columns = np.stack([ours[:, channel], np.ones(len(ours))], axis=1)
        weight = np.ones(len(ours))
        fitted = columns[:, 0]
        for _ in range(6):
            gain = np.linalg.lstsq(columns * weight[:, None], theirs[:, channel] * weight, rcond=None)[0]
            fitted = columns @ gain
            weight = 1 / (1 + ((fitted - theirs[:, channel]) / SCALE) ** 2)
        out[:, channel] = 255 * srgb_from_linear(np.clip(fitted, 0, 1)) - seen[:, channel]
    return out


def noise_power(photograph: Image, face: Bool[np.ndarray, "h w"]) -> float:
    """Returns the variance of the photograph's noise, codes squared."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    answers = cv2.filter2D(photograph.astype(np.float32), -1, kernel)[face]
    return float(np.mean((1.4826 * np.median(np.abs(answers), axis=0) / 6) ** 2))


def _steep(photograph: Image, face: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    grey = cv2.GaussianBlur(photograph.astype(np.float32), (0, 0), 1.5).mean(axis=2)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    return face & (slope > np.quantile(slope[face], 1 - STEEPEST))


def _side_by_side(photograph: Image, drawn: Mapping[str, np.ndarray], face: np.ndarray, row: Row) -> Image:
    rows, columns = np.nonzero(face)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    panels = {f"{row['camera']}, kept back": photograph} | {
        f"{name} {row[f'{name}_db']:.1f} dB": np.clip(np.rint(image), 0, 255).astype(np.uint8)
        for name, image in drawn.items()
    }
    return np.hstack(
        [
            labelled(np.asarray(cv2.resize(image[box], None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)), text)
            for text, image in panels.items()
        ]
    )
