"""Provides the subjects of ``experiments people``: captures with a truth beside them, with all or some of their views,
and heads in the simulated studio with rigs of many kinds. Each comes with plates, with true masks, or with neither, as
in real studios."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from pipeline.geometry.projection import depth_maps
from pipeline.head_model.expressions import closed_lids, plain_name
from pipeline.head_model.landmarks import SEVEN_POINTS
from pipeline.head_model.model import HeadModel, Level
from pipeline.head_model.subdivision import refine
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.cameras_file import read_rig_file, rig_files
from rig.formats.captures.capture_folder import capture_root, read_capture
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.pictures.images import decode_image_file
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import DEFAULT_DIRECTIONS_DEG, DISTANCE_MM, rig_from_directions
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Colour, Subject, random_look
from rig.studio.scene.visible import PARTS, VisiblePoints, sees
from rig.studio.sensor.faults import Fault
from rig.studio.sensor.preset import PRESET, REALISM, Preset, made_real
from tests.laboratory.experiments.people.view_subsets import even_views, frontal_views, is_circle
from tests.laboratory.experiments.surface.visible_surface import read_visible
from tests.support.layouts import circle_directions, row_directions

EVIDENCE = ("plates", "masks", "neither")
FRONTAL_COUNTS, CIRCLE_COUNTS = (3, 5, 8, 11), (5, 8, 11, 12, 16)
SEEN_MM = 2.0  # from a visible point of the skin, 1.5 mm apart
MIN_VIEWS = 2  # what one camera alone sees has no depth
SEED = 33
OWN_MODES, OWN_SPREAD = 60, 0.8  # section 5.2
DARK_SKIN: Colour = (0.075, 0.042, 0.028)  # linear albedo, half of the darkest of the studio's tones
FIVE_DEG = ((0, 0), (-40, 8), (40, 8), (0, 32), (0, -30))


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """Holds a capture and its truth. ``seen``: vertices of the true face that two of the cameras see, not under hair;
    ``vertices_correspond``: whether the true mesh has the fitted model's vertices, row by row."""

    capture: Capture
    rig: Rig
    mesh_world: Mesh
    seen: Bool[np.ndarray, " v"]
    landmarks_world: Mapping[str, Float[np.ndarray, " 3"]]
    vertices_correspond: bool = False


@dataclass(frozen=True, slots=True)
class Case:
    """Holds one row of the table before it is computed. ``kind`` is the arrangement of cameras; ``evidence`` says
    whether there are plates, masks or neither."""

    subject: str
    kind: str
    evidence: str
    read: Callable[[], Person]

    @property
    def name(self) -> str:
        """Returns the row's name: subject, arrangement of cameras, and what is known."""
        return f"{self.subject} {self.kind} {self.evidence}"


@dataclass(frozen=True, slots=True, eq=False)
class CaptureWithTruth:
    """Holds a capture folder as it was read, its true masks, and its truth."""

    capture: Capture
    rig: Rig
    masks: Mapping[str, Bool[np.ndarray, "_ _"]]
    mesh_world: Mesh
    face: Bool[np.ndarray, " v"]
    visible: VisiblePoints
    landmarks_world: Mapping[str, Float[np.ndarray, " 3"]]
    vertices_correspond: bool = False

    def person(self, views: Sequence[str], evidence: str) -> Person:
        """Returns the person as the named cameras see it, with ``evidence`` of EVIDENCE."""
        names, rig = set(views), self.rig.subset(views)

        def of_views(filed: Mapping) -> dict:
            return {name: value for name, value in filed.items() if name in names}

        capture = Capture(
            of_views(self.capture.images),
            of_views(self.capture.backgrounds) if evidence == "plates" else {},
            of_views(self.masks) if evidence == "masks" else {},
        )
        seen = self.face & seen_vertices(self.mesh_world, self.visible, rig)
        return Person(capture, rig, self.mesh_world, seen, self.landmarks_world, self.vertices_correspond)


