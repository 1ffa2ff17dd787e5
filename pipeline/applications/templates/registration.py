"""Registers another program's mesh to a head model once, so that the mesh can deform with fitted heads.

The head model is fitted to the mesh as closely as possible (``fit_model_to_mesh``). After this placement
``geometry.registration.nonrigid`` deforms the mesh's skin onto the fitted head, so that the difference between mesh and
fitted head does not appear in results. Finally, every skin vertex gets its point on the head model's surface, and
deeper vertices follow the skin (``carrying``)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from pipeline.applications.templates.carrying import Attachment, SurfaceBinding, bind_vertices, surface_binding
from pipeline.applications.templates.likeness import CANDIDATES, Likeness, SurfaceMarks, fit_model_to_mesh
from pipeline.applications.templates.placement import Surface, find_place, outward, place_by_landmarks
from pipeline.geometry.registration.nonrigid import Search, Target, draw_to_target, warp_by_landmarks
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.gaussian_process import spread_nodes
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import vertex_areas
from rig.errors import InputError
from rig.formats.meshes.polygon_obj import PolygonMesh
from rig.mesh import boundary_edges, vertex_normals
from rig.messages.message import compose
from rig.progress import Progress

Flags = Bool[np.ndarray, " t"]
Vertices = Float[np.ndarray, "t 3"]

DRAWN = Search(steps=0, reach_mm=5.0, normal_mm=2.0, plane_mm=0.0)
MARK_WEIGHT = 30.0  # of a landmark, beside 1 of a vertex that meets the head: it must move its neighbours along
STIFFNESS = (10.0, 3.0, 1.0, 0.5, 0.2, 0.05, 0.05)
SKIN_SHARE = 0.02  # of the model's area that a part of the mesh must show to be skin ...
SKIN_REACH_MM = 15.0  # ... no farther than this from the model's mean head
ROUND = 0.6  # shortest by longest axis of a closed part that moves as a whole: eyeballs, no teeth
OFF_MM, FACING = 1.5, 0.4  # a vertex farther off the skin, or facing away from it, lies deeper
PATCH_SHARE = 0.005  # of the skin: smaller patches of it, alone among what lies deeper, are none
TEST_HEADS = 6
EDGE_RINGS = 2
PARTING_MM = 0.7  # between a vertex and the middle of its neighbours, on another head: 3 sigma of 3 mm edges on skin
COVERED_SHARE = 0.5  # of the model's face region that the mesh must show
STRANGE = 4.0  # standard deviations: ICT-FaceKit's mean is 2.2 from the default's, and a ball 5.0
LIKE_MM = 2.0  # median distance of the fitted face from the mesh


class NotRegistered(InputError):
    """Reports a mesh that cannot be registered, with reasons and remedies."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Holds a mesh bound to a head model's surface, and figures that measure how well it fits."""

    surface_binding: SurfaceBinding
    placed: Vertices  # the mesh at its first place in the head frame, in its own shape, mm
    head: Float[np.ndarray, "v 3"]  # the model fitted to it, finest mesh, mm
    off_mm: Float[np.ndarray, " n"]  # distance of the skin from that head after the deformation
    unlike_mm: Float[np.ndarray, " n"]  # the same before the deformation
    covered: float  # share of the model's face region that the mesh shows

    def figures(self) -> dict[str, float]:
        """Returns the figures of the registration by name, for printing."""
        return {
            "vertices": float(len(self.surface_binding.rest)),
            "skin_share": len(self.surface_binding.skin) / len(self.surface_binding.rest),
            "off_median_mm": float(np.median(self.off_mm)),
            "off_p95_mm": float(np.percentile(self.off_mm, 95)),
            "unlike_median_mm": float(np.median(self.unlike_mm)),
            "unlike_p95_mm": float(np.percentile(self.unlike_mm, 95)),
            "face_covered_share": self.covered,
        }


