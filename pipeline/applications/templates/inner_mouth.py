"""Adds teeth and a tongue behind the lips of a mesh that has none, and moves them with the mesh's jaw. Lips must not
touch the teeth or the tongue.

A similarity transform between mouth landmarks places the shipped teeth and tongue (``load_inner_mouth``) in the
person's head. Teeth and tongue are then moved back until no lip touches them, with the mouth shut or open. Upper teeth
stay with the skull; lower teeth and tongue move with the jaw (``pivots.jaw_motions``). Where a blendshape would press
lips through the teeth, the lips are lifted, as lids are lifted off eyeballs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree

from pipeline.applications.templates.eyeballs import sample_triangles
from pipeline.applications.templates.pivots import Points
from pipeline.fusion.crossings import crossing_faces
from pipeline.geometry.registration.rigid import procrustes
from pipeline.head_model.expressions import VISEMES, mixed
from rig.geometry import RigidTransform
from rig.mesh import Mesh

Places = Float[np.ndarray, "t 3"]

PACK = Path(__file__).parents[2] / "head_model" / "packs" / "inner_mouth.npz"
PARTS = ("teeth_upper", "teeth_lower", "tongue")
ANCHORS = (
    "subnasale", "labiale_superius", "stomion", "labiale_inferius", "sublabiale", "pogonion", "gnathion",
    "cheilion_right", "cheilion_left", "gonion_right", "gonion_left",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class InnerPart:
    """Holds teeth or a tongue, and the part's displacement when the tongue is out (mm; empty if it does not move)."""

    mesh: Mesh
    tongue_out: Float[np.ndarray, "n 3"]


@lru_cache(maxsize=1)
def load_inner_mouth() -> tuple[dict[str, InnerPart], Mapping[str, Float[np.ndarray, " 3"]]]:
    """Returns the shipped teeth and tongue by name, and the landmarks of the head for which they were made."""
    with np.load(PACK) as file:
        parts = {}
        for name in PARTS:
            vertices = file[f"{name}_vertices"].astype(float)
            mesh = Mesh(vertices, file[f"{name}_faces"].astype(np.int32), file[f"{name}_colours"])
            parts[name] = InnerPart(mesh, file[f"{name}_tongue_out"].astype(float))
        return parts, dict(zip(ANCHORS, file["anchors"].astype(float), strict=True))


ABOUT_MM = 25.0  # around the teeth, within which the mesh is tested: shapes may move it there
BACK_MM, STEP_MM = 10.0, 1.0  # how far the parts are moved back until lips are free
SPARE_MM = 0.5  # by which they are moved back once more
OPENING = (0.0, 0.5, 1.0)  # weights of jawOpen at which parts must be free of the mesh
GAP_MM = 0.4  # between lips and teeth in a shape that presses them together
DEEP_MM = 10.0  # behind the teeth's front, a point is in the mouth, not in a tooth
SHADE_MM = 40.0  # behind the lips, where the light of DEEP_LIGHT is left
DEEP_LIGHT = 0.15  # of the light at the lips
WEIGHTS = (0.5, 1.0)
STILL_MM = 0.05  # shapes that move the mouth less are not corrected
ROUNDS = 20
NUDGE_MM = 0.3  # a round, for what meets teeth although its corners and middles do not
SPREAD_MM = 5.0  # over which a lip that is lifted takes along what lies about: lips are some 10 mm thick
TURN_DEG, RISE_MM = 2.0, 1.0  # cells of the teeth's front
TEETH = ("teeth_upper", "teeth_lower")
WITH_JAW = ("teeth_lower", "tongue")
TONGUE_OUT = "tongueOut"
OPENED = ("mouthClose", TONGUE_OUT)  # shapes that are meant for an open jaw: as far as they are, and wholly
Absence = Literal["own-parts", "mouth-sealed", "no-room"]
Shapes = Mapping[str, Places]


@dataclass(frozen=True, slots=True, eq=False)
class InnerMouth:
    """Holds teeth and tongue without expression by name (head frame, mm), and their displacements by blendshape,
    without blendshapes that do not move them. ``absence`` is the reason if there are no teeth and tongue."""

    parts: Mapping[str, Mesh] = field(default_factory=dict)
    moves: Mapping[str, Mapping[str, Float[np.ndarray, "n 3"]]] = field(default_factory=dict)
    absence: Absence | None = None

    def posed(self, shape: str, weight: float) -> dict[str, Float[np.ndarray, "n 3"]]:
        """Returns the vertices of teeth and tongue at a weight of one blendshape. Blendshapes for an open jaw, such as
        ``mouthClose``, are combined with ``jawOpen``."""
        with_jaw, out = jaw_weight(shape, weight), {}
        for name, part in self.parts.items():
            moves = self.moves[name]
            out[name] = part.vertices + weight * moves.get(shape, 0.0) + with_jaw * moves.get("jawOpen", 0.0)
        return out