@dataclass(frozen=True, slots=True, eq=False)
class StudioKind:
    """Holds a rig in the studio and the subject in front of it. ``kind`` is as in ``Case``; ``what`` distinguishes it
    from others of its kind. ``pose_deg``: yaw to the subject's left, pitch downwards, roll to its left shoulder."""

    what: str
    kind: str
    directions_deg: tuple[tuple[float, float], ...]
    distance_mm: float = DISTANCE_MM
    rolls_deg: tuple[float, ...] = (0.0,)
    pose_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hairstyle: tuple[str, ...] = ()
    expression: Mapping[str, float] = field(default_factory=dict)  # weights under Apple's names
    skin: Colour | None = None
    is_before_own_colour: bool = False  # hair, clothes and backdrop alike, and dark
    realism: tuple[str, ...] = ()  # of ``REALISM``
    unevenness: float = 1.0  # of the backdrop; 0.15 is the plain wall of a living room


ROW_DEG = row_directions(3, 100.0, 500.0)
SMILE = {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8, "jawOpen": 0.2}
ELEVEN_DEG = DEFAULT_DIRECTIONS_DEG
REAL = tuple(REALISM)
STUDIO_KINDS = (
    StudioKind("bald", "front-3", ROW_DEG, 500.0, hairstyle=("bald",), unevenness=0.15),
    StudioKind("long-hair", "front-3", ROW_DEG, 500.0, hairstyle=("long",), unevenness=0.15),
    StudioKind("yaw", "front-3", ROW_DEG, 500.0, pose_deg=(25.0, 5.0, 0.0), hairstyle=("short",), unevenness=0.15),
    StudioKind("near", "front-5", FIVE_DEG, 400.0, hairstyle=("glasses",)),
    StudioKind("upside-down", "front-5", FIVE_DEG, rolls_deg=(180.0,), hairstyle=("short",)),
    StudioKind("beard", "front-8", ELEVEN_DEG[:8], 700.0, hairstyle=("short", "beard"), expression=SMILE),
    StudioKind("plain", "front-11", ELEVEN_DEG),
    StudioKind("far", "front-11", ELEVEN_DEG, 3000.0, hairstyle=("curly",)),
    StudioKind("portrait", "front-11", ELEVEN_DEG, rolls_deg=(90.0,), hairstyle=("over-ears",)),
    StudioKind("mixed-rolls", "front-11", ELEVEN_DEG, rolls_deg=(0.0, 90.0, 180.0, -90.0), hairstyle=("short",)),
    StudioKind("yaw", "front-11", ELEVEN_DEG, pose_deg=(45.0, 0.0, 0.0), hairstyle=("short",)),
    StudioKind("pitch", "front-11", ELEVEN_DEG, pose_deg=(0.0, 40.0, 0.0), hairstyle=("short",)),
    StudioKind("pitch-up", "front-11", ELEVEN_DEG, pose_deg=(-20.0, -35.0, 10.0), hairstyle=("short",)),
    StudioKind("jaw-open", "front-11", ELEVEN_DEG, hairstyle=("bald",), expression={"jawOpen": 0.6}),
    StudioKind("dark", "front-11", ELEVEN_DEG, skin=DARK_SKIN, is_before_own_colour=True),
    StudioKind("real-skin", "front-3", ROW_DEG, 500.0, hairstyle=("bald",), realism=REAL, unevenness=0.15),
    StudioKind("real-skin", "front-11", ELEVEN_DEG, hairstyle=("short",), realism=REAL),
    StudioKind("cap", "front-5", FIVE_DEG, 800.0, hairstyle=("cap",)),
    StudioKind("short", "circle-8", circle_directions(8), hairstyle=("short",)),
    StudioKind("yaw", "circle-8", circle_directions(8), pose_deg=(45.0, 10.0, 0.0), hairstyle=("bald",)),
    StudioKind("long-hair", "circle-16", circle_directions(16, (0.0, 22.0)), hairstyle=("long",)),
    StudioKind("portrait", "circle-16", circle_directions(16), rolls_deg=(90.0,), hairstyle=("short",)),
    StudioKind("curly", "circle-32", circle_directions(32, (0.0, 20.0)), hairstyle=("curly",)),
)


