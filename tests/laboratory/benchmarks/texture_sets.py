"""What polarised pictures tell of a simulated head, whose scattered and mirrored light are known.

python -m tests.laboratory texture_sets --seed 7 --oil 1.0 --out OUT

Prints, over the face: how far the plain texture, that of the parallel and that of the crossed pictures are from the
truth's scattered light (RMS by the RMS of the truth, dB, an exposure a channel taken out), the same within highlights;
and of the specular light its correlation with the truth, the ratio of the two, and what it has where nothing is
mirrored. OUT gets the maps.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry.projection import project_points
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import reconstruct
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.head_files import write_set_textures
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.colour_space import linear_from_srgb
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import Scene, simulate
from rig.studio.sensor.preset import PRESET
from server.tasks.subjects import drawn_subject

DULL, BRIGHT = 0.002, 0.05  # linear, mirrored light of a channel: none, a highlight


def run(
    model: HeadModel, renderer: Renderer, folder: Path | None, *, seed: int = 7, oil: float = 1.0
) -> dict[str, Any]:
    """Makes a head of the studio and compares its maps with the truth."""
    rng = np.random.default_rng(seed)
    preset = replace(PRESET, oil=oil, polarised=True)
    taken = simulate(drawn_subject(model, rng), default_layout(), preset, rng, renderer=renderer)
    settings = Settings(outputs=OutputSettings(surface="head"))
    capture = replace(taken.capture, features={})
    result = reconstruct(ReconstructionContext(capture, taken.rig, model, settings, renderer))
    texturing = result.texturing
    assert texturing.sets is not None
    assert texturing.sets.specular is not None
    assert texturing.atlas is not None
    if folder is not None:
        write_set_textures(folder, texturing.sets)
    face = np.flatnonzero(model.levels["full"].face_region & (texturing.vertices.views >= 2))
    scattered, mirrored = scattered_at(taken.scene, result, face), mirrored_at(taken.scene, result, face)
    images = {
        "plain": texturing.atlas.image,
        **{name: atlas.image for name, atlas in texturing.sets.atlases.items()},
    }
    bright, dull = mirrored.max(axis=1) > BRIGHT, mirrored.max(axis=1) < DULL
    row = {"bright_share": float(bright.mean()), "dull_share": float(dull.mean())}
    for name, image in images.items():
        light = linear_from_srgb(texels(result, image, face) / 255.0)
        row[f"{name}_db"], row[f"{name}_bright_db"] = error_db(light, scattered, bright)
    found = texels(result, texturing.sets.specular.light.astype(float), face)
    row["specular_correlation"] = float(np.corrcoef(found.mean(axis=1), mirrored.mean(axis=1))[0, 1])
    row["specular_ratio"] = float(np.median(found[bright].mean(axis=1) / mirrored[bright].mean(axis=1)))
    row["specular_where_none"] = float(found[dull].mean())
    return {"figures": row | {"negative": texturing.sets.specular.negative}}


def texels(result: Reconstruction, image: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The texels at some vertices of the head."""
    assert result.texturing.atlas is not None
    size = len(image)
    column, row = np.floor(size * result.texturing.atlas.layout.uv[rows]).astype(int).clip(0, size - 1).T
    return image[row, column]


def scattered_at(scene: Scene, result: Reconstruction, rows: np.ndarray) -> np.ndarray:
    """The truth's scattered light (linear) nearest to some vertices of the head."""
    head = scene.head
    assert head.colours is not None
    hits = SurfaceIndex(head.vertices, head.faces, 1.0).closest(result.mesh_world.vertices[rows])
    corners = linear_from_srgb(head.colours[head.faces[hits.triangles]] / 255.0)
    return np.einsum("nk,nkc->nc", hits.weights, corners)


def mirrored_at(scene: Scene, result: Reconstruction, rows: np.ndarray) -> np.ndarray:
    """The truth's mirrored light (linear) at some vertices: its mean over the views, as the texture weighs them."""
    decision = result.texturing.vertices.decision
    assert decision is not None
    points, views = result.mesh_world.vertices[rows], by_name(scene)
    total, weights = np.zeros((len(rows), 3)), np.full((len(rows), 1), 1e-12)
    for camera, weight in zip(decision.views, decision.weights, strict=True):
        light = views[camera.name]
        height, width = light.shape[:2]
        column, row = np.rint(project_points(camera, points)).astype(int).T
        total += weight[rows, None] * light[row.clip(0, height - 1), column.clip(0, width - 1)]
        weights += weight[rows, None]
    return total / weights


def by_name(scene: Scene) -> Mapping[str, np.ndarray]:
    """The mirrored light of each camera's picture."""
    found = {}
    for name, view in scene.views.items():
        assert view.matt is not None
        found[name] = (view.subject - view.matt)[:, :, :3]
    return found


def error_db(light: np.ndarray, truth: np.ndarray, part: np.ndarray) -> tuple[float, float]:
    """RMS difference by the truth's RMS (dB), over all and over a part; an exposure a channel is taken out."""
    off = light * ((light * truth).sum(axis=0) / (light**2).sum(axis=0)) - truth
    whole, within = (np.sqrt(np.mean(off[of] ** 2) / np.mean(truth[of] ** 2)) for of in (slice(None), part))
    return float(20 * np.log10(whole)), float(20 * np.log10(within))