def jaw_weight(shape: str, weight: float) -> float:
    """Returns the weight of ``jawOpen`` that is combined with a blendshape at a weight."""
    return 0.0 if shape not in OPENED else 1.0 if shape == TONGUE_OUT else weight


def place_inner_mouth(
    mesh: Places,
    triangles: Int[np.ndarray, "g 3"],
    shapes: Shapes,
    landmarks: Points,
    jaw: Mapping[str, RigidTransform],
    loose: Int[np.ndarray, " t"],
) -> InnerMouth:
    """Returns teeth and tongue for a mesh without expression, or the reason why none are added.

    ``mesh``: vertices of the mesh, head frame, mm. ``triangles``: triangles of the mesh. ``shapes``: the mesh's
    displacements by Apple's names, mm. ``landmarks``: landmarks of the head. ``jaw``: motion of the lower jaw for each
    shape that moves it. ``loose``: index of the separate part that a vertex belongs to, -1 for the skin and eyeballs.
    """
    shipped, anchors = load_inner_mouth()
    place = procrustes(np.stack([anchors[name] for name in ANCHORS]), np.stack([landmarks[name] for name in ANCHORS]))
    shift = landmarks["stomion"] - place.apply(anchors["stomion"])
    shift[2] = 0.0  # depth behind the lips: fitted to the whole mouth
    parts = {
        name: Mesh(place.apply(part.mesh.vertices) + shift, part.mesh.faces, _shaded(part.mesh))
        for name, part in shipped.items()
    }
    if _has_own(mesh, loose, parts):
        return InnerMouth(absence="own-parts")
    tongue_out = place.scale * shipped["tongue"].tongue_out @ place.rotation.T
    back = 0.0
    while back <= BACK_MM:
        inner = _moving(parts, back, jaw, tongue_out)
        if not _meets(mesh, triangles, shapes, inner):
            inner = _moving(parts, back + SPARE_MM, jaw, tongue_out)
            return InnerMouth(absence="mouth-sealed") if _is_covered(mesh, triangles, shapes, inner) else inner
        back += STEP_MM
    return InnerMouth(absence="no-room")


def _shaded(part: Mesh) -> UInt8[np.ndarray, "n 3"]:
    """Returns the vertex colours darkened by the shadow of the mouth, because viewers do not compute this shadow."""
    z = part.vertices[:, 2]
    assert part.colours is not None
    light = 1.0 - np.clip((z.max() - z) / SHADE_MM, 0.0, 1.0) * (1.0 - DEEP_LIGHT)
    return np.asarray(light[:, None] * part.colours, np.uint8)


def _has_own(mesh: Places, loose: Int[np.ndarray, " t"], parts: Mapping[str, Mesh]) -> bool:
    """Returns whether the mesh already has teeth: a separate part at their position."""
    inside = np.concatenate([part.vertices for part in parts.values()])
    low, high = inside.min(axis=0), inside.max(axis=0)
    middles = [mesh[loose == number].mean(axis=0) for number in range(loose.max(initial=-1) + 1)]
    return any(bool(((low < middle) & (middle < high)).all()) for middle in middles)


def _moving(
    parts: Mapping[str, Mesh], back: float, jaw: Mapping[str, RigidTransform], tongue_out: Float[np.ndarray, "n 3"]
) -> InnerMouth:
    moved = {name: Mesh(p.vertices - (0.0, 0.0, back), p.faces, p.colours) for name, p in parts.items()}
    moves: dict[str, dict[str, np.ndarray]] = {name: {} for name in parts}
    for name in WITH_JAW:
        vertices = moved[name].vertices
        moves[name] = {shape: motion.apply(vertices) - vertices for shape, motion in jaw.items()}
    moves["tongue"][TONGUE_OUT] = tongue_out
    for name in WITH_JAW:
        visemes = {viseme: mixed(moves[name], mixture) for viseme, mixture in VISEMES.items()} if moves[name] else {}
        moves[name] |= {viseme: move for viseme, move in visemes.items() if move.any()}
    return InnerMouth(moved, moves)


def _about(mesh: Places, triangles: Int[np.ndarray, "g 3"], inner: InnerMouth) -> Int[np.ndarray, " r"]:
    """Returns the indices of the mesh's triangles near teeth and tongue, or near where the jaw moves them."""
    points = np.concatenate([inner.posed("jawOpen", weight)[name] for name in inner.parts for weight in (0.0, 1.0)])
    low, high = points.min(axis=0) - ABOUT_MM, points.max(axis=0) + ABOUT_MM
    corners = mesh[triangles]
    return np.flatnonzero(((corners.max(axis=1) > low) & (corners.min(axis=1) < high)).all(axis=1))


