"""Pictures of heads whose every point is known, and where the face finder puts its points in them.

Heads are drawn from a model's own population, every second one with an expression; each is photographed in the
simulated studio by eleven cameras around its face, with lamps, skin, hair and pose of its own.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.faces.detection import FaceDetection, crop_around, find_face_at, make_pyramid
from pipeline.faces.networks import FaceNetworks
from pipeline.faces.points import point_table
from pipeline.head_model.expressions import closed_lids
from pipeline.head_model.model import HeadModel
from rig.capture import ImageRgb
from rig.formats.cameras.cameras_json import document_from_rig, rig_from_document
from rig.geometry import Similarity, rigid_fit, rotation_from_vector
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import rig_from_directions
from rig.studio.scene.lights import LAMPS, Lamp
from rig.studio.scene.simulate import backdrop
from rig.studio.scene.subject import Subject, dress, random_look
from rig.studio.sensor.preset import Preset
from rig.studio.sensor.sensor import Sensor, expose, focus
from tests.support.drawn_expressions import drawn_weights

SEED = 11
AZIMUTHS_DEG = (0, 0, 0, -25, 25, -45, 45, -65, 65, -85, 85)
ELEVATIONS_DEG = (0, 30, -30, -15, 15, 18, -18, -5, 8, 12, -12)
SPREAD_DEG = 8.0  # of a camera about its direction
TURN_DEG, SHIFT_MM = 6.0, 10.0  # of a head
SCALE = 0.625  # of the studio's pictures: 640 x 480, in which a face fills a crop of some 300 px
PAINTED_VERTICES = 30_000  # skin is painted by vertex: a coarser mesh has none inside the eyes' openings
SIX = ("exocanthion_right", "exocanthion_left", "pronasale", "cheilion_right", "cheilion_left", "gnathion")
SIX_POINTS = [33, 263, 1, 61, 291, 152]


@dataclass(frozen=True, slots=True, eq=False)
class PhotographedHead:
    """What was found on one head: the points in each view with their scores, and the head itself (world, mm)."""

    rig: Rig
    landmarks_px: Float[np.ndarray, "v 468 2"]
    scores: Float[np.ndarray, " v"]
    vertices_world: Float[np.ndarray, "n 3"]
    world_from_head: Similarity
    has_expression: bool

    def detections(self, min_score: float) -> dict[str, FaceDetection]:
        """The views in which the finder saw the face, as it hands them on."""
        views = zip(self.rig.names, self.landmarks_px, self.scores.tolist(), strict=True)
        return {name: as_detection(points, score) for name, points, score in views if score >= min_score}


def as_detection(points: Float[np.ndarray, "468 2"], score: float) -> FaceDetection:
    """A detection with these points."""
    box = np.concatenate([points.min(axis=0), points.max(axis=0)])
    return FaceDetection(points, score, box, crop_around(points).roll_deg)


def photograph_head(model: HeadModel, number: int, networks: FaceNetworks, renderer: Renderer) -> PhotographedHead:
    """Draws, photographs and searches the ``number``-th head of a model."""
    rng = np.random.default_rng((SEED, number))
    coefficients = rng.standard_normal(len(model.modes))
    weights = drawn_weights(rng, model.expressions.names) if rng.random() < 0.5 else {}
    head = model.posed_vertices(coefficients, weights)
    marks = {name: head[row] for name, row in model.landmarks.items()}
    subject = Subject(_painted(Mesh(head, model.levels["full"].faces)), marks, None, "head", closed_lids(weights))
    rig = rig_from_directions(_directions_deg(rng), number).scaled(SCALE)
    look = random_look(rng)
    if rng.random() < 0.3:
        look = replace(look, hair=None)
    turn = rotation_from_vector(np.radians(rng.normal(0, TURN_DEG, 3)))
    pose = Similarity(1.0, turn, rng.normal(0, SHIFT_MM, 3))
    dressed = dress(renderer, subject, look, pose, clothes=True, rng=rng, lamps=_lamps(rng))
    light = renderer.photograph(rig, (*dressed.worn, dressed.head), dressed.gallery, samples=4)
    images = {camera.name: _picture(light[camera.name], camera.intrinsics, rng) for camera in rig}
    landmarks, scores = _searched(images, rig, pose, marks, networks)
    return PhotographedHead(rig, landmarks, scores, pose.apply(head), pose, bool(weights))


def save_head(path: Path, head: PhotographedHead) -> None:
    """Writes a photographed head."""
    np.savez_compressed(
        path,
        lm=head.landmarks_px,
        sc=head.scores,
        V=head.vertices_world.astype(np.float32),
        R=head.world_from_head.rotation,
        t=head.world_from_head.translation,
        rig=json.dumps(document_from_rig(head.rig)),
        w=json.dumps({"posed": 1.0} if head.has_expression else {}),
    )


def load_head(path: Path) -> PhotographedHead:
    """Reads what ``save_head`` wrote."""
    with np.load(path, allow_pickle=False) as file:
        return PhotographedHead(
            rig_from_document(json.loads(str(file["rig"]))),
            file["lm"],
            file["sc"],
            file["V"].astype(float),
            Similarity(1.0, file["R"], file["t"]),
            bool(json.loads(str(file["w"]))),
        )


def _directions_deg(rng: np.random.Generator) -> list[tuple[float, float]]:
    aims = zip(AZIMUTHS_DEG, ELEVATIONS_DEG, strict=True)
    return [(a + float(rng.normal(0, SPREAD_DEG)), e + float(rng.normal(0, SPREAD_DEG))) for a, e in aims]


def _lamps(rng: np.random.Generator) -> tuple[Lamp, ...]:
    """The studio's lamps moved, dimmed and tinted."""
    moved = []
    for lamp in LAMPS:
        x, y, z = (np.array(lamp.towards) + rng.normal(0, 0.45, 3)).tolist()
        gain = np.exp(rng.normal(0, 0.35))
        red, green, blue = (np.array(lamp.colour) * gain * np.exp(rng.normal(0, 0.08, 3))).tolist()
        moved.append(Lamp((x, y, z), (red, green, blue), float(lamp.sharpness * np.exp(rng.normal(0, 0.3)))))
    return tuple(moved)


