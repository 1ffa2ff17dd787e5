"""Finds the head in one set of pictures after the other, in a child process that remembers the last head.

The pictures arrive already reduced in size. Light and sharpness are measured on the pictures, sharpness for one camera
in each set; faces are searched at ``SMALL_PX``. A missing face is searched again in one camera of each set.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.applications.moments.live_head import MESH, LiveHead, follow, meet
from pipeline.faces.detection import find_large_faces, make_pyramid
from pipeline.faces.eyes import closed_by_openings
from pipeline.faces.networks import LANDMARKS, FaceNetworks, load_networks
from pipeline.faces.points import place_face
from pipeline.faces.sighting import GLANCE, MUST_SEE, reduce_picture, turned_deg
from pipeline.faces.subject import find_subject
from pipeline.head_model.model import HeadModel, load_model
from rig.acquisition.image_checks import blur_px, exposure
from rig.acquisition.plates import read_plates
from rig.camera import Camera
from rig.capture import ImageRgb
from rig.errors import InputError
from rig.rig import Rig
from server.services.live.seen import CameraSeen, HeadOut, Numbers, Seen
from server.tasks.child import WorkerContext

SMALL_PX = 320
BLUR_WIDTH_PX = 640  # of a picture in whose pixels sharpness is told
ROOM, DEPTH = 0.15, 0.07  # of the front picture's height, of its distance: how far the head may be from where all look
MIDDLE = 0.25  # of the picture's sides: the face's middle is no nearer to an edge
WHOLE = 0.97  # share of the head's vertices in the picture
STILL_MM = 4.0  # from look to look
MIN_FACE_PX = 40  # of a face, for its sharpness to be measured
FACE_MARGIN = 0.15  # of the face's size, about the landmarks: sharpness is measured there
SAME = 8.0  # largest change of a thumbnail of pictures without a head: they are not searched again
THUMBNAIL, PARTS = (16, 12), (64, 48)  # pixels
SHOWN = 6  # every sixth landmark is handed out


@dataclass(slots=True)
class Kept:
    """Holds the state that the child process keeps from set to set."""

    rig: Rig | None = None  # as calibrated
    head: LiveHead | None = None
    plates: tuple[str, Mapping[str, np.ndarray]] = ("", {})  # the light of a version of the clean plates
    fruitless: Mapping[str, np.ndarray] = field(default_factory=dict)  # thumbnails in which no head was found
    searched: int = 0  # cameras in which strangers were searched, in turn
    count: int = 0  # of looks
    points: np.ndarray | None = None  # of the last head
    blur: dict[str, float | None] = field(default_factory=dict)  # as measured last


def look(
    context: WorkerContext,
    pictures: Mapping[str, bytes | ImageRgb],
    rig: Rig | None,
    front: str | None,
    plates: tuple[str, str] | None,
) -> Seen:
    """Finds the head in a set of pictures, and measures every camera's picture.

    ``pictures``: by camera, bytes being JPEG files; ``rig``: the calibrated cameras, at any size; ``front``: the camera
    that the subject looks at; ``plates``: folder and version of the clean plates.
    """
    kept: Kept = context.keep("live", Kept)
    cv2.setNumThreads(1)  # a job may run beside
    images = {name: image for name, picture in pictures.items() if (image := _read(picture)) is not None}
    empty = _plates(kept, plates, tuple(pictures))
    seen = {name: _lit(image, empty.get(name)) for name, image in images.items()}
    if rig is None:
        return Seen(seen, None, False, False)
    cameras = {name: rig[name] for name in images if name in rig and _fits(rig[name], images[name])}
    small = {name: _small(images[name], camera) for name, camera in cameras.items()}
    scaled = Rig(tuple(camera for _, camera in small.values())) if small else None
    faces = _find(context, kept, {name: image for name, (image, _) in small.items()}, scaled)
    head = kept.head
    missing = tuple(name for name in rig.names if name not in images)
    if head is None or scaled is None:
        return Seen(seen, None, faces, True, missing)
    seen |= {camera.name: _with_head(seen[camera.name], camera, head) for camera in scaled}
    _measure_sharpness(kept, seen, images, scaled, head)
    _search_stranger(context, kept, seen, small)
    return Seen(seen, _head(head, rig, scaled, front), faces, True, missing)


def _read(picture: bytes | ImageRgb) -> ImageRgb | None:
    """Returns a picture, or None for a file that cannot be decoded; its camera then counts as one without a picture."""
    if not isinstance(picture, bytes):
        return picture
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR_RGB) if picture else None
    return None if pixels is None else np.asarray(pixels, np.uint8)


def _fits(camera: Camera, image: ImageRgb) -> bool:
    lens = camera.intrinsics
    return abs(lens.height * image.shape[1] / lens.width - image.shape[0]) < 1.5


def _small(image: ImageRgb, camera: Camera) -> tuple[ImageRgb, Camera]:
    """Returns a picture reduced to ``SMALL_PX``, without lens distortion if the camera is calibrated."""
    at_size = replace(camera, intrinsics=camera.intrinsics.at_size(image.shape[1], image.shape[0]))
    if camera.recorded is not None:
        image = camera.recorded.undistort(image, at_size.intrinsics.matrix())
    return reduce_picture(image, at_size, SMALL_PX)


def _plates(kept: Kept, plates: tuple[str, str] | None, names: tuple[str, ...]) -> Mapping[str, np.ndarray]:
    """Returns the brightness of the clean plates."""
    if plates is None:
        return {}
    folder, version = plates
    if kept.plates[0] != version:
        try:
            read = read_plates(Path(folder), names).first
        except InputError:
            read = {}
        kept.plates = (version, {name: _light(plate) for name, plate in read.items()})
    return kept.plates[1]


def _light(image: ImageRgb) -> Float[np.ndarray, "h w"]:
    """Returns the brightness of a picture in blocks, each an average of many pixels."""
    return cv2.resize(image, PARTS, interpolation=cv2.INTER_AREA).mean(axis=2) + 1.0


def _find(context: WorkerContext, kept: Kept, small: Mapping[str, ImageRgb], rig: Rig | None) -> bool:
    """Finds the head, first near its last pose, and stores it in ``kept``. Returns whether any picture shows a face."""
    networks: FaceNetworks = context.keep("face networks", load_networks)
    if kept.head is not None and rig is not None and _same(kept.head.who.person.rig, rig):
        kept.head = follow(kept.head, small, networks)
        if kept.head is not None:
            return True
    kept.head, thumbs = (
        None,
        {name: cv2.resize(image, THUMBNAIL, interpolation=cv2.INTER_AREA) for name, image in small.items()},
    )
    if rig is None or _alike(thumbs, kept.fruitless):
        return False
    subject = find_subject(small, rig, networks, effort=GLANCE)
    if subject.matched is not None:
        model: HeadModel = context.keep("live model", load_model)
        kept.head = meet(model, subject.matched, small, rig, networks)
    any_face = any(subject.found.values())
    kept.fruitless = {} if any_face or kept.head is not None else thumbs
    return any_face


def _same(before: Rig, now: Rig) -> bool:
    """Returns whether two rigs have the same cameras with the same poses, ignoring cameras without a picture."""
    return all(camera.name in before and _placed(camera) == _placed(before[camera.name]) for camera in now)


def _placed(camera: Camera) -> tuple[bytes, tuple[float, ...]]:
    lens, pose = camera.intrinsics, camera.camera_from_world
    return pose.rotation.tobytes() + pose.translation.tobytes(), (lens.width, lens.fx, lens.fy, lens.cx, lens.cy)


def _alike(thumbs: Mapping[str, np.ndarray], before: Mapping[str, np.ndarray]) -> bool:
    return thumbs.keys() == before.keys() and all(
        float(np.abs(thumb.astype(float) - before[name]).max()) < SAME for name, thumb in thumbs.items()
    )


def _lit(image: ImageRgb, plate: Float[np.ndarray, "h w"] | None) -> CameraSeen:
    """Measures a picture's brightness relative to its clean plate, because most of the picture is background."""
    light = exposure(image)
    share = None if plate is None else float(np.median(_light(image) / plate))
    return CameraSeen(light.mean, share, float(light.clipped_share), None)


