"""Describes the subject in the simulated studio: a head and its appearance."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.linalg import splu

from rig.errors import InputError
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh, face_normals, vertex_normals
from rig.messages.message import compose
from rig.render.photograph import NOISE_CELLS, Gallery, Grain, Part
from rig.render.renderer import Renderer
from rig.studio.scene.anatomy import Anatomy, Landmarks, anatomy
from rig.studio.scene.eyes import IRIS_TONES, Eye, eye_centres, look_at_point, open_lids, surface
from rig.studio.scene.hair import STRAND_POINTS, Hair, HairStyle, grow, grow_beard, make_bun, make_hanging_hair
from rig.studio.scene.lights import LAMPS, Lamp, irradiance, lamp_directions
from rig.studio.scene.skin_texture import oily_zones, skin_paint
from rig.studio.scene.worn import TightCap, join_surfaces, lay_cap, make_cap, make_glasses, make_shirt
from rig.studio.sensor.sensor import volume

Vertices = Float[np.ndarray, "v 3"]


def scatter_light(
    vertices: Vertices, faces: Int[np.ndarray, "f 3"], irradiance: Vertices, scattering_mm: tuple[float, float, float]
) -> Vertices:
    """Simulates scattering of light within the skin, by one implicit step of heat flow on the surface for each channel.
    The integral of the light over the surface does not change. A colour channel that scatters by 0 mm is unchanged.

    Args:
        vertices: mm.
        faces: of a surface whose triangles may be degenerate.
        irradiance: linear RGB.
        scattering_mm: standard deviation over which each channel spreads.
    """
    stiffness, mass = _laplacian(vertices, faces)
    scattered = irradiance.copy()
    for channel, spread_mm in enumerate(scattering_mm):
        if spread_mm > 0.0:
            matrix = sparse.csc_array(sparse.diags_array(mass) + 0.5 * spread_mm**2 * stiffness)
            scattered[:, channel] = splu(matrix).solve(mass * irradiance[:, channel])
    return scattered


def _laplacian(vertices: Vertices, faces: Int[np.ndarray, "f 3"]) -> tuple[sparse.csr_array, Float[np.ndarray, " v"]]:
    """Returns the cotangent stiffness matrix, and a third of the area (mm2) of the triangles at each vertex."""
    double = np.maximum(np.linalg.norm(face_normals(vertices, faces), axis=1), 1e-6)
    rows, columns, values = [], [], []
    for corner in range(3):
        i, j, k = (faces[:, (corner + step) % 3] for step in (1, 2, 0))
        cotangent = ((vertices[i] - vertices[k]) * (vertices[j] - vertices[k])).sum(axis=1) / double
        half = 0.5 * np.clip(cotangent, 0.0, 20.0)  # obtuse corners would let light grow
        rows += [i, j, i, j]
        columns += [i, j, j, i]
        values += [half, half, -half, -half]
    count = len(vertices)
    at = (np.concatenate(rows), np.concatenate(columns))
    stiffness = sparse.csr_array((np.concatenate(values), at), shape=(count, count))
    mass = np.bincount(faces.ravel(), np.repeat(double / 6.0, 3), count)
    return stiffness, np.maximum(mass, 1e-6)


Colour = tuple[float, float, float]

SKIN_TONES: tuple[Colour, ...] = (
    (0.50, 0.32, 0.24),
    (0.44, 0.27, 0.19),
    (0.36, 0.21, 0.14),
    (0.27, 0.15, 0.10),
    (0.54, 0.37, 0.29),
)
HAIR_TONES: tuple[Colour, ...] = (
    (0.05, 0.028, 0.016),
    (0.10, 0.055, 0.028),
    (0.17, 0.10, 0.05),
    (0.02, 0.016, 0.014),
    (0.30, 0.20, 0.10),
)
CLOTH_TONES: tuple[Colour, ...] = (
    (0.16, 0.11, 0.20),
    (0.30, 0.07, 0.07),
    (0.08, 0.10, 0.13),
    (0.42, 0.40, 0.36),
    (0.28, 0.19, 0.07),
)

SKIN = Grain((3.6, 3.6, 3.6), (0.08, 0.03, 0.0, 0.0), (1.1, 1.1, 1.1), (0.10, 0.0, 0.0, 0.0), gloss=0.035)
HAIR = Grain((5.0, 30.0, 5.0), (0.30, 0.0, 0.0, 0.0), (0.9, 14.0, 5.0), (0.0, 0.45, 0.0, 0.0), gloss=0.015)
CLOTH = Grain((9.0, 9.0, 9.0), (0.0, 0.12, 0.0, 0.0), (1.3, 1.3, 1.3), (0.0, 0.0, 0.12, 0.0))
GAZE_MM = 1200.0  # how far away the point is that eyes look at
RUBBER = Grain((9.0, 9.0, 9.0), (0.0, 0.03, 0.0, 0.0), (1.3, 1.3, 1.3), (0.0, 0.0, 0.03, 0.0), gloss=0.06)
FRAME_TONE: Colour = (0.025, 0.018, 0.014)
FRAME = Grain((9.0, 9.0, 9.0), (0.0, 0.0, 0.0, 0.0), (9.0, 9.0, 9.0), (0.0, 0.0, 0.0, 0.0), gloss=0.15)
NO_GRAIN = Grain((9.0, 9.0, 9.0), (0.0, 0.0, 0.0, 0.0), (9.0, 9.0, 9.0), (0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """Holds a head (head frame, mm). Without landmarks, its skin has neither brows nor lips. ``closed`` is the degree
    (0 to 1) to which each eye is closed. ``eyes`` holds eyeballs by side (head frame); without eyeballs, eyes are
    painted on the skin."""

    mesh: Mesh
    landmarks: Landmarks = field(default_factory=dict)
    face_region: Bool[np.ndarray, " v"] | None = None
    name: str = "subject"
    closed: Mapping[str, float] = field(default_factory=dict)  # eyes by side, 0 open to 1
    eyes: Mapping[str, Eye] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Look:
    """Holds the appearance of a subject. All colours of an appearance are linear RGB albedos."""

    skin: Colour
    cloth: Colour
    hair: HairStyle | None
    freckles: float = 0.3
    stubble: float = 0.0
    texture: bool = True
    beard: HairStyle | None = None
    cap: Colour | None = None
    tight_cap: TightCap | None = None
    glasses: bool = False
    pores: float = 1.0  # contrast, by the painted one
    oil: float = 0.0
    scattering_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Holds a part of the subject before lighting, in the head frame (mm). ``shows`` is head, hair or clothes."""

    shows: str
    vertices: Vertices
    faces: Int[np.ndarray, "f 3"]
    places: Vertices
    paint: Float[np.ndarray, "v 4"]
    grain: Grain
    one_sided: bool
    oil: Float[np.ndarray, " v"] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Dressed:
    """Holds the lit subject in the world frame (mm): the head, hair and clothes. Hair is the first part, because it
    hides most other parts.

    ``solid`` holds all vertices and triangles but strands of hair, and is used to decide which points are hidden.
    ``surfaces`` holds the same meshes by name: head, hair, clothes. ``skin`` is the head's visible surface.
    """

    head: Part
    skin: Part
    worn: tuple[Part, ...]
    gallery: Gallery
    solid: tuple[Vertices, np.ndarray]
    surfaces: Mapping[str, Mesh]


