"""Tracks a head through a sequence: estimates one identity, and the pose and expression of every frame.

The identity is estimated from the sharpest frames of the first second (``sequence_person``). After the person's head is
known, each frame is fitted, starting from the motion extrapolated from the previous frames (``track_frame``). A lost
head is searched in the whole pictures; if no head is found, the frame counts as failed and is interpolated. After the
last frame, pose and expression weights are smoothed over time (``smoothing``).

Results are stored in chunks of frames, each written under a temporary name first. No chunk depends on another chunk: a
run after an interruption computes only the missing chunks, and several processes can divide them with the same result.
"""

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from pipeline.applications.moments.appearance import REDUCED, Levels, Samples, observe, spread
from pipeline.applications.moments.face_evidence import FaceReference, landmarks_of, refer, sight, terms_of
from pipeline.applications.moments.footage import MIN_VIEWS, Footage, Pictures
from pipeline.applications.moments.sequence_person import Motion, SequencePerson, find_person
from pipeline.applications.moments.smoothing import smooth
from pipeline.applications.moments.track_frame import POSE, Tracked, fit_frame
from pipeline.faces.networks import FaceNetworks, load_networks
from pipeline.faces.subject import find_subject
from pipeline.head_model.model import HeadModel
from pipeline.settings import Settings, document_from_settings
from rig.files import write_atomically
from rig.geometry import RigidTransform, rigid_fit, rotation_from_vector, vector_from_rotation
from rig.messages.message import documents_of, read_message
from rig.progress import Progress
from rig.render.renderer import Renderer

INPUTS = "inputs.json"
CHUNK = 25  # frames of a stored chunk
MIN_ALIKE = 0.5  # correlation of a frame's texture with the reference: .8 to .97 on drawn heads, .1 where it is lost
KEPT = 0.5  # with 1.0, errors in poorly observed directions grew from frame to frame
SHARE = 0.1  # share of the work that estimates the person


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Holds the tracking results by frame: expression weights, pose (world_from_head), standard deviations of rotation
    (rad), translation (mm) and weights, correlation of the texture, which frames failed, and which cameras had a
    picture."""

    weights: Float[np.ndarray, "t e"]
    rotations: Float[np.ndarray, "t 3 3"]
    translations: Float[np.ndarray, "t 3"]
    deviations: Float[np.ndarray, "t p"]
    alike: Float[np.ndarray, " t"]
    failed: Bool[np.ndarray, " t"]
    shown: Bool[np.ndarray, "t k"]

    def __len__(self) -> int:
        return len(self.failed)

    def motion(self, frame: int) -> Motion:
        """Returns the head's motion at a frame."""
        return Motion(RigidTransform(self.rotations[frame], self.translations[frame]), self.weights[frame])


@dataclass(frozen=True, slots=True, eq=False)
class Tracker:
    """Holds what the tracking of all frames has in common: person, sample points, reference texture, face networks."""

    person: SequencePerson
    samples: Samples
    levels: Levels
    reference: FaceReference
    networks: FaceNetworks

    def track(self, pictures: Pictures, start: Motion) -> Tracked | None:
        """Fits one frame, starting from a predicted motion. Returns None if the head is not found in the frame."""
        if len(pictures) < MIN_VIEWS:
            return None
        found = self.fit(pictures, start)
        if found.alike >= MIN_ALIKE:
            return found
        again = self._searched(pictures, start)
        found = None if again is None else self.fit(pictures, again)
        return found if found is not None and found.alike >= MIN_ALIKE else None

    def begin(self, pictures: Pictures) -> Tracked | None:
        """Fits a frame without a previous frame, in two rounds: the second starts from the result of the first."""
        found = self.track(pictures, self.person.motions[0])
        return None if found is None else self.track(pictures, found.motion)

    def fit(self, pictures: Pictures, start: Motion) -> Tracked:
        """Fits one frame, starting from a motion near the solution."""
        found = sight(self.person, self.networks, pictures, start)
        terms = terms_of(self.reference, self.person.rig, found)
        return fit_frame(self.person, self.samples, self.levels, pictures, start, terms)

    def _searched(self, pictures: Pictures, start: Motion) -> Motion | None:
        matched = find_subject(pictures, self.person.rig, self.networks).matched
        if matched is None:
            return None
        head = landmarks_of(self.person, start.weights)
        return replace(start, world_from_head=rigid_fit(head, matched.points_world))


