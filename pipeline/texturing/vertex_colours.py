"""Computes one colour for each vertex from the photographs (the paper's section 4.5).

The module takes the fitted mesh, the photographs and the silhouettes. The module returns a colour for each vertex, and
the number of images used. ``blend = "reference"`` is the paper's weighted mean: an image counts if the vertex projects
inside its silhouette and is not occluded. The image's weight is the dot product of normal and viewing direction.

The default blending also handles cameras that differ and edges that are blurred. The default blending leaves margins at
contours and occluding edges (``visibility``), sharpens photographs where they have detail, and corrects gain and offset
of each camera (``colour_balance``). The default blending averages in linear light, and gives little weight to a view
that differs from the others in any channel (a highlight, a shadow), and less to cameras with a large correction.

In head models whose eyes are openings, strips of triangles from lid to lid close the openings; the vertices of a strip
lie on the lids' hidden edges. A strip takes its colours from the one photograph that sees most of it.

Each vertex is labelled with one photograph, which gives the texture's detail there (Waechter, Moehrle and Goesele, *Let
There Be Color! Large-Scale Texturing of 3D Reconstructions*, ECCV 2014). The labels minimise a data term plus a Potts
term. The data term combines projected area and angle, the visibility of all neighbours, the difference of a view's
colour from the others, and the camera's correction. The Potts term is the cost of mesh edges between different labels.
The Potts term is highest where the views disagree, so seams avoid eyes and lips. Waechter et al. label triangles; here
vertices are labelled, and two photographs are blended in the triangles at a seam. Belief propagation minimises the sum
of both terms (Felzenszwalb and Huttenlocher, *Efficient Belief Propagation for Early Vision*, IJCV 2006).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.grid_kernels import component_of
from pipeline.geometry.projection import camera_depths
from pipeline.imaging.colour_balance import balance
from pipeline.imaging.silhouette import Silhouette
from pipeline.part_labels.codes import Part
from pipeline.settings import TextureSettings
from pipeline.texturing.neighbourhood import Neighbourhood, fill_unknown, level_views
from pipeline.texturing.paint_kernels import Pictures
from pipeline.texturing.view_selection_kernels import (
    NEVER,
    OUTLIER,
    best_candidates,
    blend_views,
    differences,
    fill_slots,
    propagate,
    ring_quality,
)
from pipeline.texturing.visibility import Decision, Sight, pack_pictures, see_points, see_weights, sharpen
from pipeline.warnings import ReportWarning
from rig.camera import Camera
from rig.capture import Capture
from rig.colour_space import srgb_from_linear
from rig.mesh import Mesh, face_normals
from rig.messages.message import compose, some_of
from rig.rig import Rig

MIN_LIKENESS = 0.62  # of the others' to each other: 0.73 and more in 33 clean captures, below 0.63 with an open jaw
AGREEING = 0.7  # correlation of the others, below which none can be judged by them: of spectacles before a face 0.65
MIN_SHARE = 0.28  # of a region, which a view must show to be compared: profiles show half, cameras behind a temple
SEEN = 0.2  # of the weight of the best view, with which another one shows a vertex
DARK = 0.02  # linear; noise below it is no likeness

Plane = Float32[np.ndarray, "k n"]
INNER = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6.0  # places in a triangle that are looked at
MIN_MM2 = 20.0  # of a patch: an open eye has 200, a fold of the skin less
MIN_SHOWN = 0.5  # of a triangle, in some view
MIN_SEEN = 0.4  # of the patch's area, in the view that it takes; lids hide its upper third from most
MAX_KNOWN = 0.5  # of the corners of its triangles, by area, that some view sees: beyond, it is no opening, but skin
BARELY = np.float32(1e-9)  # weight of a view at a corner that it does not see

REFERENCE_HIDDEN_MM = 1.5  # a vertex this far behind the nearest surface is hidden: a pixel's slope on a steep cheek
SURE_SHARE = 0.1  # of the median weight of what is seen: with less, blurred edges and background are in the colour
DOUBTFUL_MM2 = 1000.0  # of connected surface that no view shows surely; a nostril, which is dark, has a tenth
GUESS_SHARE = 0.35  # of the median weight: curls before a white wall made a guessed back of hair grey below it
GREY = 0.22  # linear: what a head gets that no camera saw
STRONG_GAIN = 1.5  # a camera that differs so much from the others has another exposure, and an operator should know
MIN_FACING = 0.2  # cosine to where the face looks: hair hangs before it otherwise, seen from behind the cheek
MIN_SKIN, MIN_MEAN_SKIN = 0.5, 0.7  # of a view, and of all: at a collar's soft edge single views are sure of skin
GAIN_HALVED = 1.0  # of the light, in powers of two: a camera that differs so much counts half

Weights = Float32[np.ndarray, "k v"]
Colours = Float32[np.ndarray, "k v 3"]
Points = Float[np.ndarray, "v 3"]
Faces = Int[np.ndarray, "f 3"]
Rgb = tuple[float, float, float]
DISAGREEMENT = 0.06  # of the colour's code: a view that differs so much from the others ...
OUTLIER_COST = 2.0  # ... has half of this cost, by that of a view that sees nothing
SEAM_COST = 0.15  # of an edge where views differ by ``DISAGREEMENT``
MAX_VIEWS = 4  # views whose mean is a position's detail ...
NOISE_FACTOR = 4.0  # ... where they differ from the chosen one by no more than this, by the median over the head
SWEEPS = 8  # of belief propagation
CANDIDATES = 6  # views of a vertex that come into question; a seventh is hardly ever the best
GAIN_COST = 1.0  # of a camera whose light was doubled or halved
NOISE_CODES = 2.0  # disagreement that noise makes in the dark


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """Holds the sRGB colour of each vertex, the number of photographs that it comes from (0: interpolated), and the
    gains and offsets of the cameras. ``dim`` is the linear colour of each vertex in its darker views."""

    colours: UInt8[np.ndarray, "v 3"]
    views: UInt8[np.ndarray, " v"]
    gains: Mapping[str, Rgb] = field(default_factory=dict)  # linear, by camera
    offsets: Mapping[str, Rgb] = field(default_factory=dict)
    decision: Decision | None = None  # where it was asked for
    dim: Float32[np.ndarray, "v 3"] | None = None  # linear, of a dim view of each vertex; where it was asked for
    warnings: tuple[ReportWarning, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """Holds what limits the use of each view: occluding hair, labelled parts, measured depth.

    Attributes:
        likely: the part (a code of ``Part``) of each vertex if no view sees it; ``HAIR`` is the scalp, bald or not.
        shares: gives for a camera the probabilities (0 to 1) of skin, hair and clothes at the chosen vertices.
        hairless: where the surface is bare skin, which hair may hide; None: hair belongs to the surface.
        face: where a pixel of no part shows a mouth or a nostril, and not the backdrop.
        measured: where depth agrees with the surface; None: everywhere.
        compared: regions of the face that look alike in all views of one moment.
        best_views: whether a vertex takes its detail from its best view if no mesh edges are given.
    """

    likely: UInt8[np.ndarray, " v"]
    shares: Callable[[Camera, Bool[np.ndarray, " v"]], Points]
    hairless: Bool[np.ndarray, " v"] | None = None
    face: Bool[np.ndarray, " v"] | None = None
    measured: Bool[np.ndarray, " v"] | None = None
    compared: tuple[Bool[np.ndarray, " v"], ...] = ()
    best_views: bool = False

    def weigh(self, weights: Weights, views: Rig) -> tuple[Weights, UInt8[np.ndarray, " v"]]:
        """Returns the views' weights, set to 0 where the surface is probably hidden, in a view or in the mean of all
        views; also returns the part (skin, hair or clothes) from which each unseen vertex takes its colour."""
        shares = np.zeros((*weights.shape, 3), np.float32)  # read where a view may colour
        for k, camera in enumerate(views):
            shares[k, weights[k] > 0] = self.shares(camera, weights[k] > 0)
        total = np.maximum(weights.sum(axis=0), 1e-9)
        scalp = self.likely == Part.HAIR
        hair = (weights * shares[..., Part.HAIR.channel]).sum(axis=0) / total
        seen = scalp & (weights > 0).any(axis=0)
        bare = seen & (hair < 0.5) if seen.any() and hair[seen].mean() > 0.5 else np.zeros(len(seen), bool)
        if self.hairless is not None:
            surface = shares[..., Part.SKIN.channel] + ~self.hairless * shares[..., Part.HAIR.channel]
            if self.face is not None:
                surface += self.face * (1.0 - shares.sum(axis=2))
            mean = (weights * surface).sum(axis=0) / total
            weights = weights * ((surface > MIN_SKIN) & (mean > MIN_MEAN_SKIN))
        return weights, np.where(bare, Part.SKIN, self.likely).astype(np.uint8)

    def find_guessed(self, weights: Weights) -> Bool[np.ndarray, " v"]:
        """Returns a mask of vertices where no depth was measured and views see the surface only near its contour."""
        total = weights.sum(axis=0)
        guessed = np.zeros(len(total), bool) if self.measured is None else ~self.measured
        return guessed & (total < GUESS_SHARE * np.median(total[total > 0]))

    def find_unlike(
        self, weights: Weights, balanced: Colours, mesh: Mesh, normals: Points, views: Rig
    ) -> list[ReportWarning]:
        """Returns a warning for each camera in front of the face whose picture of the face differs from the others."""
        if not self.compared:
            return []
        face = np.logical_or.reduce(self.compared)
        ahead, middle = normals[face].mean(axis=0), mesh.vertices[face].mean(axis=0)
        towards = np.stack([camera.centre_world for camera in views]) - middle
        cosines = towards @ ahead / np.linalg.norm(towards, axis=1) / np.linalg.norm(ahead)
        found = find_unlike(weights * (cosines > MIN_FACING)[:, None], balanced, self.compared)
        return [compose("view-unlike", camera=views.names[k], likeness=likeness) for k, likeness in found.items()]


@traced
def colour_vertices(
    mesh_world: Mesh,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    depths: Mapping[str, Float32[np.ndarray, "_ _"]],
    *,
    settings: TextureSettings,
    around: Neighbourhood | None = None,
    dim_share: float | None = None,
    outlier: float = OUTLIER,
    shown: Shown | None = None,
) -> Texture:
    """Computes the colour of each vertex from the photographs of the usable views. ``depths`` are the mesh's depth maps
    in these views (mm).

    With ``around``, the edges of the mesh, the result also has a ``decision``: the views chosen for each vertex. With
    ``dim_share``, the result also has each vertex's colour at that quantile of the views' brightness, which is free of
    highlights. A view counts half if it differs from the views' median by ``outlier``, relative to the median. With
    ``shown``, a view colours no vertex that something in front of the mesh hides.
    """
    views, normals = usable_views(capture, silhouettes, rig), mesh_world.normals()
    if settings.blend == "reference":
        return blend_as_paper(mesh_world, normals, capture, silhouettes, views, depths)
    if not len(views):
        return _untextured(len(normals))

    def read_view(camera: Camera) -> tuple[Sight, UInt8[np.ndarray, "_ _ 3"]]:
        silhouette = silhouettes[camera.name]
        image = sharpen(capture.images[camera.name], silhouette.mask, settings.sharpening)
        return see_points(camera, image, silhouette, depths[camera.name], mesh_world.vertices, normals), image

    sights, images = zip(*map_in_threads(lambda k: read_view(views.cameras[k]), len(views)), strict=True)
    weights, colours = (np.stack([getattr(sight, name) for sight in sights]) for name in ("weights", "colours"))
    del sights  # of a bust 36 MB
    hidden = np.asarray((weights > 0).any(axis=0))
    weights, parts = (weights, None) if shown is None else shown.weigh(weights, views)
    hidden &= ~(weights > 0).any(axis=0)
    unit = np.ones((len(views), 3)), np.zeros((len(views), 3))
    gains, offsets = balance(weights, colours) if settings.balance else unit
    weights *= (1.0 / (1.0 + (np.log2(gains.mean(axis=1)) / GAIN_HALVED) ** 2))[:, None]  # of noise, or in shadow
    balanced = colours * gains[:, None].astype(np.float32) + offsets[:, None].astype(np.float32)
    unlike = [] if shown is None else shown.find_unlike(weights, balanced, mesh_world, normals, views)
    agreed, seen = blend_views(weights, balanced, outlier)
    if not seen.any():
        return _untextured(len(seen))
    doubtful = wide_doubtful_surface(weights, mesh_world) | (False if shown is None else shown.find_guessed(weights))
    weights[:, doubtful], seen[doubtful], hidden = 0.0, 0, hidden | doubtful
    decision = None
    best = shown is not None and shown.best_views
    if around is not None or best:
        masks = {name: silhouettes[name].mask for name in views.names}
        pictures = pack_pictures(views, images, masks, gains, offsets, mesh_world=mesh_world)
        decision = decide(views, weights, balanced, agreed, gains, pictures, around=around)
        decision = decision if best else fill_unobserved_patches(decision, mesh_world, silhouettes, depths, hidden)
    whole = fill_unknown(agreed, seen > 0, mesh_world.faces, parts)
    codes, by_camera = np.rint(255 * srgb_from_linear(whole)).astype(np.uint8), _by_name(views, gains)
    dim = None if dim_share is None else underexposed_views(weights, balanced, dim_share)
    warnings = (*_gain_warnings(by_camera), *unlike)
    return Texture(codes, seen, by_camera, _by_name(views, offsets), decision, dim, warnings)


def wide_doubtful_surface(weights: Weights, mesh_world: Mesh) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the vertices on large regions that no view sees well, such as the back of a head in front of
    frontal cameras. The colours of these vertices are interpolated from other vertices."""
    total = weights.sum(axis=0)
    unsure = total < SURE_SHARE * np.median(total[total > 0])
    faces = mesh_world.faces[unsure[mesh_world.faces].all(axis=1)]
    part, normals = component_of(faces, len(total)), face_normals(mesh_world.vertices, faces)
    area_mm2 = np.bincount(part[faces[:, 0]], 0.5 * np.linalg.norm(normals, axis=1), minlength=len(total))
    return np.asarray(unsure & (area_mm2[part] > DOUBTFUL_MM2))


