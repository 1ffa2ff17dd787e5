"""Tracks a sequence from its folder, and writes the result files.

``sequence.npz``   frames (t), times_s, expressions (e), weights and weight_deviations (t e), rotations (t 3 3),
                   translations (t 3, mm; world_from_head), pose_deviations (t 6: rad, mm), alike (t: correlation of the
                   skin's texture with its reference), failed (t), skew_mm (t: how far the face moves between the first
                   and the last camera's exposure, by clock.json); all are smoothed over time
``person.npz``     names (e), neutral (v 3, head frame, mm), shapes (e v 3, mm at weight 1), the corrected cameras; the
                   head of a frame is rotation (neutral + sum of weights times shapes) + translation
``sequence.glb``   the animated head: expressions as morph targets, pose relative to the first frame
``sequence.usdc``  the same as a point cache of OpenUSD, if requested
``preview.mp4``    the front camera's pictures beside the rendered head
``report.json``    the report, written last
``.chunks/``       stored chunks, with which a run continues after an interruption
"""

import json
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.applications.moments.animated_glb import animated
from pipeline.applications.moments.footage import Footage, open_footage
from pipeline.applications.moments.point_cache import write_point_cache
from pipeline.applications.moments.sequence import Course, smooth_course, track_sequence, write_arrays
from pipeline.applications.moments.sequence_person import Motion, SequencePerson
from pipeline.applications.moments.track_frame import POSE
from pipeline.geometry.projection import picture
from pipeline.head_model.expressions import plain_name
from pipeline.head_model.model import load_model
from pipeline.settings import Settings
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.files import write_atomically
from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.scene import Part, Scene
from rig.formats.meshes.usdz import check_usd
from rig.geometry import RigidTransform
from rig.mesh import Mesh, vertex_normals
from rig.messages.message import compose, documents_of
from rig.progress import Progress
from rig.render.renderer import Renderer

FORMAT = "eigenhead-sequence/1"
FILES = ("sequence.npz", "person.npz", "sequence.glb", "preview.mp4", "report.json")
CHUNKS, CACHE = ".chunks", "sequence.usdc"
SKEWED_MM, SKEWED_SHARE = 1.0, 0.05  # motion between exposures that warns, in more than this share of the frames
USED = 0.02  # largest weight of an expression that is left out of sequence.glb
CLAY, LIGHT = np.array([198.0, 176.0, 158.0]), np.array([-0.35, 0.45, 0.82])  # colour; direction to it, camera's axes


def make_sequence(
    folder: Path, out: Path, *, model: str, settings: Settings, report: Progress, usd: bool = False,
    share: tuple[int, int] = (1, 1), kept: Path | None = None,
) -> dict[str, Any] | None:  # fmt: skip
    """Tracks the head of a sequence and writes the ``FILES`` into ``out``; with ``usd``, also sequence.usdc. The folder
    ``kept`` stores chunks (None: ``CHUNKS`` in ``out``). Returns the content of report.json. With a ``share`` (k, n)
    the function tracks part k of n of the frames, and returns None while frames of other shares are missing. Raises
    InputError for an invalid folder, every error of ``reconstruct``, UnknownModel or BadModel, NoUsd, and OSError."""
    if usd:
        check_usd()
    footage, head_model, kept = open_footage(folder), load_model(model), kept or out / CHUNKS
    with Renderer.create() as renderer:
        person, course = track_sequence(
            footage, head_model, settings, kept, renderer=renderer, report=report, share=share
        )
    if course is None:
        return None
    if course.failed.all():
        raise EigenheadError(compose("sequence-without-face"))
    found = smooth_course(course)
    write_arrays(
        out / "sequence.npz",
        frames=np.array(footage.frames),
        times_s=footage.times_s,
        expressions=np.array([plain_name(name) for name in person.names]),
        weights=found.weights,
        weight_deviations=found.deviations[:, POSE:],
        rotations=found.rotations,
        translations=found.translations,
        pose_deviations=found.deviations[:, :POSE],
        alike=found.alike,
        failed=found.failed,
        skew_mm=skew_mm(person, footage, found),
    )
    shutil.copyfile(kept / "person.npz", out / "person.npz")
    write_atomically(out / "sequence.glb", animation_of(person, footage, found))
    if usd:
        faces = person.model.levels["full"].faces
        heads = [
            pose.apply(person.head(weights))
            for pose, weights in zip(poses_from_first(found), found.weights, strict=True)
        ]
        write_point_cache(out / CACHE, heads, faces, footage.times_s)
    write_preview(out / "preview.mp4", person, footage, found, report)
    document = document_of(person, footage, found)
    write_atomically(out / "report.json", json.dumps(document, indent=1, allow_nan=False).encode())
    return document


def skew_mm(person: SequencePerson, footage: Footage, course: Course) -> Float[np.ndarray, " t"]:
    """Returns, for each frame, the landmarks' mean motion (mm) between the first and the last camera's exposure."""
    rows = list(person.model.landmarks.values())
    moved = person.neutral[rows] + np.einsum("te,emx->tmx", course.weights, person.shapes[:, rows])
    places = np.einsum("txy,tmy->tmx", course.rotations, moved) + course.translations[:, None]
    speed_mm_s = np.linalg.norm(np.gradient(places, footage.times_s, axis=0), axis=2).mean(axis=1)
    return footage.spread_s * speed_mm_s


