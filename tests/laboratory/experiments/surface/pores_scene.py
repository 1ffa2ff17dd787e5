"""Photographs a head with a known relief at 24 Mpx, as far as that matters.

The whole head is drawn at the size at which 24 Mpx are read, and parts of the full pictures are drawn beside it: what
shows the skin with the relief. The pictures of work size hold these parts reduced, as reading would; the full-size
pictures are the others enlarged, with these parts in them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32

from pipeline.head_model.model import HeadModel
from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import DEFAULT_DIRECTIONS_DEG, rig_from_directions
from rig.studio.scene.simulate import Scene, build_scene, shoot, view_light
from rig.studio.scene.subject import Subject, random_look, random_pose
from rig.studio.sensor.preset import PRESET, made_real
from rig.studio.sensor.sensor import expose
from tests.laboratory.experiments.paper.detail import IN_SPAN_MODES, IN_SPAN_SPREAD
from tests.support.drawn_relief import SkinRelief, draw_relief, relieved

FULL_PX = (5640, 4230)  # 24 Mpx, 0.1 mm a pixel at the face
SHARE = 0.4  # at which they are read: 3.8 Mpx
STEP_PX = 5  # full pixels that make two of work size
KEPT_BACK_DEG = (-20, 12)
RADIUS_MM, SLOPE = 20.0, 0.15  # furrows of 0.02 to 0.1 mm


@dataclass(frozen=True, slots=True, eq=False)
class CloseUpPart:
    """Holds a part of a full-size picture and the camera that takes it alone."""

    camera: Camera
    image: ImageRgb


@dataclass(frozen=True, slots=True, eq=False)
class CloseUp:
    """Holds a capture of work size with parts of its full-size pictures, and the relief that they show.

    Attributes:
        capture: at work size, without the view that is kept back.
        rig: of these pictures.
        scene: the truth at work size.
        relief: of the skin, head frame.
        parts: of the full-size pictures, by camera.
        kept_back: such a part of the camera that is not used.
    """

    capture: Capture
    rig: Rig
    scene: Scene
    relief: SkinRelief
    parts: Mapping[str, CloseUpPart]
    kept_back: CloseUpPart

    def read_original(self, name: str) -> ImageRgb:
        """Returns a picture at full size."""
        full = self.rig[name].intrinsics.at_size(*FULL_PX)
        image = cv2.resize(self.capture.images[name], FULL_PX, interpolation=cv2.INTER_CUBIC)
        if name in self.parts:
            part, lens = self.parts[name].image, self.parts[name].camera.intrinsics
            column, row = round(full.cx - lens.cx), round(full.cy - lens.cy)
            image[row : row + lens.height, column : column + lens.width] = part
        return image


def photograph_close_up(
    model: HeadModel, seed: int, renderer: Renderer, *, realism: tuple[str, ...] = (), slope: float = SLOPE
) -> CloseUp:
    """Draws a head, gives its cheek and forehead a relief, and photographs it."""
    level = model.levels["full"]
    rng = np.random.default_rng((34, seed))
    head = Mesh(model.vertices(IN_SPAN_SPREAD * rng.standard_normal(IN_SPAN_MODES)), level.faces)
    marks = {name: head.vertices[row] for name, row in model.landmarks.items()}
    relief = draw_relief(rng, _bare_places(head, marks), RADIUS_MM, slope)
    subject = Subject(head, marks, level.face_region, f"pores-{seed}")
    fine = Subject(relieved(head, relief), marks)
    plain = rig_from_directions((*DEFAULT_DIRECTIONS_DEG, KEPT_BACK_DEG))
    full = Rig(tuple(replace(camera, intrinsics=camera.intrinsics.at_size(*FULL_PX)) for camera in plain))
    work = full.scaled(SHARE)
    pose, look = random_pose(plain.centre_world(), 3.0, 5.0, rng), replace(random_look(rng), hair=None, stubble=0.0)
    around = pose.apply(head.vertices[relief.share(head.vertices) > 0])
    close = Rig(tuple(part for camera in full if (part := _part_of(camera, around)) is not None))
    preset = made_real(
        replace(PRESET, light_drift=0.0, exposure_spread=0.0, white_balance_spread=0.0, vignetting=0.0), realism
    )
    reduced = replace(preset, noise=SHARE * preset.noise, defocus_px=SHARE * preset.defocus_px)
    scene, near = (
        build_scene(
            sitter, rig, quality, np.random.default_rng((37, seed)), renderer=renderer, look=look, world_from_head=pose
        )
        for sitter, rig, quality in ((subject, work, reduced), (fine, close, preset))
    )
    capture = shoot(scene, np.random.default_rng((35, seed)))
    images, parts = dict(capture.images), {}
    for camera in close:
        sensor_rng = np.random.default_rng((36, seed, full.names.index(camera.name)))
        light = view_light(near.views[camera.name])
        picture = expose(light, near.views[camera.name].sensor, sensor_rng)
        parts[camera.name] = CloseUpPart(camera, picture)
        inside = near.views[camera.name].subject[:, :, 3]
        images[camera.name] = with_part(images[camera.name], full[camera.name].intrinsics, parts[camera.name], inside)
    kept = full.names[-1]
    names = full.names[:-1]
    shown = replace(
        capture,
        images={name: images[name] for name in names},
        backgrounds={name: capture.backgrounds[name] for name in names},
        features={},
    )
    return CloseUp(shown, work.subset(names), scene, relief, parts, parts.pop(kept))


def _bare_places(head: Mesh, marks: Mapping[str, Float[np.ndarray, " 3"]]) -> Float[np.ndarray, "2 3"]:
    """The middles of the right cheek and of the forehead, on the skin."""
    cheek = (marks["exocanthion_right"] + marks["cheilion_right"]) / 2 + (-4.0, 4.0, 0.0)
    forehead = marks["glabella"] + (0.0, 32.0, 0.0)
    return np.stack([head.vertices[np.linalg.norm(head.vertices - at, axis=1).argmin()] for at in (cheek, forehead)])


def _part_of(camera: Camera, points_world: Float[np.ndarray, "n 3"]) -> Camera | None:
    """The camera that takes only the part of the picture with these points. None from beside and behind."""
    if camera.axis_world[2] > -0.5:
        return None
    pixels, k = camera.project(points_world), camera.intrinsics
    low = (np.floor(pixels.min(axis=0) / STEP_PX) * STEP_PX).astype(int) - 4 * STEP_PX
    high = (np.ceil(pixels.max(axis=0) / STEP_PX) * STEP_PX).astype(int) + 4 * STEP_PX
    (left, top), (width, height) = low.tolist(), (high - low).tolist()
    lens = Intrinsics(width, height, k.fx, k.fy, k.cx - left, k.cy - top, k.distortion)
    return replace(camera, intrinsics=lens)


def with_part(image: ImageRgb, full: Intrinsics, part: CloseUpPart, coverage: Float32[np.ndarray, "h w"]) -> ImageRgb:
    """Returns a picture of work size with a part of the full one in it, reduced, where the subject covers it. Backdrops
    are not the same in both."""
    lens = part.camera.intrinsics
    column, row = (round(SHARE * (at - of)) for at, of in ((full.cx, lens.cx), (full.cy, lens.cy)))
    width, height = round(SHARE * lens.width), round(SHARE * lens.height)
    reduced = cv2.resize(part.image, (width, height), interpolation=cv2.INTER_AREA)
    whole = cv2.erode((coverage >= 1.0).astype(np.uint8), np.ones((4 * STEP_PX + 1,) * 2, np.uint8))
    inside = cv2.resize(whole, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    mixed = image.copy()
    target = mixed[row : row + height, column : column + width]
    target[inside] = reduced[inside]
    return mixed