def underexposed_views(weights: Weights, colours: Colours, share: float) -> Float32[np.ndarray, "v 3"]:
    """Returns the linear colour of each vertex in one of its darker views: the weighted quantile ``share`` of the views
    by brightness. The colour is black where no view sees the vertex."""
    order = np.argsort(np.where(weights > 0, colours.sum(axis=2), np.inf), axis=0)
    passed = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    rank = np.argmax(passed >= share * passed[-1], axis=0)
    chosen = np.take_along_axis(order, rank[None], axis=0)[0]
    found = colours[chosen, np.arange(weights.shape[1])]
    return np.where((passed[-1] > 0)[:, None], found, np.float32(0.0))


def decide(
    views: Rig,
    weights: Weights,
    balanced: Colours,
    agreed: Points,
    gains: Float[np.ndarray, "k 3"],
    pictures: Pictures,
    *,
    around: Neighbourhood | None,
) -> Decision:
    """Chooses a view for each vertex, and computes the colour corrections that hide the seams between views. Without
    ``around`` (mesh edges), the view with the highest weight is chosen, and corrected to the views' mean colour."""
    if around is None:
        return take_best_views(views, weights, balanced, agreed, pictures)
    codes = (255 * srgb_from_linear(np.clip(balanced, 0, 1))).astype(np.float32)
    level_to = (255 * srgb_from_linear(np.clip(agreed, 0, 1))).astype(np.float32)
    fields = level_views(weights, codes, level_to, around)
    detail = codes + fields[:, :, :3]
    labels, options, quality = select_views(weights, codes, detail, level_to, gains, around=around)
    slots, shares = add_similar_views(labels, options, quality, detail, weights, around=around)
    corrections = fields[np.maximum(slots, 0), np.arange(len(slots))[:, None]]
    return Decision(views, slots, shares, corrections, weights, pictures)