def _with_head(seen: CameraSeen, camera: Camera, head: LiveHead) -> CameraSeen:
    """Adds the position of the head in a picture."""
    size = np.array([camera.intrinsics.width, camera.intrinsics.height], float)
    facing, landmarks_px = head.facing[camera.name], head.sighting.pixels.get(camera.name)
    pixels = camera.project(head.points_world)
    if not np.isfinite(pixels).all():
        return replace(seen, facing=facing, centred=False)
    inside = ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1).mean()
    middle = (pixels[-LANDMARKS:].mean(axis=0) + 0.5) / size
    return replace(
        seen,
        facing=facing,
        face=True if landmarks_px is not None else False if facing >= MUST_SEE else None,
        centred=bool(inside >= WHOLE and (np.abs(middle - 0.5) < 0.5 - MIDDLE).all()),
        stranger=camera.name in head.strangers and facing >= MUST_SEE,
        points=()
        if landmarks_px is None
        else tuple(_rounded((point + 0.5) / size, 4) for point in landmarks_px[::SHOWN]),
    )


def _measure_sharpness(
    kept: Kept, seen: dict[str, CameraSeen], images: Mapping[str, ImageRgb], rig: Rig, head: LiveHead
) -> None:
    """Measures the sharpness of the face in one camera for each set of pictures, and adds the last known value of every
    camera. A moving head is not measured, since its blur is not the lens's."""
    before, kept.points = kept.points, head.points_world
    still = before is not None and float(np.linalg.norm(kept.points - before, axis=1).mean()) < STILL_MM
    kept.count += still
    for camera in rig.cameras[kept.count % 2 :: 2] if still else ():
        image = images[camera.name]
        face = (camera.project(head.landmarks_world) + 0.5) * image.shape[1] / camera.intrinsics.width - 0.5
        kept.blur[camera.name] = _blur_px(image, face) if np.isfinite(face).all() else None
    for camera in rig:
        seen[camera.name] = replace(seen[camera.name], blur_px=kept.blur.get(camera.name))


