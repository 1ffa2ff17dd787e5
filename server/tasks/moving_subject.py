"""Moves a subject of the simulated studio: it nods, turns, speaks and blinks, or sits still.

A film needs a person of a head model, a rig and a number of frames. The film consists of pictures of every frame, and
their ground truth: weights, pose and vertices. Backdrops, sensors, light, hair and shirt stay as they are over all
frames; hair and shirt turn with the head. Every picture has its own noise.
"""

import io
import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.head_model.expressions import arkit_parts, closed_lids
from pipeline.head_model.model import HeadModel
from rig.capture import ImageRgb
from rig.files import write_atomically
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.pictures.images import write_image
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.simulate import View, change_appearance, view_cameras, view_light
from rig.studio.scene.subject import Subject, dress, random_look
from rig.studio.sensor.preset import Preset
from rig.studio.sensor.sensor import drift, expose

FPS = 25.0
JOINT_MM = (0.0, -75.0, -25.0)  # of skull and spine, about which a head turns
NOD_DEG, TURN_DEG, LEAN_DEG, SWAY_MM = 7.0, 16.0, 3.0, 4.0  # amplitudes of calm talk
SYLLABLE_S = 0.24  # four or five a second
BLINK = (0.35, 0.85, 1.0, 0.9, 0.6, 0.3, 0.1)  # weights frame by frame at 25 fps: shut in 0.1 s, open in 0.2 s
BLINK_FRAMES = (14, 30)  # from one blink to the next
SPEECH = (
    {"jawOpen": 0.55, "mouthLowerDownLeft": 0.3, "mouthLowerDownRight": 0.3},
    {"jawOpen": 0.3, "mouthStretchLeft": 0.4, "mouthStretchRight": 0.4},
    {"mouthPucker": 0.7, "jawOpen": 0.15},
    {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5},
    {"mouthFunnel": 0.6, "jawOpen": 0.3},
)
BROWS = {"browInnerUp": 0.6, "browOuterUpLeft": 0.5, "browOuterUpRight": 0.5}
Weights = Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Holds a subject's state at one frame: the non-zero weights of a model's expressions, and its pose."""

    weights: Weights
    world_from_head: Similarity


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """Holds the moving person: coefficients of a model's head, and the seed of hair, shirt, backdrops and motion."""

    model: HeadModel
    coefficients: Float[np.ndarray, " m"]
    seed: int

    def subject(self, weights: Weights) -> Subject:
        """Returns the person with an expression, as the studio photographs it."""
        full, vertices = self.model.levels["full"], self.model.posed_vertices(self.coefficients, weights)
        marks = {name: vertices[row] for name, row in self.model.landmarks.items()}
        return Subject(Mesh(vertices, full.faces), marks, full.face_region, self.model.name, closed_lids(weights))


def move(person: Person, frames: int, centre_world: Float[np.ndarray, " 3"], *, still: bool = False) -> list[Pose]:
    """Returns a person's states at ``frames`` times, ``1 / FPS`` s apart. ``still``: all states have the first pose."""
    rng = np.random.default_rng((person.seed, 1))
    time, phases = np.arange(frames) / FPS, rng.uniform(0.0, 2.0 * np.pi, 6)
    swings = np.sin(2.0 * np.pi * np.outer(time, (0.45, 0.21, 0.13, 0.17, 0.11, 0.07)) + phases)
    beats = np.abs(np.sin(np.pi * time / SYLLABLE_S)) * np.clip(1.6 * np.sin(2.0 * np.pi * 0.4 * time), 0.0, 1.0)
    sounds = rng.integers(len(SPEECH), size=int(time[-1] / SYLLABLE_S) + 1)
    lids, at = np.zeros(frames), int(rng.integers(6, 12))
    while at < frames:
        shut = np.array(BLINK[: frames - at])
        lids[at : at + len(shut)] = np.maximum(lids[at : at + len(shut)], shut)
        at += int(rng.integers(*BLINK_FRAMES))
    poses = []
    for k in range(frames):
        of = 0 if still else k
        nod, turn, lean = np.radians([NOD_DEG, TURN_DEG, LEAN_DEG]) * swings[of, :3]
        rotation = rotation_from_vector(np.array([nod, turn, lean]))
        shift = np.array(JOINT_MM) - rotation @ JOINT_MM + SWAY_MM * swings[of, 3:]
        said = {name: beats[of] * weight for name, weight in SPEECH[sounds[int(time[of] / SYLLABLE_S)]].items()}
        raised = {name: weight * max(swings[of, 3], 0.0) ** 4 for name, weight in BROWS.items()}
        shut = {} if still else {"eyeBlinkLeft": float(lids[k]), "eyeBlinkRight": float(lids[k])}
        weights = of_model(person.model, {**said, **raised, **shut})
        poses.append(Pose(weights, Similarity(1.0, rotation, centre_world + shift)))
    return poses


def of_model(model: HeadModel, weights: Weights) -> dict[str, float]:
    """Converts weights by Apple's names to weights of the model's own expressions."""
    parts = arkit_parts(model.expressions.names)
    return {model.expressions.names[row]: w for name, w in weights.items() if w > 0.0 for row in parts[name]}