def take_best_views(views: Rig, weights: Weights, balanced: Colours, agreed: Points, pictures: Pictures) -> Decision:
    """Chooses for each vertex the view with the highest weight, and corrects its colour to the mean of all views."""
    best, rows = weights.argmax(axis=0), np.arange(weights.shape[1])
    codes = [255 * srgb_from_linear(np.clip(each, 0, 1)) for each in (agreed, balanced[best, rows])]
    corrections = np.zeros((len(rows), 1, 4), np.float32)
    corrections[:, 0, :3] = codes[0] - codes[1]
    slots = np.where(weights[best, rows] > 0, best, -1)[:, None].astype(np.int32)
    return Decision(views, slots, np.ones(slots.shape, np.float32), corrections, weights, pictures)


def usable_views(capture: Capture, silhouettes: Mapping[str, Silhouette], rig: Rig) -> Rig:
    """Returns the cameras that have a photograph and a usable silhouette, and may therefore colour the head."""
    return rig.subset(name for name in rig.names if name in capture.images and silhouettes[name].quality.usable)


def _by_name(rig: Rig, values: Float[np.ndarray, "k 3"]) -> dict[str, Rgb]:
    return {name: (r, g, b) for name, (r, g, b) in zip(rig.names, values.tolist(), strict=True)}