def document_of(person: SequencePerson, footage: Footage, course: Course) -> dict[str, Any]:
    """Returns the content of a sequence's report.json."""
    failed = [frame for frame, lost in zip(footage.frames, course.failed, strict=True) if lost]
    lost = compose("sequence-frames-failed", count=len(failed), all=len(course), frames=failed[:10])
    skewed = np.count_nonzero(skew_mm(person, footage, course) > SKEWED_MM)
    torn = compose(
        "sequence-skewed", count=skewed, all=len(course), spread_ms=1000.0 * footage.spread_s, most_mm=SKEWED_MM
    )
    missing = dict(zip(footage.rig.names, np.count_nonzero(~course.shown, axis=0).tolist(), strict=True))
    missing = {name: count for name, count in missing.items() if count}
    gaps = compose("sequence-pictures-missing", count=sum(missing.values()), cameras=list(missing))
    doubts = (lost, failed), (gaps, missing), (torn, skewed > SKEWED_SHARE * len(course))
    warnings = [*person.warnings, *(said for said, holds in doubts if holds)]
    turn, shift = (np.median(course.deviations[:, rows], axis=0) for rows in (slice(3), slice(3, POSE)))
    return {
        "format": FORMAT,
        "version": version("eigenhead"),
        "model": {"name": person.model.name, "sha256": person.model.sha256},
        "frames": len(course),
        "duration_s": float(footage.times_s[-1] - footage.times_s[0]),
        "cameras": list(footage.rig.names),
        "identity_frames": [footage.frames[key] for key in person.keys],
        "failed": failed,
        "pictures_missing": missing,
        "deviation": {"rotation_deg": np.degrees(turn).tolist(), "translation_mm": shift.tolist()},
        "alike": {
            "median": float(np.median(course.alike)),
            "least": float(course.alike[~course.failed].min(initial=1.0)),
        },
        "warnings": documents_of(warnings),
    }


def animation_of(person: SequencePerson, footage: Footage, course: Course) -> bytes:
    """Returns the bytes of sequence.glb, the animated head."""
    used = np.flatnonzero(course.weights.max(axis=0) > USED)
    faces = person.model.levels["full"].faces
    shapes = {plain_name(person.names[row]): person.shapes[row].astype(float) for row in used}
    extras = {"unit": "m", "frame": "head", "model": {"name": person.model.name, "sha256": person.model.sha256}}
    still = scene_glb_bytes(Scene([Part("head", Mesh(person.neutral, faces), None, None, shapes)]), extras)
    return animated(still, footage.times_s - footage.times_s[0], course.weights[:, used], poses_from_first(course))


def poses_from_first(course: Course) -> list[RigidTransform]:
    """Returns the head's pose in every frame, relative to its pose in the first frame."""
    first = RigidTransform(course.rotations[0], course.translations[0]).inverse()
    return [first @ RigidTransform(*pose) for pose in zip(course.rotations, course.translations, strict=True)]


def write_preview(path: Path, person: SequencePerson, footage: Footage, course: Course, report: Progress) -> None:
    """Writes preview.mp4, the front camera's pictures beside the rendered head. Several shares may each write it."""
    name, count = person.rig.front_camera(), len(course)
    camera = person.rig[name]
    size = 2 * camera.intrinsics.width, camera.intrinsics.height
    rate = (count - 1) / max(float(footage.times_s[-1] - footage.times_s[0]), 1e-6)
    with tempfile.TemporaryDirectory() as scratch:
        draft = Path(scratch) / path.name
        film = cv2.VideoWriter(str(draft), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
        try:
            for number, pictures in enumerate(footage.read(cameras=(name,))):
                report("preview", number / count)
                clay = draw_clay(person, camera, course.motion(number))
                photo = pictures.get(name, np.zeros_like(clay))
                film.write(np.ascontiguousarray(np.concatenate([photo, clay], axis=1)[:, :, ::-1]))
        finally:
            film.release()
        write_atomically(path, draft.read_bytes())


def draw_clay(person: SequencePerson, camera: Camera, motion: Motion) -> UInt8[np.ndarray, "h w 3"]:
    """Draws the head of a frame as grey clay, in the view of a camera."""
    faces = person.model.levels["full"].faces
    head = motion.world_from_head.apply(person.head(motion.weights))
    return picture(camera, head, faces, clay_colours(vertex_normals(head, faces), camera), (255, 255, 255))


def clay_colours(normals: Float[np.ndarray, "v 3"], camera: Camera) -> UInt8[np.ndarray, "v 3"]:
    """Returns vertex colours of grey clay under a lamp at the camera, from unit normals in the world frame."""
    towards = camera.camera_from_world.rotation.T @ (LIGHT * (1.0, -1.0, -1.0))
    shade = 0.25 + 0.75 * np.clip(normals @ towards / np.linalg.norm(LIGHT), 0.0, 1.0)
    return np.clip(CLAY * shade[:, None] * 1.2, 0, 255).astype(np.uint8)
