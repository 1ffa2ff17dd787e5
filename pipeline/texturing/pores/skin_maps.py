"""Makes the displacement map and the normal map of a head's skin, with the texture's UV layout.

Displacement is along the interpolated normals of head.ply; one code is ``MM_PER_CODE``, and ``MID_CODE`` means no
displacement. Normals are in glTF's tangent frame: x along the tangent, y up in the image, z along the normal.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, Int32, UInt8, UInt16

from pipeline.compute.threads import map_strips
from pipeline.compute.trace import traced
from pipeline.geometry.projection import project_points
from pipeline.texturing.chart_colours import CODES, ENCODED, ChartColours, correct_picture
from pipeline.texturing.layout.uv_unwrap import Atlas, ModelLayout
from pipeline.texturing.light import fit_light, transfer
from pipeline.texturing.paint_kernels import Choice, Pictures
from pipeline.texturing.pores.relief import MIN_SKIN, HalfPictures, Strips, TexelFrames, compute_frames, estimate_detail
from pipeline.texturing.vertex_colours import Texture
from pipeline.texturing.visibility import LINEAR, Decision, pack_pictures
from rig.camera import Camera
from rig.capture import ReadImage
from rig.colour_space import linear_from_srgb
from rig.geometry import Similarity
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.rig import Rig

MAX_VIEWS = 12  # read: of 24 Mpx they take 0.4 GB, of 45 Mpx 0.8 GB, as much again while they are packed
MARGIN_PX = 8
COARSER = 0.8  # texels are that much coarser than pictures: of 0.1 mm a pixel most would need four times as many
HALF_VIEWS = 2  # in the mean of each of two sets: more blur, for errors of the geometry
GREY = 128.0  # code of what no view shows: the same in both pictures, so that it adds nothing
MM_PER_CODE = 1.0 / 65536  # from -0.5 to 0.5 mm: deeper than any pore
MID_CODE = 32768
STRIP_ROWS = 128


@dataclass(frozen=True, slots=True, eq=False)
class CloseViews:
    """Holds the full-size pictures of some views, packed into one array.

    Attributes:
        views: cameras of the cropped pictures.
        rows: indices of these views in the ``decision``.
        pictures: packed as those of work size.
        decision: which views of work size colour each vertex.
    """

    views: Rig
    rows: tuple[int, ...]
    pictures: Pictures
    decision: Decision


def read_close_views(
    read: ReadImage,
    mesh_world: Mesh,
    coloured: Texture,
    face: Bool[np.ndarray, " v"],
    *,
    sources: Mapping[str, str],
    chart: ChartColours | None = None,
) -> CloseViews:
    """Reads the full-size pictures of the views that see most of the face, and crops them to the head.

    ``read``: function that returns a camera's picture at full size. ``mesh_world``: the head. ``coloured``: holds the
    cameras' gains and offsets, and the chosen views. ``face``: vertices of the face. ``sources``: if pictures were
    exchanged, the camera name under which each camera's picture is filed. ``chart``: colour corrections by a chart.
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
        crops.append(crop if chart is None else correct_picture(crop, chart.matrix_of(camera.name)))
    views = Rig(tuple(cameras))
    gains, offsets = (
        np.array([values.get(name, neutral) for name in views.names])
        for values, neutral in ((coloured.gains, (1.0,) * 3), (coloured.offsets, (0.0,) * 3))
    )
    masks = {camera.name: np.ones(crop.shape[:2], bool) for camera, crop in zip(views, crops, strict=True)}
    pictures = pack_pictures(views, crops, masks, gains, offsets, mesh_world=mesh_world)
    return CloseViews(views, rows, pictures, decision)


def _head_of(camera: Camera, image: ImageRgb, mesh: Mesh) -> tuple[Camera, UInt8[np.ndarray, "_ _ 3"]]:
    """Crops a picture to the head. Returns the crop's camera, and a copy of its pixels, which frees the picture."""
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
    """Packs views and their shares for the compiled loops, without colour corrections."""
    nothing = np.zeros((*views.shape, 4), np.float32)
    grey = np.full((len(views), 4), GREY, np.float32)
    return Choice(views, shares, nothing, grey, np.ascontiguousarray(weights))


def mean_of(
    members: Bool[np.ndarray, " k"], weights: Float[np.ndarray, "k v"], most: int
) -> tuple[Int32[np.ndarray, "v s"], Float32[np.ndarray, "v s"]]:
    """Returns the ``most`` views of highest weight among ``members`` at each vertex (-1: none), and their shares."""
    allowed = np.where(members[:, None], weights, 0.0)
    order = np.argsort(-allowed, axis=0, kind="stable")[:most]
    chosen = np.take_along_axis(allowed, order, axis=0)
    shares = chosen / np.maximum(chosen.sum(axis=0), 1e-12)
    views = np.where(chosen > 0, order, -1)
    return np.ascontiguousarray(views.T, np.int32), np.ascontiguousarray(shares.T, np.float32)


def halve(close: CloseViews, world_from_head: Similarity) -> HalfPictures:
    """Divides the views into two disjoint sets, alternating in their order around the head."""
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


@dataclass(frozen=True, slots=True, eq=False)
class SkinMaps:
    """Holds the maps of a head's skin.

    Attributes:
        displacement: codes (``MM_PER_CODE``, ``MID_CODE``), along the normals.
        normals: codes of the unit normals in the tangent frame.
        repeated: share of the shading's power that two disjoint sets of views both show, by octave of wavelength from
            the longest.
        views: cameras whose full-size pictures were read.
    """

    displacement: UInt16[np.ndarray, "s s"]
    normals: UInt8[np.ndarray, "s s 3"]
    repeated: tuple[float, ...]
    views: tuple[str, ...]


