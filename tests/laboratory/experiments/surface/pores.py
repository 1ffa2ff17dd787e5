"""Measures the detail ``pores`` on a head whose relief is known, photographed at 24 Mpx (``pores_scene``).

The head is reconstructed from the pictures of work size, without one view; then its texture stage is run again with
``detail = "pores"``. Displacement is compared with the true relief where that has its full height: correlation over
waves of 0.5 to 3 mm, and over three bands of them. The texture is drawn into the view that was kept back: the error
over waves of less than 1 mm, by that of the texture of work size, in dB; the noise of the kept-back picture is taken
off. Seconds and memory are those that pores add, the files of the maps included.
"""

import os
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import reconstruct
from pipeline.results.head_files import write_skin_maps
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.texturing import Texturing, texture_head
from pipeline.texturing.layout.uv_unwrap import Layout
from pipeline.texturing.pores.skin_maps import MID_CODE, MM_PER_CODE
from rig.formats.pictures.images import write_image
from rig.geometry import RigidTransform
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from tests.laboratory.experiments.pictures import labelled
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of, means_by
from tests.laboratory.experiments.surface.pores_scene import CloseUp, photograph_close_up
from tests.laboratory.experiments.surface.texture import drawn_texture, face_pixels, noise_power

BANDS_MM = ((0.5, 3.0), (0.5, 0.75), (0.75, 1.5), (1.5, 3.0))
SKINS: Mapping[str, tuple[str, ...]] = {"smooth": ("smooth",), "painted": ()}  # realism of the studio's skin
FINE_PER_MM = 1.0
MB, SAMPLED_S = 1e6, 0.05
SHOWN_MM, SHOWN_SIDE = 0.1, 500  # a displacement that is shown white, and the side of a picture of it


def pores(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 1) -> Outcome:
    """Runs this module's experiment: heads of smooth skin, and of skin with painted spots as large as its furrows. A
    figure is ``<skin>_<quantity>``, the mean over the heads.

    ``model``: fitted; heads are drawn from it, too. ``renderer``: for the studio. ``subjects``: heads of each skin.
    """
    settings = replace(Settings(), outputs=OutputSettings(surface="head"))
    records = bench.records("pores", key_of(model.sha256, settings))
    rows: list[Row] = []
    jobs = [(skin, seed) for skin in SKINS for seed in range(1, subjects + 1)]
    for done, (skin, seed) in enumerate(jobs):
        bench.report(skin, done / len(jobs))
        picture = None if bench.folder is None else bench.folder / f"pores-{skin}-{seed}.png"
        rows.append(
            {"name": f"{skin}-{seed}", "skin": skin}
            | records.row(f"{skin}-{seed}", partial(row_of, model, skin, seed, renderer, settings, picture=picture))
        )
    return {"figures": means_by(rows, "skin"), "rows": rows}


def row_of(
    model: HeadModel, skin: str, seed: int, renderer: Renderer, settings: Settings, *, picture: Path | None
) -> Row:
    """Runs one head."""
    shot = photograph_close_up(model, seed, renderer, realism=SKINS[skin])
    context = ReconstructionContext(shot.capture, shot.rig, model, settings, renderer)
    found = reconstruct(context)
    requested = replace(context, settings=replace(settings, detail="pores"), read_original=shot.read_original)
    with measured() as added, tempfile.TemporaryDirectory() as scratch:
        fine = texture_head(requested, found.views, found.head, found.refined, found.labels).product
        assert fine.atlas is not None, "the files have a texture"
        assert fine.skin is not None, "the pictures are at hand"
        write_skin_maps(Path(scratch), fine.atlas, fine.skin)
    added["seconds"] -= found.seconds["texture"]
    row: Row = {"size": len(fine.atlas.image), **added}
    row |= {f"repeated_{octave}": share for octave, share in enumerate(fine.skin.repeated)}
    compared = {"cheek": 0, "forehead": 1}
    patches = {name: patch_of(shot, found.mesh_world, fine, which) for name, which in compared.items()}
    for name, patch in patches.items():
        row |= {f"{name}_{key}": value for key, value in correlations(*patch).items()}
    row["correlation"] = float(np.mean([row[f"{name}_correlation_0.5_3"] for name in compared]))
    row |= fine_gain(shot, found, fine.atlas.image, model.levels["full"].face_region)
    if picture is not None:
        write_image(picture, sheet(shot, patches, fine))
    return row