def add_eyeballs(subject: Subject, azimuth_deg: float, elevation_deg: float, rng: np.random.Generator) -> Subject:
    """Adds eyeballs of a random colour to a subject, directed at a point ``GAZE_MM`` away. The gaze is relative to
    straight ahead: azimuth to the subject's left, elevation upwards. Raises InputError for a head without landmarks."""
    marks = anatomy(subject.mesh.vertices, subject.landmarks).landmarks
    if not marks:
        raise InputError("gaze", [compose("eyes-without-landmarks")])
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    across, up, ahead = np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)
    gaze = np.array([across, up, ahead])
    centres = eye_centres(subject.mesh, marks, gaze)
    target = 0.5 * (centres["right"] + centres["left"]) + GAZE_MM * gaze
    return replace(subject, eyes=look_at_point(centres, target, IRIS_TONES[rng.integers(len(IRIS_TONES))]))


def random_look(rng: np.random.Generator) -> Look:
    """Draws a random skin tone, hair tone and cloth tone from the lists of this module, and a random hair style."""
    tone = HAIR_TONES[rng.integers(len(HAIR_TONES))]
    over_ears = bool(rng.random() < 0.4)
    hair = HairStyle(
        thickness_mm=float(rng.uniform(9, 20) + 6 * over_ears),
        over_ears=over_ears,
        fringe_mm=float(rng.choice([0.0, 0.0, 8.0, 16.0])),
        lumps=float(rng.uniform(0.15, 0.32)),
        strand_mm=float(rng.uniform(14, 30)),
        stray_mm=float(rng.uniform(1.2, 2.6)),
        tone=tone,
    )
    skin, cloth = SKIN_TONES[rng.integers(len(SKIN_TONES))], CLOTH_TONES[rng.integers(len(CLOTH_TONES))]
    return Look(skin, cloth, hair, float(rng.uniform(0, 0.6)), float(rng.choice([0.0, 0.0, 0.6, 1.0])))