def meeting_triangles(
    mesh: Places, triangles: Int[np.ndarray, "g 3"], vertices: Mapping[str, Float[np.ndarray, "n 3"]], inner: InnerMouth
) -> Bool[np.ndarray, " g"]:
    """Returns a mask of the mesh's triangles that cross teeth or tongue; ``vertices`` are those of teeth and tongue."""
    points = np.concatenate([vertices[name] for name in inner.parts])
    starts = np.cumsum([0, *(len(vertices[name]) for name in inner.parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(inner.parts.values(), starts, strict=False)])
    corners, sides = mesh[triangles], points[faces]
    middles, long = corners.mean(axis=1), np.linalg.norm(sides - np.roll(sides, 1, axis=1), axis=2).max()
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1) + long
    out = np.zeros(len(triangles), bool)
    tree = KDTree(points)
    near = np.flatnonzero(tree.query(middles)[0] < reach)
    if len(near):
        beside = np.zeros(len(points), bool)
        beside[np.concatenate(tree.query_ball_point(middles[near], reach[near])).astype(int)] = True
        about = faces[beside[faces].any(axis=1)] + len(mesh)
        whole = np.concatenate([triangles[near], about])
        active = np.arange(len(whole)) >= len(near)
        out[near] = crossing_faces(np.concatenate([mesh, points]), whole, active)[: len(near)]
    return out


def _meets(mesh: Places, triangles: Int[np.ndarray, "g 3"], shapes: Shapes, inner: InnerMouth) -> bool:
    """Returns whether the mesh touches teeth or tongue at some opening of the jaw."""
    about = triangles[_about(mesh, triangles, inner)]
    opened = shapes.get("jawOpen", np.zeros_like(mesh))
    return any(
        bool(meeting_triangles(mesh + weight * opened, about, inner.posed("jawOpen", weight), inner).any())
        for weight in OPENING
    )


def _is_covered(mesh: Places, triangles: Int[np.ndarray, "g 3"], shapes: Shapes, inner: InnerMouth) -> bool:
    """Returns whether the mesh hides the gap between the front teeth although the jaw is open."""
    if "jawOpen" not in shapes:
        return True
    posed = inner.posed("jawOpen", 1.0)
    upper, lower = posed["teeth_upper"], posed["teeth_lower"]
    front_edge = lower[lower[:, 2] > lower[:, 2].max() - 4.0, 1].max()  # how high the lower front teeth reach, mm
    middle = np.array([upper[:, 0].mean(), 0.5 * (upper[:, 1].min() + front_edge)])
    corners = (mesh + shapes["jawOpen"])[triangles]
    ahead = corners[corners[:, :, 2].min(axis=1) > min(upper[:, 2].max(), lower[:, 2].max()) - DEEP_MM]
    to = ahead[:, :, :2] - middle
    after = np.roll(to, -1, axis=1)
    turned = to[..., 0] * after[..., 1] - to[..., 1] * after[..., 0]
    return bool(((turned >= 0.0).all(axis=1) | (turned <= 0.0).all(axis=1)).any())


def keep_off_teeth(
    mesh: Places, triangles: Int[np.ndarray, "g 3"], shapes: Shapes, inner: InnerMouth
) -> dict[str, Places]:
    """Returns blendshapes (mm) with lips lifted off the teeth at ``WEIGHTS``; all other vertices are unchanged."""
    if not inner.parts:
        return dict(shapes)
    about = triangles[_about(mesh, triangles, inner)]
    rows = np.unique(about)
    local = np.searchsorted(rows, about)
    out = dict(shapes)
    for name, shape in shapes.items():
        moved = any(name in moves for moves in inner.moves.values())
        if name == TONGUE_OUT or (not moved and np.abs(shape[rows]).max(initial=0.0) < STILL_MM):
            continue
        with_jaw = shapes["jawOpen"][rows] if jaw_weight(name, 1.0) and "jawOpen" in shapes else 0.0
        lift = _lift(mesh[rows], local, shape[rows] + with_jaw, name, inner)
        if lift is not None:
            out[name] = shape.copy()
            out[name][rows] += lift
    return out