def capture_cases(folder: Path) -> Iterator[Case]:
    """Yields a capture's whole rig and subsets of its views, each with every kind of evidence. Raises InputError."""
    truth = truth_folder(folder)
    rig, pose = read_rig_file(next(rig_files(capture_root(folder)))), _true_pose(truth)
    subsets: dict[str, tuple[str, ...]] = {}
    circle = is_circle(rig, pose)
    subsets[f"circle-{len(rig)}" if circle else f"front-{len(rig)}"] = rig.names
    for count in CIRCLE_COUNTS if circle else ():
        if count < len(rig):
            subsets.setdefault(f"circle-{count}", even_views(rig, pose, count))
    for count in FRONTAL_COUNTS:
        if count < len(rig):
            subsets.setdefault(f"front-{count}", frontal_views(rig, pose, count))
    for kind, views in subsets.items():
        for evidence in EVIDENCE:
            yield Case(folder.name, kind, evidence, partial(_person_of_folder, folder, views, evidence))


def studio_cases(fitted: HeadModel, others: HeadModel | None, renderer: Renderer, subjects: int) -> Iterator[Case]:
    """Yields ``subjects`` heads for each of the studio's kinds, each with every kind of evidence. They are drawn
    alternately from another population and from the fitted model, or from that alone if there is no other."""
    for number in range(subjects):
        for row, studio in enumerate(STUDIO_KINDS):
            drawn = fitted if others is None or (row + number) % 2 else others
            read = partial(_person_of_studio, studio, drawn, drawn is fitted, renderer, (SEED, row, number))
            for evidence in EVIDENCE:
                yield Case(f"studio-{studio.what}-{number}", studio.kind, evidence, partial(read, evidence))


def seen_vertices(mesh_world: Mesh, visible: VisiblePoints, rig: Rig) -> Bool[np.ndarray, " v"]:
    """Tells which vertices two of the cameras see. Hair is known from ``visible`` alone, whose cameras may be more."""
    skin = visible.points[visible.part == PARTS.index("head")].astype(float)
    bare = KDTree(skin).query(mesh_world.vertices, distance_upper_bound=SEEN_MM)[0] < SEEN_MM
    depth, normals = depth_maps(rig, mesh_world), mesh_world.normals()
    count = np.zeros(len(bare), int)
    for camera in rig:
        count += sees(camera, depth[camera.name], mesh_world.vertices, normals)
    return bare & (count >= MIN_VIEWS)


def truth_folder(folder: Path) -> Path:
    """Returns the folder with a capture's truth. Raises InputError where there is none."""
    truth = folder.with_name(folder.name + ".truth")
    needed = ("head.ply", "face_mask.npy", "visible.npz", "meta.json", "silhouettes")
    missing = [f"{truth.name}/{name} is missing" for name in needed if not (truth / name).exists()]
    if missing:
        raise InputError(folder.name, missing)
    return truth


@lru_cache(maxsize=1)  # the cases of one capture follow one another
def _read_folder(folder: Path) -> CaptureWithTruth:
    capture, rig = read_capture(folder)
    truth = truth_folder(folder)
    meta = json.loads((truth / "meta.json").read_text(encoding="utf-8"))["landmarks_world"]
    marks = {name: np.asarray(meta[name], float) for name in SEVEN_POINTS if name in meta}
    return CaptureWithTruth(
        capture,
        rig,
        {name: _read_mask(truth / "silhouettes" / f"{name}.png") for name in rig.names},
        read_mesh(truth / "head.ply"),
        np.load(truth / "face_mask.npy"),
        read_visible(truth),
        marks,
    )


def _read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    pixels, _, fault = decode_image_file(path, path.name, "mask")
    if pixels is None:
        assert fault is not None
        raise InputError(path.name, [fault])
    return pixels > 127