def _gain_warnings(gains: Mapping[str, Rgb]) -> tuple[ReportWarning, ...]:
    """Returns one warning about all cameras whose pictures are brighter or darker than those of the others."""
    strong = {
        name: 1 / min(gain) for name, gain in gains.items() if max(gain) > STRONG_GAIN or min(gain) < 1 / STRONG_GAIN
    }
    if len(strong) < 2:
        return tuple(compose("camera-gain", camera=name, factor=factor) for name, factor in strong.items())
    least, most = min(strong.values()), max(strong.values())
    return (compose("cameras-uneven", cameras=some_of([*strong]), count=len(strong), least=least, most=most),)


def _untextured(count: int) -> Texture:
    code = round(255 * float(srgb_from_linear(np.array(GREY))))
    warning = compose("no-texture")
    return Texture(np.full((count, 3), code, np.uint8), np.zeros(count, np.uint8), warnings=(warning,))


def blend_as_paper(
    mesh: Mesh,
    normals: Points,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    depths: Mapping[str, Float32[np.ndarray, "_ _"]],
) -> Texture:
    """Colours vertices exactly as in the paper's section 4.5, in sRGB codes; interpolates unseen vertices."""
    from scipy.ndimage import map_coordinates  # for the paper's mean alone

    total, weights, views = np.zeros((len(normals), 3)), np.zeros(len(normals)), np.zeros(len(normals), np.uint8)
    for camera in rig:
        pixels, depth = camera.project(mesh.vertices), depths[camera.name]
        framed = np.all((pixels >= 0) & (pixels <= np.array(depth.shape[::-1]) - 1), axis=1)  # NaN is not
        columns, rows = np.rint(np.where(framed.reshape(-1, 1), pixels, 0.0)).astype(int).T
        free = camera_depths(camera, mesh.vertices) < depth[rows, columns] + REFERENCE_HIDDEN_MM
        towards = camera.centre_world - mesh.vertices
        facing = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
        seen = np.flatnonzero(framed & silhouettes[camera.name].mask[rows, columns] & free & (facing > 0.0))
        for channel in range(3):
            plane = capture.images[camera.name][:, :, channel].astype(float)
            total[seen, channel] += facing[seen] * map_coordinates(plane, pixels[seen, ::-1].T, order=1, mode="nearest")
        weights[seen] += facing[seen]
        views[seen] += 1
    known = weights > 0
    if not known.any():
        return _untextured(len(normals))
    colours = fill_unknown(total / np.where(known, weights, 1.0)[:, None], known, mesh.faces)
    return Texture(np.rint(colours).clip(0, 255).astype(np.uint8), views)


