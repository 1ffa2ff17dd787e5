"""Checks an uploaded archive or a capture folder before it is accepted; runs in a child process.

Files are checked camera by camera, so that a rig of 64 large cameras needs the memory of one; outlines are checked at
the reduced size of jobs, or smaller.
"""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.alignment.feature_checks import feature_faults, unknown_landmarks
from pipeline.faces.matching import EYE_DISTANCE_MM
from pipeline.faces.networks import DamagedNetwork, FaceNetworks, load_networks
from pipeline.faces.sighting import GLANCE, GLANCE_PX, SMALLEST_PX, reduce_picture, sight_face
from pipeline.faces.subject import SearchEffort, find_subject
from pipeline.view_checks.one_moment import judge_moments
from pipeline.warnings import ReportWarning
from rig.acquisition.face_sighting import FaceSighting
from rig.acquisition.verdict import ViewCheck, check_view, view_faults
from rig.camera import Camera
from rig.capture import TEXTURE_SETS, Capture
from rig.errors import EigenheadError, InputError
from rig.files import sha256_of
from rig.formats.cameras.cameras_file import NO_RIG, rig_file_parts
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.cameras.scale_json import read_scale
from rig.formats.captures.archive import ArchiveLimits, extract_archive
from rig.formats.captures.capture_folder import (
    FEATURES,
    SCALE,
    capture_root,
    has_known_length,
    judge_lost,
    open_capture,
    read_shot,
)
from rig.formats.captures.features_json import FEATURES_FORMAT, features_from_bytes
from rig.formats.captures.shot_files import ASIDE, BESIDE_PICTURES, ShotFiles, picture_folder
from rig.formats.pictures.images import IMAGE_SUFFIXES, picture_size
from rig.formats.pictures.picture_names import entry
from rig.formats.pictures.work_size import WORK_PIXELS
from rig.formats.rig_toml import ShotConfig
from rig.image import ImageRgb, plates_for
from rig.messages.message import Message, compose, say_once
from rig.progress import Progress
from rig.rig import Rig
from server.storage.records import CameraSize, CaptureContent
from server.tasks.child import WorkerContext
from server.tasks.film import ingest_film, is_film
from server.tasks.photographs import (
    CAMERAS,
    FIGURES,
    JSON_BYTES_MOST,
    calibrate_photographs,
    check_sizes,
    photographs_alone,
    read_scaled_capture,
)

if TYPE_CHECKING:
    from pipeline.imaging.silhouette import Silhouette
    from pipeline.settings import Settings

UPLOAD_PIXELS = 64_000_000  # of all pictures whose outlines are checked: 1.3 GB with plates and distances, of 4 GiB
PICTURES_MOST = 16  # of the largest size that one camera may have: picture, mask, eight plates, six texture sets
Points = dict[str, dict[str, list[float]]]  # pixels by point and camera, as features.json has them