def random_pose(
    centre_world: Float[np.ndarray, " 3"], spread_deg: float, spread_mm: float, rng: np.random.Generator
) -> Similarity:
    """Draws a random pose world_from_head near ``centre_world`` (mm), with a small rotation and displacement."""
    rotation = rotation_from_vector(np.radians(rng.normal(0, spread_deg, 3)))
    return Similarity(1.0, rotation, centre_world + rng.normal(0, spread_mm, 3))


def dress(
    renderer: Renderer,
    subject: Subject,
    appearance: Look,
    world_from_head: Similarity,
    *,
    clothes: bool,
    rng: np.random.Generator,
    lamps: Sequence[Lamp] = LAMPS,
) -> Dressed:
    """Adds hair, clothes, skin colours and light to a head. Returns the subject in the world frame (mm)."""
    hair_rng, cloth_rng, noise_rng, strand_rng, skin_rng, eye_rng, cap_rng = rng.spawn(7)
    head, body = subject.mesh, anatomy(subject.mesh.vertices, subject.landmarks)
    worn = make_shirt(head, body, cloth_rng) if clothes else None
    hairs = _hairs(head, body, appearance, worn, hair_rng)
    pierced = replace(subject, mesh=open_lids(head, body.landmarks)) if subject.eyes else subject
    pieces = [_skin(pierced, body, appearance, worn is not None, skin_rng)]  # a shirt hides the cut through the neck
    pieces += [_hair_piece(hair, style) for hair, style in hairs]
    if worn:
        grain = CLOTH if appearance.texture else NO_GRAIN
        pieces.append(Piece("clothes", *worn, worn[0], _even(worn[0], appearance.cloth), grain, False))
    pieces += _headwear(head, body, appearance, hairs[0][0] if appearance.hair else None)
    for eye in (surface(eye, eye_rng) for eye in subject.eyes.values()):
        pieces.append(Piece("head", eye.vertices, eye.faces, eye.vertices, eye.paint, NO_GRAIN, True, eye.oil))
    if appearance.tight_cap:
        pieces.append(_tight_cap(head, body, appearance.tight_cap, cap_rng))
    placed = [(world_from_head.apply(piece.vertices), piece.faces) for piece in pieces]
    normals = [vertex_normals(*piece) for piece in placed]
    solid = join_surfaces(placed)
    light = irradiance(renderer, [(v, n) for (v, _), n in zip(placed, normals, strict=True)], solid, lamps)
    if max(appearance.scattering_mm) > 0.0:
        light[0] = scatter_light(*placed[0], light[0], appearance.scattering_mm)
    parts = [
        Part(vertices, faces, normal, piece.places, piece.paint, lit, piece.grain, piece.one_sided, piece.oil)
        for piece, (vertices, faces), normal, lit in zip(pieces, placed, normals, light, strict=True)
    ]
    strands = [
        _strand_part(hair, part, world_from_head, strand_rng)
        for (hair, _), part in zip(hairs, parts[1:], strict=False)
        if len(hair.strands)
    ]
    gallery = Gallery(
        volume(noise_rng, NOISE_CELLS), lamp_directions(lamps)[:2], np.array([lamp.colour for lamp in lamps[:2]])
    )
    shown = [piece.shows for piece in pieces]
    surfaces = {
        name: Mesh(*join_surfaces([mesh for mesh, one in zip(placed, shown, strict=True) if one == name]))
        for name in dict.fromkeys(("head", *shown))
    }
    bare = parts[0] if pierced is subject else _uncut(parts[0], head)
    return Dressed(bare, parts[0], tuple(parts[1:] + strands), gallery, solid, surfaces)