def fill_unobserved_patches(
    decision: Decision,
    mesh_world: Mesh,
    silhouettes: Mapping[str, Silhouette],
    depths: Mapping[str, Float32[np.ndarray, "_ _"]],
    hidden: Bool[np.ndarray, " v"] | None = None,
) -> Decision:
    """Adds a view to the decision for each wide patch of triangles whose corners no camera sees, such as a strip that
    closes an eye. Patches whose ``hidden`` corners lie behind hair or clothes are left out."""
    blind = ~(decision.weights > 0)[:, mesh_world.faces].all(axis=2).any(axis=0)  # no view sees all corners
    rows = np.flatnonzero(blind if hidden is None else blind & ~hidden[mesh_world.faces].any(axis=1))
    faces, normals, area = _parts(mesh_world, rows)
    rows = rows[_wide(faces, area)]
    if not len(rows):
        return decision
    faces, normals, area = _parts(mesh_world, rows)
    points = np.einsum("pk,fkx->fpx", INNER, mesh_world.vertices[faces]).reshape(-1, 3)
    facing = np.repeat(normals, len(INNER), axis=0)
    found = [see_weights(view, silhouettes[view.name], depths[view.name], points, facing) for view in decision.views]
    seen = np.stack(found).reshape(len(found), len(rows), len(INNER))
    shown = (seen > 0).mean(axis=2).max(axis=0) >= MIN_SHOWN  # the hidden side of a lid is blind as the eye is
    faces, area, seen = faces[shown], area[shown], seen[:, shown]
    wide = _wide(faces, area)
    return _taken(decision, faces[wide], area[wide], _patches(faces[wide]), seen[:, wide])