class Film:
    """Films a person: the studio's backdrops, sensors and lights, which stay as they are."""

    def __init__(self, person: Person, rig: Rig, preset: Preset, renderer: Renderer) -> None:
        self.person, self.rig, self.preset, self.renderer = person, rig, preset, renderer
        self._look = change_appearance(random_look(np.random.default_rng((person.seed, 2))), preset, ())
        self._views: dict[str, View] = {}

    def light(self, pose: Pose) -> dict[str, View]:
        """Returns the cameras' views of the person at one moment."""
        dressed = dress(
            self.renderer,
            self.person.subject(pose.weights),
            self._look,
            pose.world_from_head,
            clothes=self.preset.clothes,
            rng=np.random.default_rng((self.person.seed, 3)),
        )
        shown = (*dressed.worn, dressed.skin)
        light = self.renderer.photograph(self.rig, shown, dressed.gallery, samples=self.preset.samples)
        if not self._views:
            rng = np.random.default_rng((self.person.seed, 4))
            self._views = view_cameras(self.rig, light, self.preset, (), rng)
        return {name: replace(view, subject=light[name]) for name, view in self._views.items()}

    def plates(self, count: int, first: Pose) -> dict[str, list[ImageRgb]]:
        """Returns clean plates of every camera. ``first``: the person's pose if no frame of the film is lit yet."""
        if not self._views:
            self.light(first)
        rngs = np.random.default_rng((self.person.seed, 5)).spawn(len(self.rig))
        return {
            name: [expose(view_light(view, subject=False), view.sensor, rng) for _ in range(count)]
            for (name, view), rng in zip(self._views.items(), rngs, strict=True)
        }

    def shot(self, views: Mapping[str, View], number: int) -> dict[str, ImageRgb]:
        """Returns the pictures of frame ``number``."""

        def one(k: int, name: str) -> ImageRgb:
            light = view_light(views[name])
            drawn = np.random.default_rng((self.person.seed, 6, k))  # of the light: once, since the plates
            light = light * drift(light.shape[:2], self.preset.light_drift, drawn)
            return expose(light, views[name].sensor, np.random.default_rng((self.person.seed, 7, k, number)))

        with ThreadPoolExecutor(2) as pool:
            return dict(zip(views, pool.map(one, range(len(views)), views), strict=True))


def film(
    film: Film, poses: Mapping[int, Pose], report: Callable[[float], None]
) -> Iterator[tuple[int, dict[str, ImageRgb]]]:
    """Yields the numbers and pictures of all poses. A pose that equals the previous one is not lit again."""
    before, views = None, {}
    for done, (number, pose) in enumerate(poses.items()):
        report(done / len(poses))
        if before is None or pose.weights != before.weights or not _alike(pose, before):
            views = film.light(pose)
        before = pose
        yield number, film.shot(views, number)


def _alike(pose: Pose, other: Pose) -> bool:
    a, b = pose.world_from_head, other.world_from_head
    return np.array_equal(a.rotation, b.rotation) and np.array_equal(a.translation, b.translation)


def simulate_sequence(
    out: Path, person: Person, rig: Rig, preset: Preset, frames: int, *, renderer: Renderer, report: Progress,
    still: bool = False,
) -> Path:  # fmt: skip
    """Films a person and writes the folder of a sequence: cameras.json, images/<camera>/<frame>.png, background/ and
    times.csv. Frames that an earlier call for the same film has written are kept. Returns the folder of the truth
    beside ``out``, with cameras.json and truth.npz: names of expressions, weights (frames, expressions), rotations,
    translations (mm), vertices (frames, v, 3; world, mm), face (v)."""
    studio, poses = Film(person, rig, preset, renderer), move(person, frames, rig.centre_world(), still=still)
    lines = ["frame,time_s", *(f"{number:05},{number / FPS:.6f}" for number in range(frames))]
    write_rig(rig, out / "cameras.json")
    write_atomically(out / "times.csv", ("\n".join(lines) + "\n").encode())
    truth = write_truth(out, person, rig, poses, still=still)
    paths = [{name: out / "images" / name / f"{number:05}.png" for name in rig.names} for number in range(frames)]
    left = {k: poses[k] for k in range(frames) if not all(path.is_file() for path in paths[k].values())}
    for number, images in film(studio, left, lambda share: report("simulate", share)):
        for name, image in images.items():
            write_image(paths[number][name], image)
    for name, plates in studio.plates(preset.plates, poses[0]).items():
        for k, plate in enumerate(plates):
            write_image(out / "background" / name / f"{k:03}.png", plate)
    return truth


def write_truth(out: Path, person: Person, rig: Rig, poses: list[Pose], *, still: bool) -> Path:
    """Writes the folder of the truth beside ``out``, as ``simulate_sequence`` returns it."""
    truth, names = out.with_name(out.name + ".truth"), person.model.expressions.names
    write_rig(rig, truth / "cameras.json")
    buffer = io.BytesIO()
    heads = [p.world_from_head.apply(person.model.posed_vertices(person.coefficients, p.weights)) for p in poses]
    np.savez_compressed(
        buffer,
        expressions=np.array(names),
        weights=np.array([[pose.weights.get(name, 0.0) for name in names] for pose in poses]),
        rotations=np.stack([pose.world_from_head.rotation for pose in poses]),
        translations=np.stack([pose.world_from_head.translation for pose in poses]),
        vertices=np.stack(heads).astype(np.float32),
        face=np.asarray(person.model.levels["full"].face_region),
    )
    write_atomically(truth / "truth.npz", buffer.getvalue())
    write_atomically(truth / "meta.json", json.dumps({"seed": person.seed, "fps": FPS, "still": still}).encode())
    return truth