@contextmanager
def measured() -> Iterator[dict[str, float]]:
    """Yields a dictionary that gets, at the end of the block, its seconds and by how many MB the memory of this process
    grew at most."""
    found: dict[str, float] = {}
    start, before, peak, done = time.perf_counter(), resident_mb(), [0.0], threading.Event()

    def watch() -> None:
        while not done.wait(SAMPLED_S):
            peak[0] = max(peak[0], resident_mb())

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield found
    finally:
        done.set()
        watcher.join()
    found |= {"seconds": time.perf_counter() - start, "memory_mb": max(peak[0] - before, 0.0)}


def resident_mb() -> float:
    """Returns the memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / MB


Field = Float32[np.ndarray, "r c"]


def patch_of(
    shot: CloseUp, mesh: Mesh, fine: Texturing, which: int
) -> tuple[Field, Field, Bool[np.ndarray, "r c"], float]:
    """Returns the estimated and the true relief (mm) of the texels around a place with relief, where it has its full
    height, and the millimetres of a texel."""
    assert fine.atlas is not None, "checked by the caller"
    assert fine.skin is not None, "checked by the caller"
    layout, size = fine.atlas.layout, len(fine.skin.displacement)
    head_from_world = RigidTransform(
        shot.scene.world_from_head.rotation, shot.scene.world_from_head.translation
    ).inverse()
    centre = shot.relief.centres[which]
    box, points = texels_near(
        layout, Mesh(head_from_world.apply(mesh.vertices), mesh.faces), centre, shot.relief.radius_mm, size
    )
    truth = Mesh(head_from_world.apply(shot.scene.head.vertices), shot.scene.head.faces)
    inside = np.linalg.norm(points - centre, axis=2) < shot.relief.radius_mm  # NaN is not
    places = SurfaceIndex(truth.vertices, truth.faces, 1.0).closest(points[inside].astype(float)).points
    true = np.zeros(inside.shape, np.float32)
    true[inside] = shot.relief.heights_mm(places)
    whole = np.zeros(inside.shape, bool)
    whole[inside] = shot.relief.share(places) > 0.99
    steps = [float(np.nanmedian(np.linalg.norm(np.diff(points, axis=axis), axis=2))) for axis in (0, 1)]
    return (
        (fine.skin.displacement[box].astype(np.float32) - MID_CODE) * np.float32(MM_PER_CODE),
        true,
        whole,
        float(np.sqrt(steps[0] * steps[1])),
    )


def texels_near(
    layout: Layout, mesh: Mesh, centre: Float[np.ndarray, " 3"], radius_mm: float, size: int
) -> tuple[tuple[slice, slice], Float32[np.ndarray, "r c 3"]]:
    """Returns the texels around a point of a head, and their points on it (NaN beside the layout)."""
    texels = size * layout.uv - 0.5
    near = texels[np.linalg.norm(mesh.vertices[layout.source] - centre, axis=1) < radius_mm]
    (left, top), (right, bottom) = near.min(axis=0).astype(int), near.max(axis=0).astype(int) + 1
    moved, ones = texels - (left, top), np.ones(len(texels))
    _, shown = rasterise(moved, ones, layout.faces, bottom - top, right - left)
    points = interpolate(shown, moved, ones, layout.faces, mesh.vertices[layout.source].astype(np.float32))
    return (slice(top, bottom), slice(left, right)), points


def correlations(found: Field, true: Field, whole: Bool[np.ndarray, "r c"], texel_mm: float) -> dict[str, float]:
    """Returns the correlation of two reliefs in each of ``BANDS_MM``, and the ratio of their heights in the first."""
    row = {}
    for shortest, longest in BANDS_MM:
        ours, theirs = (banded(field * whole, texel_mm, shortest, longest)[whole] for field in (found, true))
        spread = float(ours.std() * theirs.std())
        row[f"correlation_{shortest:g}_{longest:g}"] = float(np.mean(ours * theirs)) / spread if spread > 0 else 0.0
        row[f"height_ratio_{shortest:g}_{longest:g}"] = float(ours.std() / theirs.std())
    return row


def banded(field: Field, texel_mm: float, shortest_mm: float, longest_mm: float) -> Float[np.ndarray, "r c"]:
    """Returns the waves of a field between two lengths."""
    down, across = np.meshgrid(np.fft.fftfreq(field.shape[0]), np.fft.fftfreq(field.shape[1]), indexing="ij")
    per_mm = np.hypot(down, across) / texel_mm
    return np.fft.ifft2(np.fft.fft2(field) * ((per_mm >= 1 / longest_mm) & (per_mm <= 1 / shortest_mm))).real


def fine_gain(
    shot: CloseUp, found: Reconstruction, fine: UInt8[np.ndarray, "t t 3"], face: Bool[np.ndarray, " v"]
) -> Row:
    """Returns by how many dB the error of the finer texture in the kept-back view is smaller, over waves of less than a
    millimetre, and the power of that picture and of the errors (codes squared)."""
    camera, image = shot.kept_back.camera, shot.kept_back.image
    mesh, atlas = found.mesh_world, found.texturing.atlas
    assert atlas is not None, "checked by the caller"
    where = face_pixels(camera, mesh, face) & relieved_pixels(shot)
    sigma_px = pixel_sigma(shot)
    noise = noise_power(image, where) * kept_noise(sigma_px)
    seen = without_coarse(image.astype(np.float32), sigma_px)
    row: Row = {"kept_back_power": float((seen[where] ** 2).mean()) - noise}
    for name, texture in (("work_size", atlas.image), ("pores", fine)):
        drawn = without_coarse(drawn_texture(camera, mesh, atlas.layout, texture), sigma_px)
        row[f"{name}_error"] = float(((drawn - seen)[where] ** 2).mean()) - noise
    row["gain_db"] = float(10 * np.log10(max(row["work_size_error"], 0.01) / max(row["pores_error"], 0.01)))
    return row


def relieved_pixels(shot: CloseUp) -> Bool[np.ndarray, "h w"]:
    """Returns where the kept-back picture shows skin with its whole relief."""
    camera, head = shot.kept_back.camera, shot.scene.head
    share = shot.relief.share(shot.scene.world_from_head.inverse().apply(head.vertices))
    k = camera.intrinsics
    pixels, depths = camera.project(head.vertices), camera.camera_from_world.apply(head.vertices)[:, 2]
    _, shown = rasterise(pixels, depths, head.faces, k.height, k.width)
    drawn = interpolate(shown, pixels, depths, head.faces, share[:, None].astype(np.float32))
    return np.nan_to_num(drawn[:, :, 0]) > 0.9


def pixel_sigma(shot: CloseUp) -> float:
    """Returns the Gaussian (pixels) that halves waves of ``FINE_PER_MM``."""
    camera, at = shot.kept_back.camera, shot.scene.world_from_head.apply(shot.relief.centres)
    pixel_mm = float(camera.camera_from_world.apply(at)[:, 2].mean()) / camera.intrinsics.fx
    return float(np.sqrt(np.log(2) / (2 * np.pi**2))) / (FINE_PER_MM * pixel_mm)


def without_coarse(image: Float32[np.ndarray, "h w 3"], sigma_px: float) -> Float32[np.ndarray, "h w 3"]:
    """Returns an image without what a Gaussian leaves of it."""
    return image - cv2.GaussianBlur(image, (0, 0), sigma_px)


def kept_noise(sigma_px: float) -> float:
    """Returns the share of white noise's power that ``without_coarse`` leaves."""
    point = np.zeros((65, 65), np.float32)
    point[32, 32] = 1.0
    return float(((point - cv2.GaussianBlur(point, (0, 0), sigma_px)) ** 2).sum())