def _uncut(skin: Part, head: Mesh) -> Part:
    """Removes the vertices and triangles that opening the eyes added to the head's skin."""
    rows = slice(len(head.vertices))
    vertices = skin.vertices[rows]
    return replace(
        skin,
        vertices=vertices,
        faces=head.faces,
        normals=vertex_normals(vertices, head.faces),
        places=skin.places[rows],
        paint=skin.paint[rows],
        irradiance=skin.irradiance[rows],
        oil=None if skin.oil is None else skin.oil[rows],
    )


def _skin(subject: Subject, body: Anatomy, appearance: Look, one_sided: bool, rng: np.random.Generator) -> Piece:
    head = subject.mesh
    if not appearance.texture:
        return Piece(
            "head", head.vertices, head.faces, head.vertices, _even(head.vertices, appearance.skin), NO_GRAIN, one_sided
        )
    paint = skin_paint(
        head.vertices,
        body,
        appearance.skin,
        appearance.stubble,
        rng,
        closed=subject.closed,
        eyeballs=bool(subject.eyes),
    )
    paint[:, 3] = np.maximum(paint[:, 3] - (1.0 - appearance.pores), 0.0)  # brows and stubble keep what they add
    grain = replace(SKIN, freckles=appearance.pores * appearance.freckles)
    oil = appearance.oil * oily_zones(head.vertices, body) if appearance.oil > 0.0 else None
    return Piece("head", head.vertices, head.faces, head.vertices, paint, grain, one_sided, oil)


def _hairs(
    head: Mesh,
    body: Anatomy,
    appearance: Look,
    worn: tuple[Float[np.ndarray, "_ 3"], np.ndarray] | None,
    rng: np.random.Generator,
) -> list[tuple[Hair, HairStyle]]:
    """Returns all surfaces of hair with their styles. The hair over the scalp comes first."""
    styles: list[tuple[Hair, HairStyle]] = []
    if appearance.hair:
        scalp = grow(head.vertices, body, appearance.hair, rng)
        styles.append((scalp, appearance.hair))
        if appearance.hair.hanging_mm:
            solid = np.concatenate([head.vertices, worn[0]]) if worn else head.vertices
            styles.append((make_hanging_hair(scalp, solid, body, appearance.hair, rng), appearance.hair))
        if appearance.hair.bun_mm:
            styles.append((make_bun(scalp, body, appearance.hair, rng), appearance.hair))
    if appearance.beard:
        styles.append((grow_beard(head, body, appearance.beard, rng), appearance.beard))
    return styles


def _hair_piece(hair: Hair, style: HairStyle) -> Piece:
    paint = _even(hair.shell, style.tone)
    paint[:, :3] *= hair.shade[:, None]
    return Piece("hair", hair.shell, hair.shell_faces, hair.shell_points, paint, HAIR, hair.one_sided)


def _headwear(head: Mesh, body: Anatomy, appearance: Look, scalp: Hair | None) -> list[Piece]:
    pieces = []
    if appearance.cap:
        surface = make_cap(head.vertices, scalp.shell if scalp else None, body)
        grain = CLOTH if appearance.texture else NO_GRAIN
        pieces.append(Piece("clothes", *surface, surface[0], _even(surface[0], appearance.cap), grain, False))
    if appearance.glasses:
        surface = make_glasses(head.vertices, body)
        pieces.append(Piece("clothes", *surface, surface[0], _even(surface[0], FRAME_TONE), FRAME, False))
    return pieces