def _painted(mesh: Mesh) -> Mesh:
    """A mesh fine enough to paint eyes on: each triangle in sixteen, where it is coarse."""
    vertices, faces = mesh.vertices, mesh.faces
    for _ in range(2 if len(vertices) < PAINTED_VERTICES else 0):
        vertices, faces = _halved(vertices, faces)
    return Mesh(vertices, faces)


def _halved(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Each triangle in four, by the middles of its edges."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, which = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = len(vertices) + which.reshape(-1, 3).T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    middles = vertices[unique].mean(axis=1)
    return np.concatenate([vertices, middles]), np.concatenate([np.stack(each, axis=1) for each in corners])


def _picture(light: Float[np.ndarray, "h w 4"], intrinsics: object, rng: np.random.Generator) -> ImageRgb:
    """A camera's picture of the lit subject before a backdrop."""
    red, green, blue = (np.exp(rng.normal(0, 0.1)) * np.exp(rng.normal(0, 0.05, 3))).tolist()
    sensor = Sensor((red, green, blue), Preset(vignetting=0.12, defocus_px=0.6, noise=0.012))
    behind = backdrop(intrinsics, rng, 1.0, None)  # type: ignore[arg-type]
    whole = (light[:, :, :3] + (1 - light[:, :, 3:]) * behind).astype(np.float32)
    return expose(focus(whole, sensor), sensor, rng)


def _searched(
    images: dict[str, ImageRgb],
    rig: Rig,
    pose: Similarity,
    marks: dict[str, Float[np.ndarray, " 3"]],
    networks: FaceNetworks,
) -> tuple[Float[np.ndarray, "v 468 2"], Float[np.ndarray, " v"]]:
    """Points and scores in every view, looked for where the face is: of interest is how they err, not whether one
    finds them."""
    shape = point_table().shape_mm
    world_from_face = rigid_fit(shape[SIX_POINTS], pose.apply(np.stack([marks[name] for name in SIX])))
    rough = world_from_face.apply(shape)
    faces = [
        find_face_at(make_pyramid(images[camera.name]), crop_around(camera.project(rough)), networks) for camera in rig
    ]
    return np.stack([face.landmarks_px for face in faces]), np.array([face.score for face in faces])