def _true_pose(truth: Path) -> Similarity:
    pose = json.loads((truth / "meta.json").read_text(encoding="utf-8"))["world_from_head"]
    return Similarity(1.0, np.asarray(pose["rotation"], float), np.asarray(pose["translation"], float))


def _person_of_folder(folder: Path, views: Sequence[str], evidence: str) -> Person:
    return _read_folder(folder).person(views, evidence)


def _person_of_studio(
    studio: StudioKind, drawn: HeadModel, corresponds: bool, renderer: Renderer, seed: tuple[int, ...], evidence: str
) -> Person:
    shot = photograph(studio, drawn, corresponds, renderer, seed)
    return shot.person(shot.rig.names, evidence)


@lru_cache(maxsize=1)  # the cases of one sitter follow one another
def photograph(
    studio: StudioKind, drawn: HeadModel, corresponds: bool, renderer: Renderer, seed: tuple[int, ...]
) -> CaptureWithTruth:
    """Photographs a random head in the studio. ``corresponds``: whether ``drawn`` is the model that will be fitted."""
    rng = np.random.default_rng(seed)
    modes, spread = (OWN_MODES, OWN_SPREAD) if corresponds else (len(drawn.modes), 1.0)
    requested = studio.expression
    weights = {name: requested[plain_name(name)] for name in drawn.expressions.names if plain_name(name) in requested}
    vertices, level = drawn.posed_vertices(spread * rng.standard_normal(modes), weights), drawn.levels["full"]
    head, face = (Mesh(vertices, level.faces), level.face_region) if corresponds else _finer(vertices, level)
    marks = {name: head.vertices[row] for name, row in drawn.landmarks.items()}
    subject = Subject(head, marks, face, studio.what, closed_lids(weights))
    rig = rig_from_directions(studio.directions_deg, distance_mm=studio.distance_mm, rolls_deg=studio.rolls_deg)
    look = random_look(rng)
    plain = replace(PRESET, hairstyle=studio.hairstyle, backdrop_unevenness=studio.unevenness)
    preset = made_real(plain, studio.realism)
    shot = simulate(
        subject,
        rig,
        preset,
        rng,
        renderer=renderer,
        look=look if studio.skin is None else replace(look, skin=studio.skin),
        world_from_head=_seated(studio.pose_deg, preset, rng),
        faults=(Fault("camouflage"),) if studio.is_before_own_colour else (),
    )
    scene = shot.scene
    places = {name: place for name, place in scene.landmarks_world.items() if name in SEVEN_POINTS}
    return CaptureWithTruth(
        capture=shot.capture,
        rig=shot.rig,
        masks=shot.masks,
        mesh_world=scene.head,
        face=face,
        visible=scene.visible,
        landmarks_world=places,
        vertices_correspond=corresponds,
    )


def _finer(vertices: Float[np.ndarray, "v 3"], level: Level) -> tuple[Mesh, Bool[np.ndarray, " w"]]:
    """Returns a head with four times the triangles, old vertices first, and its face: brows are painted on vertices."""
    operator, faces = refine(level.faces, len(vertices), 1)
    return Mesh(operator @ vertices, faces), operator @ level.face_region.astype(float) > 0.5


def _seated(pose_deg: tuple[float, float, float], preset: Preset, rng: np.random.Generator) -> Similarity:
    """world_from_head of a head that is turned so, a few degrees and millimetres off."""
    yaw, pitch, roll = np.radians(pose_deg)
    turn = rotation_from_vector(np.array([0.0, yaw, 0.0])) @ rotation_from_vector(np.array([pitch, 0.0, 0.0]))
    turn = turn @ rotation_from_vector(np.array([0.0, 0.0, roll]))
    off = rotation_from_vector(np.radians(preset.pose_spread_deg / 2 * rng.standard_normal(3)))
    return Similarity(1.0, off @ turn, preset.pose_spread_mm * rng.standard_normal(3))
