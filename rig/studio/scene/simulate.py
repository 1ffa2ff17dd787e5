"""Simulates a capture in the studio, with ground truth.

``build_scene`` lights and renders the subject once, and ``shoot`` takes the pictures with the requested faults.
Simulated cameras that take single pictures store the scene and call ``view_light`` and ``sensor.expose``.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.colour_space import srgb_from_linear
from rig.errors import InputError
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.messages.message import compose
from rig.render.photograph import Gallery, Part
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.eyes import Eye
from rig.studio.scene.lights import LAMPS, Lamp
from rig.studio.scene.subject import Look, Subject, dress, random_look, random_pose, restyle
from rig.studio.scene.visible import VisiblePoints, part_masks, visible_points
from rig.studio.sensor.faults import Fault
from rig.studio.sensor.preset import Preset
from rig.studio.sensor.sensor import Sensor, drift, expose, focus, roll_shutter, smooth

Vector = Float[np.ndarray, " 3"]
Plane = Float[np.ndarray, "h w"]


def matt_light(
    renderer: Renderer, rig: Rig, parts: Sequence[Part], gallery: Gallery, preset: Preset
) -> Mapping[str, Float[np.ndarray, "_ _ 4"]]:
    """Renders the subject without highlights in all cameras, as ``Renderer.photograph`` does. Returns nothing unless
    the preset requests matt pictures."""
    if not preset.polarised:
        return {}
    matt = [replace(part, oil=None, grain=replace(part.grain, gloss=0.0)) for part in parts]
    return renderer.photograph(rig, matt, gallery, samples=preset.samples)


COLOURS = ((0.20, 0.36, 0.26), (0.12, 0.19, 0.38), (0.28, 0.28, 0.36), (0.16, 0.30, 0.42), (0.36, 0.34, 0.30))
"""Linear RGB: green, blue, lilac grey, light blue, warm grey."""


def backdrop(
    intrinsics: Intrinsics,
    rng: np.random.Generator,
    unevenness: float,
    colour: tuple[float, float, float] | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Draws the backdrop of a camera's picture (linear radiance, float32). ``colour`` is linear RGB, or None for a
    random one."""
    height, width = intrinsics.height, intrinsics.width
    base = np.array(COLOURS[rng.integers(len(COLOURS))] if colour is None else colour, np.float32)
    image = np.broadcast_to(base, (height, width, 3)).astype(np.float32)
    if unevenness <= 0:
        return image
    unit = height / 768
    folds = smooth(rng, height, width, 2, 14) + 0.5 * smooth(rng, height, width, 3, 40)
    image = image * (1 + unevenness * (0.07 * folds + 0.10 * smooth(rng, height, width, 2, 2)))
    for _ in range(rng.integers(2, 6)):
        tint = base * rng.uniform(0.45, 1.5) * rng.uniform(0.85, 1.15, 3)
        _panel(image, rng, tint.astype(np.float32), unevenness)
    image = cv2.GaussianBlur(image, (0, 0), 3.0 * unit)
    weave = smooth(rng, height, width, height // 4, width // 4)
    return np.maximum(image * (1 + 0.02 * unevenness * weave), 0.004).astype(np.float32)


def _panel(image: Float[np.ndarray, "h w 3"], rng: np.random.Generator, tint: np.ndarray, strength: float) -> None:
    height, width = image.shape[:2]
    w, h = int(width * rng.uniform(0.04, 0.18)), int(height * rng.uniform(0.08, 0.35))
    x, y = rng.integers(-w // 2, width - w // 2), rng.integers(-h // 2, height - h // 2)
    part = image[max(y, 0) : y + h, max(x, 0) : x + w]
    part += min(strength, 1.0) * 0.8 * (tint - part)


def chair(width: int, height: int, rng: np.random.Generator) -> Float[np.ndarray, "h w 4"]:
    """Draws the back of a chair at one side of a picture. Returns linear RGB times alpha, and alpha."""
    image = np.zeros((height, width, 4), np.float32)
    colour = (*(rng.uniform(0.02, 0.08, 3)).tolist(), 1.0)
    left = int(width * (rng.uniform(0.03, 0.08) if rng.random() < 0.5 else rng.uniform(0.76, 0.8)))
    right, top = left + int(0.15 * width), int(0.55 * height)
    bar = max(int(0.018 * width), 2)
    for x in (left, right - bar):
        cv2.rectangle(image, (x, top), (x + bar, height), colour, -1)
    for y in range(top, height, int(0.11 * height)):
        cv2.rectangle(image, (left, y), (right, y + bar), colour, -1)
    return cv2.GaussianBlur(image, (0, 0), 2.0 * height / 768)


CAMOUFLAGE = (0.13, 0.10, 0.08)  # linear RGB, a dark brown that hair, shirt and backdrop may share
CLICKED_VIEWS = 4  # section 4.2: feature points are picked in 3 to 4 images
HIDDEN_MM = 4.0  # a landmark this far behind the nearest surface is not seen
THREADS = 2


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Holds the linear light in one camera's view. ``subject`` is the subject's light times coverage, and coverage.
    ``backdrop`` is the light behind the subject. ``matt`` is the subject without specular reflections, if requested."""

    subject: Float[np.ndarray, "h w 4"]
    backdrop: Float[np.ndarray, "h w 3"]
    sensor: Sensor
    matt: Float[np.ndarray, "h w 4"] | None = None

    @property
    def mask(self) -> Bool[np.ndarray, "h w"]:
        """Returns the true silhouette. A mask's pixel is True if the subject covers at least half of it."""
        return self.subject[:, :, 3] >= 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Holds a lit studio with a subject. ``rig`` has calibration errors; ``true_rig`` holds the true cameras."""

    rig: Rig
    true_rig: Rig
    views: Mapping[str, View]
    head: Mesh  # world frame, colours as lit (sRGB)
    face_region: Bool[np.ndarray, " v"] | None
    photographed: Bool[np.ndarray, " v"]  # vertices of the head that a camera sees, not under hair
    head_masks: Mapping[str, Bool[np.ndarray, "h w"]]  # of the bare head
    landmarks_world: Mapping[str, Vector]
    landmarks_seen: Mapping[str, Mapping[str, Float[np.ndarray, " 2"]]]  # true pixels, by landmark and camera
    world_from_head: Similarity
    visible: VisiblePoints
    parts: Mapping[str, UInt8[np.ndarray, "h w"]]  # 0 background, 1 skin, 2 hair, 3 clothes
    preset: Preset
    name: str
    eyes_world: Mapping[str, Eye] = field(default_factory=dict)  # by side, where the subject has eyeballs


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedCapture:
    """Holds a simulated capture, the rig with calibration errors, and the scene with the ground truth."""

    capture: Capture
    rig: Rig
    scene: Scene
    faults: tuple[Fault, ...]

    @property
    def masks(self) -> dict[str, Bool[np.ndarray, "h w"]]:
        """Returns the true silhouettes by camera, hair and clothes included."""
        return {name: view.mask for name, view in self.scene.views.items()}


def simulate(
    subject: Subject,
    rig: Rig,
    preset: Preset,
    rng: np.random.Generator,
    *,
    renderer: Renderer,
    look: Look | None = None,
    world_from_head: Similarity | None = None,
    faults: Sequence[Fault] = (),
) -> SimulatedCapture:
    """Simulates one capture of ``subject`` with ``rig``. If ``look`` or ``world_from_head`` is None, it is random."""
    scene_rng, shot_rng = rng.spawn(2)
    faults = tuple(_settled(fault, rig, shot_rng) for fault in faults)
    scene = build_scene(
        subject, rig, preset, scene_rng, renderer=renderer, look=look, world_from_head=world_from_head, faults=faults
    )
    return SimulatedCapture(shoot(scene, shot_rng, faults), rig, scene, faults)


def build_scene(
    subject: Subject,
    rig: Rig,
    preset: Preset,
    rng: np.random.Generator,
    *,
    renderer: Renderer,
    look: Look | None = None,
    world_from_head: Similarity | None = None,
    faults: Sequence[Fault] = (),
    lamps: Sequence[Lamp] = LAMPS,
) -> Scene:
    """Dresses, lights and renders the subject, and draws the backdrops. Skin, hair and backdrops depend on ``rng``, but
    not on pose and lamps."""
    look_rng, pose_rng, dress_rng, set_rng = rng.spawn(4)
    look = change_appearance(look or random_look(look_rng), preset, faults)
    pose = world_from_head or random_pose(rig.centre_world(), preset.pose_spread_deg, preset.pose_spread_mm, pose_rng)
    dressed = dress(renderer, subject, look, pose, clothes=preset.clothes, rng=dress_rng, lamps=lamps)
    true_rig = Rig(tuple(_knocked(camera, faults, set_rng) for camera in rig))
    shown = (*dressed.worn, dressed.skin)
    light = renderer.photograph(true_rig, shown, dressed.gallery, samples=preset.samples)
    matt = matt_light(renderer, true_rig, shown, dressed.gallery, preset)
    if preset.rolling_ms > 0:
        sway_mm = _sway(preset, rng.spawn(1)[0])
        light, matt = (_rolling(true_rig, of, pose.translation, sway_mm) for of in (light, matt))
    head = dressed.head
    colours = np.rint(255 * srgb_from_linear(renderer.vertex_radiance(head, dressed.gallery))).astype(np.uint8)
    with renderer.silhouette_set(true_rig, head.faces) as silhouettes:
        head_masks = silhouettes.masks(head.vertices)
    coarse = true_rig.scaled(0.5)  # enough to tell what hides what
    depth = renderer.depth(coarse, *dressed.solid)
    marks = {name: pose.apply(point[None])[0] for name, point in subject.landmarks.items()}
    views = view_cameras(true_rig, light, preset, faults, set_rng)
    views = {name: replace(view, matt=matt.get(name)) for name, view in views.items()}
    masks = {name: view.mask for name, view in views.items()}
    return Scene(
        rig=rig,
        true_rig=true_rig,
        views=views,
        head=Mesh(head.vertices, head.faces, colours),
        face_region=subject.face_region,
        photographed=_photographed(coarse, depth, head.vertices, head.normals),
        head_masks=head_masks,
        landmarks_world=marks,
        landmarks_seen=_seen_landmarks(coarse, true_rig, depth, marks),
        world_from_head=pose,
        visible=visible_points(true_rig, dressed.surfaces, renderer=renderer, rng=rng.spawn(1)[0]),
        parts=part_masks(true_rig, dressed.surfaces, masks, renderer=renderer),
        preset=preset,
        name=subject.name,
        eyes_world={side: eye.placed(pose) for side, eye in subject.eyes.items()},
    )


def view_light(view: View, *, subject: bool = True, gain: float = 1.0) -> Float[np.ndarray, "h w 3"]:
    """Returns the light (linear, float32) on one camera's sensor, with or without the subject."""
    light = view.backdrop
    if subject:
        light = view.subject[:, :, :3] + (1 - view.subject[:, :, 3:]) * light
    return focus(light * np.float32(gain), view.sensor)


def shoot(scene: Scene, rng: np.random.Generator, faults: Sequence[Fault] = ()) -> Capture:
    """Simulates the clean plates (pictures of the empty studio) and the shot of a scene. Faults that affect a single
    camera must name the camera."""
    names = scene.rig.names
    click_rng, *rngs = rng.spawn(1 + len(names))

    def one(
        name: str, camera_rng: np.random.Generator
    ) -> tuple[UInt8[np.ndarray, "h w 3"], tuple[UInt8[np.ndarray, "_ _ 3"], ...]]:
        return _picture(scene.views[name], scene.preset, [f for f in faults if f.camera in (None, name)], camera_rng)

    with ThreadPoolExecutor(THREADS) as pool:  # numpy and cv2 work outside the interpreter lock
        taken = dict(zip(names, pool.map(one, names, rngs), strict=True))
    source = {name: name for name in names}
    for fault in faults:
        if fault.kind == "swapped" and fault.camera:
            other = names[(names.index(fault.camera) + 1) % len(names)]
            source[fault.camera], source[other] = source[other], source[fault.camera]
    return Capture(
        images={name: taken[source[name]][0] for name in names},
        backgrounds={name: taken[source[name]][1] for name in names},
        masks=_wrong_masks(scene, faults),
        features=click(scene, click_rng),
        texture_sets=_polarised(scene, source, rng) if scene.preset.polarised else {},
    )


def _polarised(
    scene: Scene, source: Mapping[str, str], rng: np.random.Generator
) -> dict[str, dict[str, UInt8[np.ndarray, "_ _ 3"]]]:
    """Simulates texture sets in polarised light, at one moment and one exposure. A filter that is crossed with the
    lamps' filters removes specular reflections."""
    sets: dict[str, dict[str, np.ndarray]] = {"cross": {}, "parallel": {}}
    for name, camera_rng in zip(scene.rig.names, rng.spawn(len(scene.rig)), strict=True):
        view = scene.views[source[name]]
        assert view.matt is not None, "the preset asks for it"
        sets["cross"][name] = expose(view_light(replace(view, subject=view.matt)), view.sensor, camera_rng)
        sets["parallel"][name] = expose(view_light(view), view.sensor, camera_rng)
    return sets


def click(scene: Scene, rng: np.random.Generator) -> dict[str, dict[str, Float[np.ndarray, " 2"]]]:
    """Simulates feature points (px) that an operator picks, by landmark and camera: in the four views that see a
    landmark best, with the preset's noise."""
    clicked: dict[str, dict[str, np.ndarray]] = {}
    for landmark, views in scene.landmarks_seen.items():
        for name in list(views)[:CLICKED_VIEWS]:
            k = scene.rig[name].intrinsics
            point = views[name] + rng.normal(0, 1, 2) * scene.preset.feature_noise_px
            clicked.setdefault(landmark, {})[name] = np.clip(point, 0, (k.width - 1, k.height - 1))
    return {landmark: views for landmark, views in clicked.items() if len(views) >= 2}


def _settled(fault: Fault, rig: Rig, rng: np.random.Generator) -> Fault:
    if fault.camera is not None and fault.camera not in rig:
        strange = compose("rig-camera-unknown", camera=fault.camera, known=compose("rig-cameras", cameras=rig.names))
        raise InputError("fault", [compose("located", where=fault.kind, fault=strange)])
    drawn = rig.names[rng.integers(len(rig))]
    alone = fault.kind in ("frozen", "dark", "bumped", "swapped", "chair", "wrong-mask", "blurred")
    return replace(fault, camera=drawn) if alone and fault.camera is None else fault


def change_appearance(look: Look, preset: Preset, faults: Sequence[Fault]) -> Look:
    """Applies the changes of the preset and the faults to a subject's appearance."""
    look = replace(restyle(look, preset.hairstyle), pores=preset.pores, oil=preset.oil)
    look = replace(look, scattering_mm=preset.scattering_mm)
    if not preset.hair:
        look = replace(look, hair=None, beard=None)
    if not preset.texture:
        look = replace(look, texture=False, stubble=0.0)
    if any(fault.kind == "camouflage" for fault in faults):
        look = replace(look, cloth=CAMOUFLAGE, hair=look.hair and replace(look.hair, tone=CAMOUFLAGE))
    return look


def _knocked(camera: Camera, faults: Sequence[Fault], rng: np.random.Generator) -> Camera:
    for fault in faults:
        if fault.kind == "bumped" and fault.camera == camera.name:
            axis = rng.normal(0, 1, 3)
            turn = np.radians(fault.strength) * axis / np.linalg.norm(axis)
            camera = camera.moved(np.concatenate([turn, np.zeros(3)]))
    return camera


def _sway(preset: Preset, rng: np.random.Generator) -> Vector:
    """Returns the random motion (mm) of the subject while a rolling shutter reads all rows."""
    direction = rng.standard_normal(3)
    return direction / np.linalg.norm(direction) * preset.sway_mm_s * preset.rolling_ms / 1000


def _rolling(
    rig: Rig, light: Mapping[str, Float[np.ndarray, "_ _ 4"]], at_world: Vector, sway_mm: Vector
) -> dict[str, Float[np.ndarray, "_ _ 4"]]:
    """Distorts pictures as a rolling shutter does if the subject moves while rows are read. The middle row shows the
    true position. All parts of the subject move like the head's origin, although parts nearer to the camera should move
    by a tenth more."""
    shifts = {camera.name: camera.project_with_jacobian(at_world[None])[1][0] @ sway_mm for camera in rig}
    return {name: roll_shutter(light[name], shifts[name]) for name in light}


def view_cameras(
    rig: Rig,
    light: Mapping[str, Float[np.ndarray, "h w 4"]],
    preset: Preset,
    faults: Sequence[Fault],
    rng: np.random.Generator,
) -> dict[str, View]:
    """Draws random backdrops and sensors for all cameras, and combines these with the subject's ``light``."""
    colour = CAMOUFLAGE if any(fault.kind == "camouflage" for fault in faults) else None

    def one(camera: Camera, camera_rng: np.random.Generator) -> View:
        blur = [fault.strength for fault in faults if fault.kind == "blurred" and fault.camera == camera.name]
        gains = np.exp(
            camera_rng.normal(0, preset.exposure_spread) + camera_rng.normal(0, preset.white_balance_spread, 3)
        )
        red, green, blue = gains.tolist()
        sensor = Sensor((red, green, blue), replace(preset, defocus_px=blur[0]) if blur else preset)
        behind = backdrop(camera.intrinsics, camera_rng, preset.backdrop_unevenness, colour)
        return View(light[camera.name], behind, sensor)

    with ThreadPoolExecutor(THREADS) as pool:
        return dict(zip(rig.names, pool.map(one, rig, rng.spawn(len(rig))), strict=True))


def _picture(
    view: View, preset: Preset, faults: Sequence[Fault], rng: np.random.Generator
) -> tuple[UInt8[np.ndarray, "h w 3"], tuple[UInt8[np.ndarray, "_ _ 3"], ...]]:
    """Simulates one camera's picture of the subject and its clean plates."""
    kinds = {fault.kind: fault for fault in faults}
    plate_view = shot_view = view
    if "chair" in kinds:
        plate_view, shot_view = _with_chair(view, rng)
    if "shadow" in kinds:
        shot_view = replace(shot_view, backdrop=_shadowed(shot_view, kinds["shadow"].strength))
    empty = view_light(plate_view, subject=False)
    plates = tuple(expose(empty, view.sensor, rng) for _ in range(preset.plates))
    if "frozen" in kinds:
        return plates[-1].copy(), plates
    gain = 1.0
    for fault in faults:
        gain *= (
            1 + fault.strength
            if fault.kind == "exposure"
            else fault.strength
            if fault.kind in ("dark", "lights-off")
            else 1
        )
    light = view_light(shot_view, gain=gain) * drift(empty.shape[:2], preset.light_drift, rng)
    return expose(light, view.sensor, rng), plates


def _with_chair(view: View, rng: np.random.Generator) -> tuple[View, View]:
    height, width = view.backdrop.shape[:2]
    thing = chair(width, height, rng)
    shift = round(0.06 * width)
    moved = np.roll(thing, shift if thing[:, : width // 2, 3].any() else -shift, axis=1)
    shot, plate = (replace(view, backdrop=t[:, :, :3] + (1 - t[:, :, 3:]) * view.backdrop) for t in (thing, moved))
    return shot, plate


def _shadowed(view: View, amount: float) -> Float[np.ndarray, "h w 3"]:
    height, width = view.backdrop.shape[:2]
    move = np.array([[1, 0, 0.05 * width], [0, 1, 0.04 * height]], np.float32)
    alpha = cv2.warpAffine(
        np.ascontiguousarray(view.subject[:, :, 3]), move, (width, height), borderMode=cv2.BORDER_REPLICATE
    )
    return view.backdrop * (1 - amount * cv2.GaussianBlur(alpha, (0, 0), 0.03 * width))[:, :, None]


def _wrong_masks(scene: Scene, faults: Sequence[Fault]) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Simulates masks with an operator's mistakes: mirrored, or shifted by a fifth of the image."""
    wrong = [fault.camera for fault in faults if fault.kind == "wrong-mask" and fault.camera]
    masks = {name: scene.views[name].mask[:, ::-1] for name in wrong}
    return {name: np.roll(mask, mask.shape[1] // 5, axis=1) for name, mask in masks.items()}


def _photographed(
    rig: Rig, depth: Mapping[str, Plane], vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"]
) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the vertices that at least one camera sees, neither at a grazing angle nor behind hair."""
    seen = np.zeros(len(vertices), bool)
    for camera in rig:
        towards = camera.centre_world - vertices
        facing = (normals * towards).sum(axis=1) > 0.2 * np.linalg.norm(towards, axis=1)
        seen |= facing & _unhidden(camera, depth[camera.name], vertices, 1.5)
    return seen


def _unhidden(
    camera: Camera, depth: Plane, points: Float[np.ndarray, "n 3"], slack_mm: float
) -> Bool[np.ndarray, " n"]:
    k = camera.intrinsics
    at = np.rint(np.nan_to_num(camera.project(points), nan=-9.0))
    inside = np.all((at >= 0) & (at < np.array([k.width, k.height])), axis=1)
    column, row = np.where(inside[:, None], at, 0).astype(int).T
    z = camera.camera_from_world.apply(points)[:, 2]
    return inside & (z < depth[row, column] + slack_mm)


def _seen_landmarks(
    coarse: Rig, rig: Rig, depth: Mapping[str, Plane], marks: Mapping[str, Vector]
) -> dict[str, dict[str, Float[np.ndarray, " 2"]]]:
    """Returns the true pixels of each landmark in the cameras that see it, ordered from the most frontal view."""
    front = rig[rig.front_camera()].centre_world - rig.centre_world()
    by_angle = sorted(rig, key=lambda c: -float(np.dot(c.centre_world - rig.centre_world(), front)))
    found: dict[str, dict[str, np.ndarray]] = {}
    for landmark, point in marks.items():
        for camera in by_angle:
            if bool(_unhidden(coarse[camera.name], depth[camera.name], point[None], HIDDEN_MM).all()):
                found.setdefault(landmark, {})[camera.name] = camera.project(point[None])[0]
    return found
