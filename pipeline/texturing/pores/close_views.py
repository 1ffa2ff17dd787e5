"""Reads the part of each full-size picture that shows the head, and parts the views in two sets."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from pipeline.geometry.projection import project_points
from pipeline.texturing.chart_colours import ChartColours, in_true_colours
from pipeline.texturing.decision import Decision, pack_pictures
from pipeline.texturing.paint_kernels import Choice, Pictures
from pipeline.texturing.pores.relief import HalfPictures
from pipeline.texturing.vertex_colours import Texture
from rig.camera import Camera
from rig.capture import ReadImage
from rig.geometry import Similarity
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.rig import Rig

MAX_VIEWS = 12  # read: of 24 Mpx they take 0.4 GB, of 45 Mpx 0.8 GB, as much again while they are packed
MARGIN_PX = 8
COARSER = 0.8
HALF_VIEWS = 2  # in the mean of each of two sets: more blur, for errors of the geometry
GREY = 128.0  # code of what no view shows: the same in both pictures, so that it adds nothing


@dataclass(frozen=True, slots=True, eq=False)
class CloseViews:
    """Holds the full-size pictures of some views, packed.

    Attributes:
        views: the cameras that take just these pictures.
        rows: of these views in the ``decision``.
        pictures: packed as those of work size.
        decision: which views of work size colour each vertex.
    """

    views: Rig
    rows: tuple[int, ...]
    pictures: Pictures
    decision: Decision

    def for_texels(self) -> Rig:
        """Returns cameras as fine as the texels need to be: a quarter coarser than the pictures, or most pictures of
        0.1 mm a pixel would need four times as many texels."""
        return self.views.scaled(COARSER)


def read_close_views(
    read: ReadImage,
    mesh_world: Mesh,
    coloured: Texture,
    face: Bool[np.ndarray, " v"],
    *,
    sources: Mapping[str, str],
    chart: ChartColours | None = None,
) -> CloseViews:
    """Reads the pictures of the views that see most of the face, one after the other, and keeps what shows the head.

    ``read``: a picture at the size of its file. ``mesh_world``: the head. ``coloured``: with the gains and offsets of
    the cameras, and a decision. ``face``: vertices of the face. ``sources``: the name under which a camera's picture is
    filed, where that is another's. ``chart``: by which the colours of the pictures of work size were corrected.
    """
    decision = coloured.decision
    assert decision is not None, "the head has a texture"
    seen = decision.weights[:, face].sum(axis=1)
    rows = tuple(sorted(np.argsort(-seen, kind="stable")[:MAX_VIEWS].tolist()))
    cameras, crops = [], []
    for row in rows:
        camera = decision.views.cameras[row]
        close, crop = _head_of(camera, read(sources.get(camera.name, camera.name)), mesh_world)
        cameras.append(close)
        crops.append(crop if chart is None else in_true_colours(crop, chart.matrix_of(camera.name)))
    views = Rig(tuple(cameras))
    gains, offsets = (
        np.array([values.get(name, neutral) for name in views.names])
        for values, neutral in ((coloured.gains, (1.0,) * 3), (coloured.offsets, (0.0,) * 3))
    )
    masks = {camera.name: np.ones(crop.shape[:2], bool) for camera, crop in zip(views, crops, strict=True)}
    pictures = pack_pictures(views, crops, masks, gains, offsets, mesh_world=mesh_world)
    return CloseViews(views, rows, pictures, decision)


def _head_of(camera: Camera, image: ImageRgb, mesh: Mesh) -> tuple[Camera, UInt8[np.ndarray, "_ _ 3"]]:
    """Returns the camera of the rectangle around the head and a copy of that, so that the rest can be freed."""
    k = camera.intrinsics.at_size(image.shape[1], image.shape[0])
    pixels = project_points(replace(camera, intrinsics=k), mesh.vertices)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    size = np.array([k.width, k.height])
    low = np.clip(np.floor(pixels.min(axis=0)) - MARGIN_PX, 0, size - 1).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + MARGIN_PX, low + 1, size).astype(int)
    width, height = (high - low).tolist()
    lens = replace(k, width=width, height=height, cx=k.cx - float(low[0]), cy=k.cy - float(low[1]))
    return replace(camera, intrinsics=lens), image[low[1] : high[1], low[0] : high[0]].copy()


def plain_choice(
    views: Int32[np.ndarray, "v s"], shares: Float32[np.ndarray, "v s"], weights: Float32[np.ndarray, "k v"]
) -> Choice:
    """Returns the choice of these views without any correction of their colours."""
    nothing = np.zeros((*views.shape, 4), np.float32)
    grey = np.full((len(views), 4), GREY, np.float32)
    return Choice(views, shares, nothing, grey, np.ascontiguousarray(weights))


def mean_of(
    members: Bool[np.ndarray, " k"], weights: Float[np.ndarray, "k v"], most: int
) -> tuple[Int32[np.ndarray, "v s"], Float32[np.ndarray, "v s"]]:
    """Returns the ``most`` best of some views for each vertex (-1: none) and their shares in its mean."""
    allowed = np.where(members[:, None], weights, 0.0)
    order = np.argsort(-allowed, axis=0, kind="stable")[:most]
    chosen = np.take_along_axis(allowed, order, axis=0)
    shares = chosen / np.maximum(chosen.sum(axis=0), 1e-12)
    views = np.where(chosen > 0, order, -1)
    return np.ascontiguousarray(views.T, np.int32), np.ascontiguousarray(shares.T, np.float32)


def halves_of(close: CloseViews, world_from_head: Similarity) -> HalfPictures:
    """Returns two disjoint sets of views: every second one around the head, and the others."""
    towards = np.array([camera.centre_world for camera in close.views]) - world_from_head.translation
    in_head = towards @ world_from_head.rotation
    around = np.argsort(np.arctan2(in_head[:, 0], in_head[:, 2]), kind="stable")
    weights = close.decision.weights[list(close.rows)]
    choices = []
    for first in (0, 1):
        members = np.zeros(len(around), bool)
        members[around[first::2]] = True
        choices.append(plain_choice(*mean_of(members, weights, HALF_VIEWS), weights))
    return HalfPictures(close.pictures, _chosen(close.decision.pictures, close.rows), (choices[0], choices[1]))


def _chosen(pictures: Pictures, rows: tuple[int, ...]) -> Pictures:
    chosen = list(rows)
    return pictures._replace(
        first=pictures.first[chosen],
        width=pictures.width[chosen],
        height=pictures.height[chosen],
        places=np.ascontiguousarray(pictures.places[chosen]),
    )