def make_tracker(footage: Footage, person: SequencePerson) -> Tracker:
    """Computes the person's reference appearance from the frames from which the person was estimated."""
    networks, samples = load_networks(), spread(person)
    shown = [(next(footage.read(key)), motion) for key, motion in zip(person.keys, person.motions, strict=True)]
    tracker = _learn(person, samples, networks, shown)
    shown = [(pictures, tracker.fit(pictures, motion).motion) for pictures, motion in shown]
    return _learn(person, samples, networks, shown)  # refitting each frame to all of them makes their textures agree


def _learn(
    person: SequencePerson, samples: Samples, networks: FaceNetworks, shown: list[tuple[Pictures, Motion]]
) -> Tracker:
    levels = {reduced: observe(person, samples, shown, reduced) for reduced in REDUCED}
    return Tracker(person, samples, levels, refer(person, networks, shown), networks)


def track_sequence(
    footage: Footage, model: HeadModel, settings: Settings, kept: Path, *, renderer: Renderer, report: Progress,
    share: tuple[int, int] = (1, 1),
) -> tuple[SequencePerson, Course | None]:  # fmt: skip
    """Tracks a head through all frames of a sequence. ``kept`` is the folder that stores finished chunks. ``share`` (k,
    n) tracks only part k of n of the sequence, k from 1. Returns the person and the unsmoothed course; the course is
    None while chunks of other shares are missing. Raises the errors of ``find_person``."""
    inputs = json.dumps(inputs_of(footage, model, settings)).encode()
    if not (kept / INPUTS).is_file() or (kept / INPUTS).read_bytes() != inputs:
        for path in kept.glob("*.npz"):
            path.unlink()
        write_atomically(kept / INPUTS, inputs)
    person = _kept_person(kept / "person.npz", footage, model)
    if person is None:
        found = find_person(footage, model, settings, renderer, lambda done: report("identity", SHARE * done))
        if not (kept / "person.npz").is_file():  # another share may have written it
            _keep_person(kept / "person.npz", found)
        person = _kept_person(kept / "person.npz", footage, model)
        assert person is not None
    paths = {first: kept / f"{first:07}.npz" for first in range(0, len(footage.frames), CHUNK)}
    firsts = np.array_split(list(paths), share[1])[share[0] - 1].tolist()
    missing = {first: paths[first] for first in firsts if not paths[first].is_file()}
    if missing:
        _track_chunks(footage, person, missing, report)
    if not all(path.is_file() for path in paths.values()):
        return person, None
    parts = [_read_kept(path) for path in paths.values()]
    return person, Course(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Course)))


def _track_chunks(footage: Footage, person: SequencePerson, missing: Mapping[int, Path], report: Progress) -> None:
    """Tracks the missing chunks and writes each to its file."""
    tracker, count = make_tracker(footage, person), len(footage.frames)
    at, pictures = -1, iter(())
    for first, path in missing.items():
        if first != at:  # else the films stand there: to open them anew would decode all that is before
            pictures = footage.read(first)
        at = min(first + CHUNK, count)
        course = _track_chunk(tracker, pictures, range(first, at), count, report)
        write_arrays(path, **{each.name: getattr(course, each.name) for each in fields(Course)})


def _track_chunk(tracker: Tracker, pictures: Iterator[Pictures], frames: range, count: int, report: Progress) -> Course:
    """Tracks the pictures of one chunk, whose frame numbers are ``frames``, in a sequence of ``count`` frames."""
    found, shown, last = list[Tracked | None](), list[list[bool]](), list[Motion]()
    for number, taken in zip(frames, pictures, strict=False):  # takes no picture after the last frame
        report(f"frame {number + 1} of {count}", SHARE + (1.0 - SHARE) * number / count)
        tracked = tracker.track(taken, extrapolate_motion(last)) if last else tracker.begin(taken)
        found.append(tracked)
        shown.append([name in taken for name in tracker.person.rig.names])
        if tracked is not None:
            last = [*last[-1:], tracked.motion]
    nowhere = tracker.person.motions[0]
    lost = Tracked(nowhere, np.full(POSE + len(nowhere.weights), np.inf), 0.0)
    whole = [lost if each is None else each for each in found]
    return Course(
        np.stack([each.motion.weights for each in whole]),
        np.stack([each.motion.world_from_head.rotation for each in whole]),
        np.stack([each.motion.world_from_head.translation for each in whole]),
        np.stack([each.deviation for each in whole]),
        np.array([each.alike for each in whole]),
        np.array([each is None for each in found]),
        np.array(shown),
    )