def register(
    mesh: PolygonMesh,
    model: HeadModel,
    *,
    name: str,
    landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    report: Progress,
) -> Registration:
    """Registers a mesh to a head model: places the mesh, fits the model to it, deforms the mesh onto the fitted head,
    and binds it.

    ``mesh``: in any unit and with any axes. ``model``: the head model. ``name``: name of the mesh, for messages.
    ``landmarks``: landmarks in the mesh's frame; None searches for the placement. ``report``: progress.

    Raises InputError if the mesh is no head, and NotRegistered if the head model cannot follow its shape."""
    report("placing", 0.0)
    surface = outward(mesh.vertices, mesh.triangles())
    place = place_by_landmarks(model, landmarks, name) if landmarks else find_place(model, surface, name)
    placed = surface.placed(place)
    welded, joined = weld(placed)
    parts = components(welded)
    faces = model.levels["full"].faces
    skin = skin_parts(welded, parts, Surface.of(model.vertices(np.zeros(0)), faces))
    report("likeness", 0.2)
    marks = {mark: place.apply(point) for mark, point in (landmarks or {}).items() if mark in model.landmarks}
    like = fit_model_to_mesh(model, welded, SurfaceMarks.of_landmarks(model, marks))
    covered = _check(like, name, marked=bool(landmarks))
    head = Surface.of(like.vertices, faces)
    report("drawing", 0.7)
    pairs = {mark: (point, head.vertices[model.landmarks[mark]]) for mark, point in marks.items()}
    rest = _drawn(welded, skin[parts], head, list(pairs.values()))
    attachment, off, facing = bind_vertices(rest, vertex_normals(rest, welded.faces), head.vertices, faces)
    on_skin = skin[parts] & (off < OFF_MM) & (facing > FACING) & _used(welded)
    on_skin &= ~parting(attachment, rest, on_skin, welded.faces, model)
    on_skin = without_specks(without_edge(on_skin, welded.faces), welded.faces)
    if not on_skin.any():
        raise NotRegistered(name, [compose("template-off-skin")])
    rest = _followed(welded.vertices, rest, on_skin)
    rows = np.flatnonzero(on_skin[joined])
    at = joined[rows]
    attached = Attachment(attachment.triangles[at], attachment.weights[at], attachment.offsets[at])
    carried = surface_binding(rest[joined], rows, attached, balls(welded, parts, ~skin)[joined])
    unlike = SurfaceIndex(head.vertices, faces).closest(placed.vertices[rows], CANDIDATES).distances
    report("drawing", 1.0)
    return Registration(carried, placed.vertices, head.vertices, off[joined[rows]], unlike, covered)


def _check(like: Likeness, name: str, *, marked: bool) -> float:
    """Returns the fraction of the face region's area that the mesh covers. Raises NotRegistered if the fraction is too
    small or the shape too unusual; with landmarks an unusual shape is allowed."""
    met, area = np.isfinite(like.distances), np.where(like.in_face, like.areas, 0.0)
    covered = float(area[met].sum() / area.sum())
    faults = []
    if covered < COVERED_SHARE:
        faults.append(compose("template-shows-little", share=covered, needed=COVERED_SHARE))
    face = like.distances[met & like.in_face]
    if len(face) and np.median(face) > LIKE_MM:
        faults.append(compose("template-off-all-faces", off_mm=np.median(face)))
    if like.deviation > STRANGE and not marked:
        faults.append(compose("template-far-from-mean", sigmas=like.deviation))
    if faults:
        raise NotRegistered(name, [*faults, compose("template-give-landmarks")])
    return covered


def weld(mesh: Surface) -> tuple[Surface, Int[np.ndarray, " t"]]:
    """Joins vertices at the same position along open borders, because mesh files cut surfaces along texture seams.
    Returns the mesh and the new index of each old vertex.

    Lashes remain separate parts, because the lid has no border at their roots."""
    ends = np.zeros(len(mesh.vertices), bool)
    ends[boundary_edges(mesh.faces)] = True
    identity = np.where(ends, -1, np.arange(len(ends)))[:, None]
    _, first, joined = np.unique(
        np.concatenate([mesh.vertices + 0.0, identity], axis=1), axis=0, return_index=True, return_inverse=True
    )
    joined = joined.ravel()
    faces, vertices = joined[mesh.faces].astype(np.int32), mesh.vertices[first]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return Surface.of(vertices, faces), joined


def components(mesh: Surface) -> Int[np.ndarray, " t"]:
    """Returns the index of the connected part to which each vertex belongs."""
    return connected_components(_graph(mesh.faces, len(mesh.vertices)), directed=False)[1]


def _graph(faces: Int[np.ndarray, "f 3"], count: int) -> sparse.csr_array:
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return sparse.csr_array((np.ones(len(pairs), np.int32), (pairs[:, 0], pairs[:, 1])), shape=(count, count))