def _lift(
    rest: Float[np.ndarray, "m 3"],
    triangles: Int[np.ndarray, "a 3"],
    displacement: Float[np.ndarray, "m 3"],
    name: str,
    inner: InnerMouth,
) -> Float[np.ndarray, "m 3"] | None:
    """Returns a change of a displacement that keeps all triangles off the teeth; None if no change is needed."""
    lift, fronts = np.zeros_like(rest), {}
    for _ in range(ROUNDS):
        need = np.zeros(len(rest))
        for weight in WEIGHTS:
            posed = rest + weight * (displacement + lift)
            meeting = meeting_triangles(posed, triangles, inner.posed(name, weight), inner)
            if meeting.any():
                front = fronts.setdefault(weight, _Front.of(inner, name, weight))
                depths = np.maximum(front.depths(posed, triangles), np.where(meeting, NUDGE_MM, 0.0))
                np.maximum.at(need, triangles, (depths / weight)[:, None])
        if not need.any():
            break
        outward = _outward(inner, rest + 0.5 * displacement)
        lift += _spread(rest, np.linalg.norm(displacement, axis=1), need)[:, None] * outward
    return lift if lift.any() else None


def _spread(
    rest: Float[np.ndarray, "m 3"], motion: Float[np.ndarray, " m"], need: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " m"]:
    """Spreads the shift that each vertex needs to the moving vertices around it, with decreasing weight."""
    pressed = np.flatnonzero(need)
    near = KDTree(rest[pressed]).sparse_distance_matrix(KDTree(rest), 2.5 * SPREAD_MM, output_type="coo_matrix")
    source, row = pressed[near.row], near.col
    alike = np.minimum(motion[row] / np.maximum(motion[source], 1e-6), 1.0)
    out = need.copy()
    np.maximum.at(out, row, alike * np.exp(-0.5 * near.data**2 / SPREAD_MM**2) * need[source])
    return out


def _axis(inner: InnerMouth) -> Float[np.ndarray, " 2"]:
    """Returns the horizontal position (x and z) of the vertical axis about which the arch of the teeth bends."""
    rest = inner.parts["teeth_upper"].vertices
    return np.array([0.5 * (rest[:, 0].min() + rest[:, 0].max()), rest[:, 2].min()])


def _outward(inner: InnerMouth, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns the horizontal unit vectors that point from the arch's vertical axis to the points."""
    axis = _axis(inner)
    away = (points - (axis[0], 0.0, axis[1])) * (1.0, 0.0, 1.0)
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)


@dataclass(frozen=True, slots=True, eq=False)
class _Front:
    """Holds the distance of the teeth's outer faces from the arch's vertical axis, by direction and height; 0 where
    there are no teeth."""

    axis: Float[np.ndarray, " 2"]  # x and z
    lowest: float
    reach: Float[np.ndarray, "a h"]

    @classmethod
    def of(cls, inner: InnerMouth, shape: str, weight: float) -> "_Front":
        posed = inner.posed(shape, weight)
        samples = [sample_triangles(posed[name], inner.parts[name].faces) for name in TEETH]
        rows = np.concatenate(samples).reshape(-1, 3)
        axis = _axis(inner)
        lowest = float(rows[:, 1].min()) - 2.0 * RISE_MM
        cells = (int(360.0 / TURN_DEG), int((rows[:, 1].max() - lowest) / RISE_MM) + 4)
        front = cls(axis, lowest, np.zeros(cells))
        turn, height, away = front.cells(rows)
        for a in (-1, 0, 1):
            for h in (-1, 0, 1):
                np.maximum.at(front.reach, ((turn + a) % cells[0], height + h), away)
        return front

    def cells(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Returns the direction and height cell of each point, and its distance from the arch's vertical axis."""
        x, z = (points[:, [0, 2]] - self.axis).T
        turn = (np.degrees(np.arctan2(x, z)) // TURN_DEG).astype(int) % self.reach.shape[0]
        height = np.floor((points[:, 1] - self.lowest) / RISE_MM).astype(int)
        return turn, height, np.hypot(x, z)

    def depths(self, posed: Float[np.ndarray, "m 3"], triangles: Int[np.ndarray, "a 3"]) -> Float[np.ndarray, " a"]:
        """Returns how deep (mm) each triangle lies in the teeth or the required gap before them; 0 outside."""
        points = sample_triangles(posed, triangles).reshape(-1, 3)
        turn, height, away = self.cells(points)
        inside = (height >= 0) & (height < self.reach.shape[1])
        reach = np.where(inside, self.reach[turn, np.clip(height, 0, self.reach.shape[1] - 1)], 0.0)
        depth = np.where((reach > 0.0) & (away > reach - DEEP_MM), reach + GAP_MM - away, 0.0)
        return np.maximum(depth.reshape(len(triangles), -1).max(axis=1), 0.0)