def extrapolate_motion(last: list[Motion]) -> Motion:
    """Extrapolates the head's motion from the last two frames; the head keeps the fraction ``KEPT`` of its speed."""
    if len(last) < 2:
        return last[-1]
    before, now = (each.world_from_head for each in last)
    turn = rotation_from_vector(KEPT * vector_from_rotation(now.rotation @ before.rotation.T))
    shift = now.translation + KEPT * (now.translation - before.translation)
    return replace(last[-1], world_from_head=RigidTransform(turn @ now.rotation, shift))


def smooth_course(course: Course) -> Course:
    """Returns the course smoothed over time; failed frames get a pose and standard deviations by interpolation."""
    if course.failed.all():
        return course
    middle = course.rotations[np.flatnonzero(~course.failed)[0]]
    turns = np.stack([vector_from_rotation(each @ middle.T) for each in course.rotations])
    measured = np.concatenate([turns, course.translations, course.weights], axis=1)
    alone = [np.array([row]) for row in range(POSE, measured.shape[1])]
    found, spread_of = smooth(measured, course.deviations, course.failed, [np.arange(3), np.arange(3, POSE), *alone])
    return replace(
        course,
        weights=np.clip(found[:, POSE:], 0.0, 1.0),
        rotations=rotation_from_vector(found[:, :3]) @ middle,
        translations=found[:, 3:POSE],
        deviations=spread_of,
    )


def inputs_of(footage: Footage, model: HeadModel, settings: Settings) -> dict[str, Any]:
    """Returns what a sequence's result depends on: its files by name, size and time, the head model, the settings, the
    number of frames in a chunk, and the program's version."""
    digest, paths = hashlib.sha256(), sorted(path for path in footage.folder.rglob("*") if path.is_file())
    for path in paths:
        status = path.stat()
        digest.update(f"{path.relative_to(footage.folder).as_posix()} {status.st_size} {status.st_mtime_ns}\n".encode())
    return {
        "files_sha256": digest.hexdigest(),
        "times_s": footage.times_s.tolist(),
        "model_sha256": model.sha256,
        "settings": document_from_settings(settings),
        "chunk": CHUNK,
        "version": version("eigenhead"),
    }


def _read_kept(path: Path) -> Course:
    with np.load(path, allow_pickle=False) as arrays:
        return Course(*(arrays[each.name] for each in fields(Course)))


def _keep_person(path: Path, person: SequencePerson) -> None:
    poses = [each.world_from_head for each in person.motions]
    write_arrays(
        path,
        names=np.array(person.names),
        neutral=person.neutral,
        shapes=person.shapes,
        keys=np.array(person.keys),
        warnings=np.array(json.dumps(documents_of(person.warnings))),
        weights=np.stack([each.weights for each in person.motions]),
        rotations=np.stack([each.rotation for each in poses]),
        translations=np.stack([each.translation for each in poses]),
        camera_rotations=np.stack([each.camera_from_world.rotation for each in person.rig]),
        camera_translations=np.stack([each.camera_from_world.translation for each in person.rig]),
    )


def _kept_person(path: Path, footage: Footage, model: HeadModel) -> SequencePerson | None:
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as arrays:
        a = dict(arrays)
    placed = [RigidTransform(*pose) for pose in zip(a["camera_rotations"], a["camera_translations"], strict=True)]
    cameras = [replace(camera, camera_from_world=pose) for camera, pose in zip(footage.work, placed, strict=True)]
    motions = [
        Motion(RigidTransform(rotation, shift), weights)
        for rotation, shift, weights in zip(a["rotations"], a["translations"], a["weights"], strict=True)
    ]
    rig = replace(footage.work, cameras=tuple(cameras))
    keys, warnings = tuple(map(int, a["keys"])), tuple(map(read_message, json.loads(str(a["warnings"]))))
    names = tuple(map(str, a["names"]))
    return SequencePerson(model, names, a["neutral"], a["shapes"], rig, keys, tuple(motions), warnings)


def write_arrays(path: Path, **arrays: Any) -> None:
    """Writes arrays as .npz, under a temporary name first. Equal arrays give files with equal bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_atomically(path, buffer.getvalue())