@traced
def map_skin(
    layout: ModelLayout,
    atlas: Atlas,
    mesh_world: Mesh,
    normals: Float[np.ndarray, "v 3"],
    coloured: Texture,
    close: CloseViews,
    *,
    face: Bool[np.ndarray, " v"],
    skin: Float[np.ndarray, " v"],
    world_from_head: Similarity,
) -> tuple[SkinMaps, Atlas]:
    """Returns displacement and normal maps of the skin from full-size pictures, and the texture with their detail.

    ``layout``: UV layout of the head. ``atlas``: texture of the head, which sets the size of the maps. ``mesh_world``:
    the head (mm). ``normals``: unit normals of its vertices. ``coloured``: colours of the vertices. ``close``: the
    full-size pictures. ``face``: vertices from whose shading the light is estimated. ``skin``: probability that a
    vertex shows skin. ``world_from_head``: pose of the head.
    """
    white = transfer(mesh_world, normals, layout.around)
    light = fit_light(white, linear_from_srgb(coloured.colours / 255.0), (coloured.views > 0) & face)
    grey = np.zeros(9) if light is None else light.coefficients.mean(axis=1)
    frames = compute_frames(layout.layout, mesh_world, normals, grey, white @ grey, skin)
    size = len(atlas.image)
    found = estimate_detail(Strips.of(layout.layout, size, skin >= MIN_SKIN), halve(close, world_from_head), frames)
    displacement: UInt16[np.ndarray, "s s"] = np.empty((size, size), np.uint16)
    drawn: UInt8[np.ndarray, "s s 3"] = np.empty((size, size, 3), np.uint8)

    def work(rows: slice) -> None:
        displacement[rows] = codes_of(found.heights_mm[rows])
        drawn[rows] = normal_codes(found.heights_mm, rows, frames)

    map_strips(work, size, STRIP_ROWS)
    maps = SkinMaps(displacement, drawn, found.repeated, close.views.names)
    return maps, sharpen_atlas(atlas, found.brightness)


def codes_of(heights_mm: Float32[np.ndarray, "r s"]) -> UInt16[np.ndarray, "r s"]:
    """Converts heights to codes of the displacement map."""
    return np.clip(np.rint(heights_mm / np.float32(MM_PER_CODE)) + MID_CODE, 0, 65535).astype(np.uint16)


def normal_codes(
    heights_mm: Float32[np.ndarray, "s s"], rows: slice, frames: TexelFrames
) -> UInt8[np.ndarray, "r s 3"]:
    """Computes the image rows ``rows`` of the normal map from the relief's heights."""
    size = heights_mm.shape[1]
    low, high = max(rows.start - 1, 0), min(rows.stop + 1, size)
    by_row = np.gradient(heights_mm[low:high], axis=0) if high - low > 1 else np.zeros_like(heights_mm[low:high])
    down = by_row[rows.start - low : rows.stop - low] * size
    across = np.gradient(heights_mm[rows], axis=1) * size
    x, y = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(rows.start, rows.stop) + 0.5) / size)
    metric = frames.at(frames.metric, x, y)
    along = np.sqrt(np.maximum(metric[:, :, 0], 1e-9))  # mm for u from 0 to 1
    lean = metric[:, :, 1] / along
    beside = np.sqrt(np.maximum(metric[:, :, 2] - lean**2, 1e-9))
    tangent = across / along
    bitangent = (lean * tangent - down) / beside  # up in the image: against v
    normal = np.stack([-tangent, -bitangent, np.ones_like(tangent)], axis=2)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    return np.rint(127.5 + 127.5 * normal).astype(np.uint8)


def skin_share(
    decision: Decision, mesh_world: Mesh, probability: Mapping[str, Float32[np.ndarray, "_ _"]]
) -> Float[np.ndarray, " v"]:
    """Returns the probability that each vertex shows skin: the mean over the views that see it."""
    total, weights = np.zeros(len(mesh_world.vertices)), np.zeros(len(mesh_world.vertices))
    for camera, weight in zip(decision.views, decision.weights, strict=True):
        if camera.name not in probability:
            continue
        skin, seen = probability[camera.name], np.flatnonzero(weight > 0)
        height, width = skin.shape
        pixels = project_points(camera, mesh_world.vertices[seen])
        column, row = np.clip(np.rint(pixels), 0, (width - 1, height - 1)).astype(int).T
        total[seen] += weight[seen] * skin[row, column]
        weights[seen] += weight[seen]
    return total / np.maximum(weights, 1e-12)


def sharpen_atlas(atlas: Atlas, brightness: Float16[np.ndarray, "s s"]) -> Atlas:
    """Multiplies the linear light of a texture by the exponential of ``brightness``."""
    size = len(atlas.image)
    stored: UInt8[np.ndarray, "s s 3"] = np.empty((size, size, 3), np.uint8)  # blue first, as the painter's

    def work(rows: slice) -> None:
        light = LINEAR[atlas.image[rows, :, ::-1]] * np.exp(brightness[rows].astype(np.float32))[:, :, None]
        stored[rows] = ENCODED[(CODES * np.minimum(light, 1.0) + 0.5).astype(np.int32)]

    map_strips(work, size, STRIP_ROWS)
    return Atlas(atlas.layout, stored[:, :, ::-1])