def sheet(shot: CloseUp, patches: Mapping[str, tuple[Field, Field, np.ndarray, float]], fine: Texturing) -> ImageRgb:
    """Draws the estimated and the true relief of each patch: heights, and clay lit from the side."""
    rows = []
    for name, (found, true, whole, texel_mm) in patches.items():
        panels = []
        for title, field in (("found", found), ("true", true)):
            height = np.clip(127.5 + 127.5 * banded(field * whole, texel_mm, *BANDS_MM[0]) / SHOWN_MM, 0, 255)
            for kind, image in ((f"{name}, {title}", height), ("clay", clay_of(field * whole, texel_mm))):
                square = cv2.resize(image.astype(np.uint8), (SHOWN_SIDE, SHOWN_SIDE), interpolation=cv2.INTER_AREA)
                panels.append(labelled(np.repeat(np.asarray(square)[:, :, None], 3, axis=2), kind))
        rows.append(np.hstack(panels))
    return np.vstack(rows)


def clay_of(heights_mm: Field, texel_mm: float) -> Float[np.ndarray, "r c"]:
    """Returns a relief in clay (codes), lit from its upper left."""
    down, across = np.gradient(heights_mm, texel_mm)
    normal = np.stack([-across, -down, np.ones_like(across)], axis=2)
    lamp = np.array([-0.6, -0.6, 0.53])
    return np.clip(230 * (normal @ lamp) / np.linalg.norm(normal, axis=2), 0, 255)
