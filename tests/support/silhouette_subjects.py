"""Silhouettes of random heads of the model with the studio's hair and shirt, and rigs that are off by a known error."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from calibration.adjustment.gauge import align_world, image_distance
from pipeline.contour_fit.problem import camera_information
from pipeline.head_model.model import HeadModel, load_model
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.anatomy import anatomy
from rig.studio.scene.hair import grow
from rig.studio.scene.subject import random_look, random_pose
from rig.studio.scene.worn import make_shirt

SPREAD_DEG, SPREAD_MM = 4.0, 12.0  # how subjects sit
MODES = 60
START_DEG, START_MM = 2.0, 4.0  # of a fit


def captures_of(
    renderer: Renderer, rig: Rig, count: int, rng: np.random.Generator, modes: int = 60
) -> Iterator[dict[str, Silhouette]]:
    """True silhouettes of ``count`` subjects as ``rig`` sees them."""
    model = load_model()
    for _ in range(count):
        vertices, faces, pose = dressed_head(model, rig, rng, modes)
        with renderer.silhouette_set(rig, faces) as drawn:
            masks = drawn.masks(pose.apply(vertices))
        yield {name: silhouette_from_mask(mask) for name, mask in masks.items()}


def dressed_head(
    model: HeadModel, rig: Rig, rng: np.random.Generator, modes: int, *, bare: bool = False
) -> tuple[np.ndarray, Int[np.ndarray, "f 3"], Similarity]:
    """Vertices (head frame; the head's own first) and faces of a head with hair and shirt, or bare, and its pose."""
    vertices, faces = model.vertices(0.8 * rng.standard_normal(modes)), model.levels["full"].faces
    if bare:
        return vertices, faces, random_pose(rig.centre_world(), SPREAD_DEG, SPREAD_MM, rng)
    body = anatomy(vertices, {name: vertices[i] for name, i in model.landmarks.items()})
    pieces = [(vertices, faces)]
    style = random_look(rng).hair
    if style:
        hair = grow(vertices, body, style, rng)
        pieces.append((hair.shell, hair.shell_faces))
    worn = make_shirt(Mesh(vertices, faces), body, rng)
    if worn:
        pieces.append(worn)
    starts = np.cumsum([0] + [len(points) for points, _ in pieces])
    joined = np.concatenate([part + start for (_, part), start in zip(pieces, starts, strict=False)])
    return np.concatenate([p for p, _ in pieces]), joined, random_pose(rig.centre_world(), SPREAD_DEG, SPREAD_MM, rng)


def disturbed(rig: Rig, error_px: float, rng: np.random.Generator) -> Rig:
    """``rig`` with every camera off, in the image ``error_px`` RMS (2D) over all cameras once worlds are aligned."""
    draws = []
    for camera in rig:
        depth = float(camera.camera_from_world.apply(rig.centre_world()[None])[0, 2])
        draws.append(np.sqrt(1.0 / np.diag(camera_information(camera, depth, 1.0))) * rng.standard_normal(6))
    off, scale = rig, error_px
    for _ in range(3):
        off = Rig(tuple(camera.moved(scale * draw) for camera, draw in zip(rig, draws, strict=True)))
        scale *= error_px / rms(image_distance(off, rig))
    return align_world(off, rig)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """A subject with its truth: vertices of the bare head in the world (mm), and where a fit starts."""

    seen: dict[str, Silhouette]
    truth: Float[np.ndarray, "v 3"]
    start: Similarity


def heads_of(renderer: Renderer, rig: Rig, count: int, rng: np.random.Generator, *, bare: bool) -> list[Head]:
    model, heads = load_model(), []
    for head_rng in rng.spawn(count):
        vertices, faces, pose = dressed_head(model, rig, head_rng, MODES, bare=bare)
        with renderer.silhouette_set(rig, faces) as drawn:
            masks = drawn.masks(pose.apply(vertices))
        turn = rotation_from_vector(np.radians(START_DEG) * head_rng.standard_normal(3) / np.sqrt(3.0))
        shift = START_MM * head_rng.standard_normal(3) / np.sqrt(3.0)
        start = Similarity(1.0, turn @ pose.rotation, pose.translation + shift)
        seen = {name: silhouette_from_mask(mask) for name, mask in masks.items()}
        heads.append(Head(seen, pose.apply(vertices)[: model.levels["full"].count], start))
    return heads