def _tight_cap(head: Mesh, body: Anatomy, worn: TightCap, rng: np.random.Generator) -> Piece:
    vertices, faces, albedo = lay_cap(head, body, worn, rng)
    paint = np.column_stack([albedo, np.ones(len(albedo))])
    return Piece("clothes", vertices, faces, vertices, paint, RUBBER if worn.glossy else CLOTH, False)


def _even(vertices: Vertices, tone: Colour) -> Float[np.ndarray, "v 4"]:
    return np.tile((*tone, 1.0), (len(vertices), 1))


def _strand_part(hair: Hair, shell: Part, world_from_head: Similarity, rng: np.random.Generator) -> Part:
    per_strand = 2 * STRAND_POINTS
    shade = np.repeat(rng.uniform(0.7, 1.4, len(hair.roots) // per_strand), per_strand)[:, None]
    vertices = world_from_head.apply(hair.strands)
    return replace(
        shell,
        vertices=vertices,
        faces=hair.strand_faces,
        normals=shell.normals[hair.roots],
        places=hair.strand_points,
        paint=shell.paint[hair.roots],
        irradiance=shell.irradiance[hair.roots] * shade,
        grain=replace(shell.grain, gloss=0.0),
        one_sided=False,
    )


CAP_TONE: Colour = (0.035, 0.06, 0.14)  # navy

SWIM_CAP = TightCap((0.02, 0.10, 0.42))  # blue silicone
WIG_CAP = TightCap((0.018, 0.018, 0.02), folds_mm=2.0, creases=0.5, glossy=False)  # black cloth, badly put on

Change = Callable[[Look], Look]


def _hair(**changes: float | bool) -> Change:
    return lambda appearance: replace(appearance, hair=replace(appearance.hair or HairStyle(), **changes))


def _beard(appearance: Look) -> Look:
    tone = (appearance.hair or HairStyle()).tone
    beard = HairStyle(thickness_mm=13.0, curl_mm=5.0, strands=3500, strand_mm=10.0, stray_mm=1.2, tone=tone)
    return replace(appearance, beard=beard)


def _cap(appearance: Look) -> Look:
    under = (
        replace(appearance.hair, thickness_mm=7.0, fringe_mm=0.0, lumps=0.1, strands=800, stray_mm=0.6)
        if appearance.hair
        else None
    )
    return replace(appearance, hair=under, cap=CAP_TONE)


def _tight(cap: TightCap) -> Change:
    return lambda appearance: replace(appearance, hair=None, cap=None, tight_cap=cap)


HAIRSTYLES: Mapping[str, Change] = MappingProxyType({
    "short": _hair(thickness_mm=12.0, over_ears=False, fringe_mm=0.0),
    "over-ears": _hair(thickness_mm=20.0, over_ears=True, fringe_mm=0.0),
    "long": _hair(thickness_mm=13.0, over_ears=True, fringe_mm=0.0, lumps=0.12, stray_mm=1.6, hanging_mm=150.0),
    "curly": _hair(thickness_mm=22.0, fringe_mm=0.0, lumps=0.2, curl_mm=9.0, strand_mm=14.0),
    "fringe": _hair(thickness_mm=13.0, over_ears=True, fringe_mm=30.0, lumps=0.12),
    "bun": _hair(thickness_mm=6.0, over_ears=False, fringe_mm=0.0, lumps=0.08, strands=1800, bun_mm=33.0),
    "beard": _beard,
    "bald": lambda appearance: replace(appearance, hair=None),
    "cap": _cap,
    "swim-cap": _tight(SWIM_CAP),
    "wig-cap": _tight(WIG_CAP),
    "glasses": lambda appearance: replace(appearance, glasses=True),
})  # fmt: skip
"""What each name changes of a look. Caps and glasses count as clothes in the truth, a beard as hair. Glasses are rims
without panes: the pipeline asks studios for that."""


def restyle(appearance: Look, names: Sequence[str]) -> Look:
    """Applies the changes ``names`` of ``HAIRSTYLES`` to an appearance. Raises InputError for an unknown name."""
    if unknown := [name for name in names if name not in HAIRSTYLES]:
        raise InputError("hair", [compose("none-of", value=name, known=[*HAIRSTYLES]) for name in unknown])
    for name in names:
        appearance = HAIRSTYLES[name](appearance)
    return appearance