def skin_parts(mesh: Surface, parts: Int[np.ndarray, " t"], head: Surface) -> Bool[np.ndarray, " p"]:
    """Returns a mask of the mesh's connected parts that are skin: a large enough fraction of their area is near the
    head and faces the same way."""
    rows = slice(None, None, max(1, len(head.vertices) // 6000))
    hits = SurfaceIndex(mesh.vertices, mesh.faces).closest(head.vertices[rows], CANDIDATES, facing=head.normals[rows])
    part = parts[mesh.faces[hits.triangles, 0]]
    met = np.where(hits.distances < SKIN_REACH_MM, vertex_areas(head.vertices, head.faces)[rows], 0.0)
    shown = np.bincount(part, met, minlength=int(parts.max()) + 1)
    return shown > SKIN_SHARE * shown.sum()


def balls(mesh: Surface, parts: Int[np.ndarray, " t"], among: Bool[np.ndarray, " p"]) -> Int[np.ndarray, " t"]:
    """Returns, for each vertex, the index of its closed, round part (such as an eyeball) out of the parts ``among``; -1
    for all other vertices."""
    closed = among.copy()
    closed[parts[boundary_edges(mesh.faces).ravel()]] = False
    closed[parts[~_used(mesh)]] = False
    for part in np.flatnonzero(closed):
        axes = np.linalg.svd(mesh.vertices[parts == part] - mesh.vertices[parts == part].mean(axis=0), compute_uv=False)
        closed[part] = axes[-1] > ROUND * axes[0]
    number = np.where(closed, np.cumsum(closed) - 1, -1)
    return number[parts]


def _used(mesh: Surface) -> Flags:
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    return used


def parting(
    attachment: Attachment, rest: Vertices, skin: Flags, faces: Int[np.ndarray, "f 3"], model: HeadModel
) -> Flags:
    """Returns a mask of the vertices that move away from their neighbours on at least one random head. A vertex that
    moves away was attached to the wrong layer of the surface, such as the inside of a lid or the eyeball."""
    graph = _graph(faces[skin[faces].all(axis=1)], len(rest))
    graph = sparse.csr_array(((graph + graph.T) > 0).astype(float))
    degree = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1.0)[:, None]
    rng, full = np.random.default_rng(0), model.levels["full"].faces
    heads = [np.zeros(0), *rng.standard_normal((TEST_HEADS, len(model.modes)))]
    moves = [attachment.on(model.vertices(z), full) - rest for z in heads]
    reach = np.linalg.norm(graph @ rest / degree - rest, axis=1)
    apart = np.max([np.linalg.norm(graph @ move / degree - move, axis=1) for move in moves], axis=0)
    return skin & (apart > PARTING_MM + reach)


def without_edge(skin: Flags, faces: Int[np.ndarray, "f 3"]) -> Flags:
    """Returns the mask of skin vertices without those next to deeper parts. Where a lid turns inwards, vertices at the
    edge of the skin match the head model's lid only by chance, so deeper parts would follow the skin unevenly."""
    out = skin.copy()
    for _ in range(EDGE_RINGS):
        out[faces[~out[faces].all(axis=1)]] = False
    return out


def without_specks(mask: Flags, faces: Int[np.ndarray, "f 3"]) -> Flags:
    """Returns the mask without its small connected patches."""
    inside = faces[mask[faces].all(axis=1)]
    _, patch = connected_components(_graph(inside, len(mask)), directed=False)
    size = np.bincount(patch[mask], minlength=int(patch.max()) + 1)
    return mask & (size[patch] > PATCH_SHARE * mask.sum())


def _drawn(mesh: Surface, skin: Flags, head: Surface, marks: Sequence[tuple[np.ndarray, np.ndarray]]) -> Vertices:
    """Returns the mesh's vertices after its skin was deformed onto the head, and its landmarks onto the head's
    landmarks; other parts do not move."""
    rows = np.flatnonzero(skin)
    place = np.full(len(skin), -1)
    place[rows] = np.arange(len(rows))
    faces = place[mesh.faces[skin[mesh.faces].all(axis=1)]]
    target = Target(head.vertices, head.normals, np.zeros((0, 3)))
    out = mesh.vertices.copy()
    vertices = mesh.vertices[rows]
    pulled = {}
    for here, there in marks:
        nearest = int(np.linalg.norm(vertices - here, axis=1).argmin())
        pulled[nearest] = there + vertices[nearest] - here
    out[rows] = draw_to_target(vertices, faces, target, DRAWN, STIFFNESS, marks=pulled, mark_weight=MARK_WEIGHT)
    return out


def _followed(before: Vertices, after: Vertices, skin: Flags) -> Vertices:
    """Returns ``after`` for skin vertices; other vertices move from ``before`` smoothly with the skin around them."""
    rows = np.flatnonzero(skin)
    rows = rows[spread_nodes(before[rows], min(400, len(rows)))]
    out = after.copy()
    out[~skin] = warp_by_landmarks(before[rows], after[rows], before[~skin])
    return out