def ingest_archive(
    context: WorkerContext, report: Progress, *, archive: str, folder: str, limits: ArchiveLimits, image_pixels: int
) -> CaptureContent:
    """Unpacks the archive of a capture or film, checks it, and leaves in ``folder`` exactly its files. Photographs
    without cameras are calibrated first.

    Returns the content for the capture's record. Raises InputError naming every fault; the folder is then unusable.
    """
    target = Path(folder)
    unpacked = target.with_name(target.name + ".unpacked")
    extract_archive(Path(archive), unpacked, limits)
    root = capture_root(unpacked)
    if is_film(root):
        return ingest_film(root, target, image_pixels, report)
    warnings = _calibrate(root, image_pixels, report) if photographs_alone(root) else None
    networks = _face_networks(context)
    described = check_capture(root, image_pixels, report, networks=networks)
    if warnings is not None:
        described = _with_calibration(described, root, warnings)
    elif all(fault.camera is not None for fault in described.faults):  # else there is nobody to find outlines of
        findings = _outline_findings(root, len(described.cameras), networks, report)
        described = replace(described, warnings=findings, face=_beside(described.face, findings))
    filed = _filed_names(root)
    for name in described.inputs:
        path = target / filed.get(name, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        entry(root, name).rename(path)
    shutil.rmtree(unpacked)
    inputs = {filed.get(name, name): digest for name, digest in described.inputs.items()}
    return replace(described, inputs=dict(sorted(inputs.items())))


def _beside(face: FaceSighting | None, findings: tuple[ReportWarning, ...]) -> FaceSighting | None:
    """Drops remarks on the face in reduced pictures that the full check also makes."""
    said = {finding.code for finding in findings}
    return face and replace(face, remarks=tuple(remark for remark in face.remarks if remark.code not in said))


def _outline_findings(
    root: Path, cameras: int, networks: FaceNetworks | None, report: Progress
) -> tuple[ReportWarning, ...]:
    """Returns the warnings of ``eigenhead check``. Raises InputError for cameras that contradict the pictures. Too few
    usable outlines are only a warning here, because the photographs cannot be taken again, and other settings may
    help."""
    from pipeline.settings import Settings
    from pipeline.view_checks.usable_views import TooFewViews

    shot, rig = read_scaled_capture(root, pixels_most=min(WORK_PIXELS, UPLOAD_PIXELS // cameras))
    try:
        return check_views(shot, rig, Settings(), networks, report=report)
    except TooFewViews as error:
        return (compose("pose-doubtful", finding=error.message), *shot.remarks)
    except (InputError, DamagedNetwork):
        raise
    except EigenheadError as error:
        raise InputError("capture", [error.message]) from error


def check_views(
    shot: Capture, rig: Rig, chosen: "Settings", networks: FaceNetworks | None, *, report: Progress
) -> tuple[ReportWarning, ...]:
    """Returns findings of outlines and faces on a capture's pictures and cameras, and all remarks on its files; faces
    are searched only with ``networks``. Raises the errors of the checks."""
    from pipeline.segmentation.segment import segment
    from pipeline.settings import OutputSettings
    from pipeline.texturing.chart_colours import measure_charts
    from pipeline.view_checks.guards import Guards
    from pipeline.view_checks.lens_distortion import judge_distortion
    from pipeline.view_checks.usable_views import usable_views
    from server.tasks.prepare import prepare_kernels

    prepare_kernels(report, replace(chosen, detail="span", outputs=OutputSettings(surface="head")))  # no dense loops

    def segmented(capture: Capture) -> "dict[str, Silhouette]":
        return segment(capture, rig, report=report)

    views = usable_views(shot, rig, segmented, exchanged=chosen.exchanged_pictures, guards=Guards(chosen.anyway))
    images, without_eyes = views.capture.images, SearchEffort(with_eyes=False)
    lenses = judge_distortion(images, views.silhouettes, rig)
    faces = find_subject(images, rig, networks, effort=without_eyes) if networks and chosen.faces.find else None
    charts = measure_charts(shot, rig)[1] if chosen.texture.chart else ()
    return (*chosen.warnings, *views.warnings, *lenses, *judge_moments(faces, rig), *charts)


def _calibrate(root: Path, image_pixels: int, report: Progress) -> tuple[ReportWarning, ...]:
    """Estimates cameras.json and calibration.json for photographs without cameras, and keeps only the registered
    photographs. Raises InputError with the views that could not be registered."""
    from calibration.result import CalibrationRefused

    files = [path for path in picture_folder(root).rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES]
    check_sizes(files, image_pixels)
    try:
        warnings = calibrate_photographs(root, root, front=None, report=report)
    except InputError as error:
        raise InputError("capture", [NO_RIG, *error.faults]) from error
    except CalibrationRefused as refusal:
        fault = compose("photographs-do-not-tell", no_rig=NO_RIG)
        raise InputError("capture", [fault, *refusal.reasons]) from refusal
    _leave_out(root, read_rig(root / CAMERAS))
    return warnings


def _filed_names(root: Path) -> dict[str, str]:
    """Maps the names in the archive to the service's names: images/<camera>.<ext>, masks/<camera>.<ext>,
    texture_sets/<set>/<camera>.<ext>, background/<camera>.<ext> or background/<camera>/<anything>."""
    (rig_file, *_), read, files, _ = open_capture(root)
    filed = {rig_file.name: CAMERAS} if rig_file == entry(root, CAMERAS) else {}
    for name in read.rig.names:
        of_camera = files.of_camera(name)
        several = sum(kind == "background" for kind, _ in of_camera) > 1
        for kind, path in of_camera:
            called = path.name if path.stem == name else name + path.suffix.lower()
            inside = kind == "background" and (several or path.parent.name == name)
            filed[path.relative_to(root).as_posix()] = f"{kind}/{name}/{path.name}" if inside else f"{kind}/{called}"
    return filed


def _leave_out(root: Path, rig: Rig) -> None:
    """Removes the files of views that could not be registered; the warnings name these views."""
    sets = [path for path in (root / TEXTURE_SETS).glob("*") if path.is_dir()]
    for folder in (picture_folder(root), *(root / kind for kind in BESIDE_PICTURES), *sets):
        for path in [*folder.iterdir()] if folder.is_dir() else ():
            is_candidate = path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES
            if is_candidate and (path.name if path.is_dir() else path.stem) not in rig and path.name not in ASIDE:
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _with_calibration(found: CaptureContent, root: Path, warnings: tuple[ReportWarning, ...]) -> CaptureContent:
    """Adds the figures of the calibration, which a job reads for its warnings."""
    inputs = dict(sorted({**found.inputs, FIGURES: sha256_of(root / FIGURES)}.items()))
    return replace(found, inputs=inputs, bytes=found.bytes + (root / FIGURES).stat().st_size, warnings=warnings)


def ingest_folder(
    context: WorkerContext, report: Progress, *, folder: str, image_pixels: int, measured: bool = False
) -> CaptureContent:
    """Checks a capture folder that the service itself has written, and returns its content. ``measured``: the pictures
    were measured at the shot, so only the subject is located. Raises InputError naming every fault."""
    return check_capture(Path(folder), image_pixels, report, measured=measured, networks=_face_networks(context))


def _face_networks(context: WorkerContext) -> FaceNetworks | None:
    """Returns the networks of this process; None if their files are damaged, which jobs report."""
    try:
        return context.keep("face networks", load_networks)
    except DamagedNetwork:
        return None


def ingest_board(context: WorkerContext, report: Progress, *, folder: str, image_pixels: int) -> CaptureContent:
    """Checks a shot of the calibration board and removes everything but each camera's image, of any size, from
    ``folder``. Returns the content for the capture's record. Raises InputError naming the images that are too large."""
    root = Path(folder)
    for path in root.iterdir():
        if path.name != "images":
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    files = sorted((root / "images").iterdir())
    check_sizes(files, image_pixels)
    sizes = {path.stem: picture_size(path) for path in files}
    return CaptureContent(
        cameras=tuple(CameraSize(name, width, height) for name, (width, height) in sizes.items()),
        front=files[0].stem,
        inputs={path.relative_to(root).as_posix(): sha256_of(path) for path in files},
        bytes=sum(path.stat().st_size for path in files),
        board=True,
    )


def check_capture(
    root: Path, image_pixels: int, report: Progress, *, measured: bool = False, networks: FaceNetworks | None = None
) -> CaptureContent:
    """Checks a capture folder and returns its content. Raises InputError naming every fault.

    ``measured``: only the subject's place is looked for in the pictures, since the shot measured the rest;
    ``networks``: look for the subject's face with these. Pictures that belong to no camera are no fault, since a
    reconstruction ignores them with a warning.
    """
    for path in (entry(root, name) for name in (CAMERAS, FEATURES, SCALE)):
        if path.is_file() and path.stat().st_size > JSON_BYTES_MOST:
            raise InputError(path.name, [compose("file-large", most_mib=JSON_BYTES_MOST >> 20)])
    rigs, read, files, faults = open_capture(root)
    rig_file, rig = rigs[0], read.rig
    digests: dict[str, str] = {}
    empty: list[str] = []
    views: dict[str, ViewCheck] = {}
    small: dict[str, tuple[ImageRgb, Camera]] = {}
    lost: dict[str, list[Message]] = {}
    for number, camera in enumerate(rig):
        report("check", number / len(rig))
        of_sizes, of_files = _size_faults(root, files, camera, image_pixels), list[Message]()
        if not of_sizes:
            shot, is_empty = _read_view(root, rig.subset([camera.name]), of_files, lost, files, digests)
            empty += [camera.name] if is_empty else []
            views |= _view_of(shot, camera.name, measured)
            image = shot.images.get(camera.name)
            if networks is not None and image is not None and min(image.shape[:2]) >= SMALLEST_PX:
                small[camera.name] = reduce_picture(image, camera, GLANCE_PX)
        faults += [*of_sizes, *of_files]
    if (features := entry(root, FEATURES)).is_file():
        of_points = feature_faults(features_from_bytes(features.read_bytes(), rig, faults), rig)
        faults += of_points
        digests[FEATURES] = sha256_of(features)
    losses = judge_lost(lost, rig, faults)
    kept = rig.subset([name for name in rig.names if name not in lost])
    if empty and len(empty) == len(kept):
        faults.append(compose("every-picture-its-plate"))
    if faults:
        raise InputError("capture", say_once(faults, rig.names))
    digests |= _camera_digests(root, rig_file, rig)
    for name in lost:  # kept, so that a job says what is wrong with them
        digests |= {path.relative_to(root).as_posix(): sha256_of(path) for _, path in files.of_camera(name)}
    is_metric = not (has_known_length(root) or (root / FIGURES).is_file())  # no length follows, or was assumed
    return CaptureContent(
        cameras=tuple(CameraSize(c.name, c.intrinsics.width, c.intrinsics.height) for c in kept),
        front=kept.front_camera(),
        inputs=dict(sorted(digests.items())),
        bytes=sum(entry(root, name).stat().st_size for name in digests),
        faults=tuple(view_faults(views, ShotConfig())),
        checks={name: view.document() for name, view in views.items()},
        warnings=tuple(losses),
        face=_face_of(small, kept, networks, is_metric=is_metric) if networks is not None and small else None,
    )


def _camera_digests(root: Path, rig_file: Path, rig: Rig) -> dict[str, str]:
    """Returns the SHA-256 of the rig's files and of scale.json. Raises InputError for a wrong scale.json."""
    digests = {path.relative_to(root).as_posix(): sha256_of(path) for path in rig_file_parts(rig_file)}
    if has_known_length(root):
        read_scale(entry(root, SCALE), rig.names)
        digests[SCALE] = sha256_of(entry(root, SCALE))
    return digests


def _face_of(
    small: Mapping[str, tuple[ImageRgb, Camera]], rig: Rig, networks: FaceNetworks, *, is_metric: bool
) -> FaceSighting:
    """Finds the subject's face in reduced pictures. ``is_metric``: the cameras are in millimetres."""
    images = {name: image for name, (image, _) in small.items()}
    reduced = Rig(tuple(camera for _, camera in small.values()))
    limits = EYE_DISTANCE_MM if is_metric else None
    subject = find_subject(images, reduced, networks, eye_distance_mm=limits, effort=GLANCE)
    sighting = sight_face(subject, reduced, front=rig.front_camera())
    return replace(sighting, remarks=(*sighting.remarks, *judge_moments(subject, reduced)))


def _view_of(shot: Capture, name: str, measured: bool) -> dict[str, ViewCheck]:
    """Checks one camera's picture; returns an empty mapping if it cannot be read."""
    image = shot.images.get(name)
    if image is None:
        return {}
    plates = plates_for(image, shot.backgrounds.get(name, ()))
    return {name: check_view(image, plates[0] if plates else None, shot.masks.get(name), place_only=measured)}


def _read_view(
    root: Path,
    rig: Rig,
    faults: list[Message],
    lost: dict[str, list[Message]],
    files: ShotFiles,
    digests: dict[str, str],
) -> tuple[Capture, bool]:
    """Reads the files of the single camera of ``rig``, at most two pictures at once, adds their SHA-256 to ``digests``,
    and unusable files to ``lost``. Returns the picture with its first plate and its mask, and whether the picture
    equals one of its clean plates pixel for pixel, which noise makes impossible for a real shot."""
    (name,) = rig.names
    first, *others = files.plates.get(name, ()) or (None,)
    plates = {} if first is None else {name: (first,)}
    read_part = partial(read_shot, root, rig, faults, with_features=False, with_cut_outs=False, lost=lost)
    shot = read_part(replace(files, plates=plates, texture_sets={}))
    digests |= shot.digests
    image = shot.images.get(name)
    is_empty = image is not None and any(np.array_equal(image, plate) for plate in shot.backgrounds.get(name, ()))
    alone = ShotFiles({}, {}, {}, (), ())
    more = [replace(alone, plates={name: (plate,)}) for plate in others]
    more += [replace(alone, texture_sets={kind: of_set}) for kind, of_set in files.texture_sets.items()]
    for part in more:
        read = read_part(part)
        digests |= read.digests
        is_empty |= image is not None and any(np.array_equal(image, plate) for plate in read.backgrounds.get(name, ()))
    return shot, is_empty


def check_features(context: WorkerContext, report: Progress, *, folder: str, points: Points) -> bytes:
    """Checks feature points (pixels, by point and camera) against the cameras of the capture in ``folder``. Returns the
    bytes of the features.json that holds them. Raises InputError naming every wrong point."""
    _, read, _, _ = open_capture(Path(folder))
    data = json.dumps({"format": FEATURES_FORMAT, "points": points}, indent=1).encode()
    # Points come one after the other: whether they suffice is asked when the job starts.
    of_file: list[Message] = []
    unknown = unknown_landmarks(features_from_bytes(data, read.rig, of_file))
    if of_file or unknown:
        raise InputError("features.json", [*of_file, *unknown])
    return data


def _size_faults(root: Path, files: ShotFiles, camera: Camera, image_pixels: int) -> list[Message]:
    """Returns faults of sizes as stated in file headers, before anything is decoded, since a small file may claim any
    size."""
    faults, pixels = list[Message](), 0
    for _, path in files.of_camera(camera.name):
        name = path.relative_to(root).as_posix()
        try:
            width, height = picture_size(path)
        except InputError:  # told when it is decoded
            continue
        pixels += width * height
        if width * height > image_pixels:
            faults.append(compose("picture-too-large", file=name, width=width, height=height, most=image_pixels))
    if pixels > PICTURES_MOST * image_pixels:
        faults.append(
            compose("camera-pixels-many", camera=camera.name, pixels=pixels, most=PICTURES_MOST * image_pixels)
        )
    return faults