def _parts(mesh: Mesh, rows: Int[np.ndarray, " f"]) -> tuple[Faces, Float[np.ndarray, "f 3"], Float[np.ndarray, " f"]]:
    """Returns the unit normals, areas (mm2) and corners of the triangles ``rows``."""
    faces = mesh.faces[rows]
    normals = face_normals(mesh.vertices, faces)
    doubled = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    return faces, normals / doubled[:, None], 0.5 * doubled


def _wide(faces: Faces, area: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Returns a mask of the triangles that belong to large patches."""
    patch = _patches(faces)
    return np.bincount(patch, area)[patch] >= MIN_MM2 if len(faces) else np.zeros(0, bool)


def _taken(
    decision: Decision,
    faces: Faces,
    area: Float[np.ndarray, " f"],
    patch: Int[np.ndarray, " f"],
    seen: Float32[np.ndarray, "k f p"],
) -> Decision:
    slots, shares, weights = decision.slots.copy(), decision.shares.copy(), decision.weights.copy()
    known = np.any(decision.weights > 0, axis=0)[faces].mean(axis=1)
    for number in np.unique(patch):
        rows = np.flatnonzero(patch == number)
        share = ((seen[:, rows] > 0).mean(axis=2) * area[rows]).sum(axis=1) / area[rows].sum()
        if (known[rows] * area[rows]).sum() > MAX_KNOWN * area[rows].sum():
            continue
        worth = np.where(share >= MIN_SEEN, (seen[:, rows].mean(axis=2) * area[rows]).sum(axis=1), 0.0)
        best = int(worth.argmax())
        if worth[best] <= 0:
            continue
        corners = np.unique(faces[rows])
        weights[best, corners] = np.maximum(weights[best, corners], BARELY)
        unseen = corners[slots[corners, 0] < 0]
        slots[unseen, 0], shares[unseen, 0] = best, 1.0
    return replace(decision, slots=slots, shares=shares, weights=weights)


def _patches(faces: Faces) -> Int[np.ndarray, " f"]:
    """Returns the patch of each triangle: a patch is a set of triangles connected by corners."""
    return component_of(faces, int(faces.max(initial=-1)) + 1)[faces[:, 0]]


def select_views(
    weights: Float32[np.ndarray, "k v"],
    codes: Float32[np.ndarray, "k v 3"],
    levelled: Float32[np.ndarray, "k v 3"],
    agreed: Float32[np.ndarray, "v 3"],
    gains: Float[np.ndarray, "k 3"],
    *,
    around: Neighbourhood,
    seam_cost: float = SEAM_COST,
) -> tuple[Int32[np.ndarray, " v"], Int32[np.ndarray, "v c"], Float32[np.ndarray, "v c"]]:
    """Chooses a view for each vertex; -1 means that no view sees it. The function also returns the candidate views of
    each vertex and their quality.

    ``weights``: weights of the views by angle and distance, 0 = not seen. ``codes``: sRGB codes of every view at every
    vertex, gains applied. ``levelled``: these codes after the smooth corrections of
    ``pipeline.texturing.neighbourhood``. ``agreed``: mean codes of the views. ``gains``: gains of the cameras; their
    product is 1. ``around``: edges of the mesh. ``seam_cost``: cost of an edge between different views.
    """
    quality = ring_quality(weights, around.starts, around.indices)
    best = quality.max(axis=1, keepdims=True)
    costs = 1.0 - quality / np.maximum(best, 1e-12)
    off = np.maximum(_disagreement(codes, agreed), _disagreement(levelled, agreed))
    costs += OUTLIER_COST * off**2 / (1.0 + off**2)
    costs += GAIN_COST * np.abs(np.log2(gains.mean(axis=1)))
    costs = np.where(weights.T > 0, costs, NEVER).astype(np.float32)
    views, candidates = best_candidates(costs, min(CANDIDATES, len(weights)))
    share = np.where(weights.T > 0, quality, 0.0)
    spread = (share * off).sum(axis=1) / np.maximum(share.sum(axis=1), 1e-12)
    unlike = np.minimum(spread, 3.0)
    penalty = seam_cost * (0.3 + 0.5 * (unlike[around.rows] + unlike[around.indices]))
    chosen = propagate(
        views, candidates, around.starts, around.indices, around.opposite, penalty.astype(np.float32), len(weights),
        SWEEPS,
    )  # fmt: skip
    found = np.take_along_axis(views, np.maximum(chosen, 0)[:, None], axis=1)[:, 0]
    labels = np.where(chosen >= 0, found, -1).astype(np.int32)
    return labels, views, np.where(views >= 0, np.take_along_axis(quality, np.maximum(views, 0), axis=1), 0.0)


def _disagreement(
    codes: Float32[np.ndarray, "k v 3"], agreed: Float32[np.ndarray, "v 3"]
) -> Float32[np.ndarray, "v k"]:
    """Returns the colour difference of each view from the others at each vertex, relative to the usual difference."""
    off = (codes - agreed) / (DISAGREEMENT * agreed + NOISE_CODES)
    return np.sqrt(np.einsum("kvc,kvc->vk", off, off) / 3.0)


def add_similar_views(
    labels: Int32[np.ndarray, " v"],
    views: Int32[np.ndarray, "v c"],
    quality: Float32[np.ndarray, "v c"],
    detail: Float32[np.ndarray, "k v 3"],
    weights: Float32[np.ndarray, "k v"],
    *,
    around: Neighbourhood,
) -> tuple[Int32[np.ndarray, "v s"], Float32[np.ndarray, "v s"]]:
    """Adds to the chosen view of each vertex the views that differ from it only by noise, since a mean has less noise.
    Views that differ by more (often at eyes, brows and lips) are left out, since blending them would blur the texture.

    Args:
        labels: the chosen view of each vertex, -1 = none.
        views: the candidate views of each vertex.
        quality: of the candidate views.
        detail: sRGB codes of the levelled views.
        weights: how well each view sees each vertex; 0 = not seen.
        around: the mesh's edges.

    Returns:
        Views (-1: none) and their shares in the mean, the chosen one first.
    """
    off = differences(labels, views, detail, weights, around.starts, around.indices)
    informative = off[(off >= 0) & (views != labels[:, None])]
    noise = max(float(np.median(informative)), 0.25) if len(informative) else 1.0
    best = np.maximum(quality.max(axis=1, keepdims=True), 1e-12)
    shares = (quality / best) * np.exp(-np.maximum(off / (NOISE_FACTOR * noise) - 1.0, 0.0))
    shares = np.where((off >= 0) & (labels[:, None] >= 0), shares, 0.0).astype(np.float32)
    return fill_slots(labels, views, shares, MAX_VIEWS)


def find_unlike(
    weights: Plane, colours: Float32[np.ndarray, "k n 3"], regions: Sequence[Bool[np.ndarray, " n"]]
) -> dict[int, float]:
    """Returns the views (row indices) in which the face differs from the other views, each with its correlation to
    them. A differing view is left out before the next search. With only two views no view is reported. Views of the
    same moment differ only by gloss and shading (correlation 0.9 to 1.0). A mouth that is open in one view gives 0.2 to
    0.6, another person -0.5 to 0.3.

    ``weights``: of each view at each vertex, 0 where it does not show the face. ``colours``: linear, cameras balanced.
    """
    level = np.log(np.maximum(colours.mean(axis=2), 0.0) + DARK)
    left, found = list(range(len(weights))), dict[int, float]()
    while len(left) > 2:
        odd = min(_judge(weights[left][:, region], level[left][:, region]) for region in regions)
        if odd[0] >= MIN_LIKENESS:
            break
        found[left.pop(odd[2])] = odd[1]
    return found


def _judge(weights: Plane, level: Plane) -> tuple[float, float, int]:
    """Finds the view least like the others. Returns this view's relative correlation, correlation and row."""
    alike = _likeness(weights, level)
    if np.isnan(alike).all():
        return np.inf, np.nan, 0
    odd = int(np.nanargmin(alike))
    rest = _likeness(np.delete(weights, odd, axis=0), np.delete(level, odd, axis=0))
    agreeing = float(np.nanmedian(rest)) if np.isfinite(rest).any() else 0.0
    return float(alike[odd]) / agreeing if agreeing > AGREEING else np.inf, float(alike[odd]), odd


def _likeness(weights: Plane, level: Plane) -> Float[np.ndarray, " k"]:
    """Returns the correlation of each view's brightness with the others' mean; NaN if it sees too few vertices."""
    total, weighted, best = weights.sum(axis=0), (weights * level).sum(axis=0), weights.max(axis=0)
    found = np.full(len(weights), np.nan)
    for k, weight in enumerate(weights):
        others = total - weight
        both = (weight > SEEN * best) & (others > SEEN * best)
        if not both.any() or both.sum() < MIN_SHARE * np.count_nonzero(best):
            continue
        shared = np.minimum(weight, others)[both]
        mean = (weighted - weight * level[k])[both] / others[both]
        one, two = (each - np.average(each, weights=shared) for each in (level[k, both], mean))
        spread = float((shared * one**2).sum() * (shared * two**2).sum())
        found[k] = float((shared * one * two).sum()) / max(np.sqrt(spread), 1e-9)
    return found