def _blur_px(image: ImageRgb, face: Float[np.ndarray, "n 2"]) -> float | None:
    """Measures the sharpness of a face with landmarks at these pixels."""
    margin = FACE_MARGIN * float(np.ptp(face, axis=0).max())
    low = np.maximum(face.min(axis=0) - margin, 0.0).astype(int)
    high = np.maximum(face.max(axis=0) + margin, 0.0).astype(int)
    part = image[low[1] : high[1], low[0] : high[0]]
    blur = blur_px(np.ascontiguousarray(part)) if min(part.shape[:2]) > MIN_FACE_PX else None
    return None if blur is None else BLUR_WIDTH_PX / image.shape[1] * blur


def _search_stranger(
    context: WorkerContext, kept: Kept, seen: dict[str, CameraSeen], small: Mapping[str, tuple[ImageRgb, Camera]]
) -> None:
    """Searches for a face in one of the cameras, in turn, that should show the head but do not."""
    lacking = [name for name, camera in seen.items() if camera.face is False and not camera.stranger and name in small]
    if lacking:
        kept.searched += 1
        name = lacking[kept.searched % len(lacking)]
        if find_large_faces(make_pyramid(small[name][0]), context.keep("face networks", load_networks)):
            seen[name] = replace(seen[name], stranger=True)


def _head(head: LiveHead, rig: Rig, scaled: Rig, front: str | None) -> HeadOut:
    pose, name = head.motion.world_from_head, front if front in rig.names else rig.front_camera()
    camera, centre = rig[name], rig.centre_world()
    face, _ = place_face(head.landmarks_world)
    left_deg, up_deg = turned_deg(face, rig, name)  # None where cameras stand all around: no way is the front
    view = camera.camera_from_world.rotation
    middle = (pose.translation + face.translation) / 2.0  # cameras are aimed at the head's middle, or at the face
    off = view @ (middle - centre)
    distance = float(np.linalg.norm(camera.centre_world - centre))
    vertices, openings = (head.vertices_world - pose.translation) @ view.T, head.sighting.openings
    return HeadOut(
        rotation=_rounded(pose.rotation.ravel(), 5),
        translation=_rounded(pose.translation, 2),
        scale=round(head.who.scale, 4),
        left_deg=round(left_deg or 0.0, 1),
        up_deg=round(up_deg or 0.0, 1),
        right_mm=round(float(off[0]), 1),
        down_mm=round(float(off[1]), 1),
        away_mm=round(float(off[2]), 1),
        room_mm=round(ROOM * camera.intrinsics.height / camera.intrinsics.fy * distance, 1),
        depth_mm=round(DEPTH * distance, 1),
        openings={side: round(opening, 3) for side, opening in openings.items()},
        eyes_open=not closed_by_openings(openings) if openings else None,
        vertices=tuple(_rounded(vertex, 1) for vertex in vertices),
        triangles=tuple(tuple(face) for face in head.who.person.model.levels[MESH].faces.tolist()),
    )


def _rounded(values: Float[np.ndarray, " n"], digits: int) -> Numbers:
    return tuple(round(float(value), digits) for value in values)
