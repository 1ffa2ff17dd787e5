"""What can be said against a rig before a picture of it is looked at: every fault at once, each with its remedy."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rig.camera import Camera
from rig.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from rig.messages.message import Message, compose
from rig.recorded_lens import COEFFICIENTS
from rig.rig import Rig

ONE_PLACE_MM = 1e-3
LEAST_SPREAD_MM = 20.0  # of the camera centres; a rig of two metres whose file is in metres has 2
LENS_GROWTH_LEAST, LENS_GROWTH_MOST = 0.4, 1.5  # distorted by undistorted radius: 0.6 at 100 degrees of a barrel lens
LENS_LOST_MOST = 0.1  # share of the picture's middle that no ray meets
MIDDLE = (
    0.6  # of width and height: where boards are shown and subjects stand; beyond it a good calibration may fold over
)
FOCAL_LEAST = 0.15  # of the picture's width; 0.26 is a fisheye of 220 degrees, a pinhole of 0.15 sees 147
FRAME_LEAST_MM = 100.0  # longer side of what the pictures show where the cameras look: half a head
FRAME_USUAL_MM = 600.0  # of the studio's arrangements: 556 to 559
FRAME_MOST_MM = 10_000.0  # and of the spread, since axes that hardly converge meet anywhere: a head is 2% of the side
UNIT_MOST = 1_000_000  # nanometres; beyond, it is no unit
UNITS = {10: compose("centimetres"), 25.4: compose("inches"), 100: compose("decimetres"), 1000: compose("metres")}
UNIT_FRAME_MOST_MM = 2500.0  # in a unit that is guessed: a head has a twelfth of the picture then
FOCAL_LEAST_PX = 10.0  # smaller ones are shares of the picture's size, and so are their principal points
CORNER_PX = 1.0  # a principal point that nobody gave is 0, or half a pixel off it
OTHER_SIZE, SIZE_SPREAD = (
    0.4,
    0.2,
)  # logarithm of a size's share, and how far cameras' principal points scatter about it
GRID = (9, 7)
CONVERGING_LEAST, DIVERGING_MOST = 0.9, 0.5  # share of cameras that have the common point in their picture


def rig_faults(rig: Rig, *, any_unit: bool = False) -> list[Message]:
    """Returns faults of the cameras alone: lenses that map no picture, poses in another convention or unit, no base
    line. ``any_unit``: a known length beside them will tell the unit."""
    of_all = _principal_point_faults(rig)
    if of_all:  # what else such intrinsics look like is said of none
        return of_all
    faults = [fault for camera in rig if (fault := _lens_fault(camera))]
    convention = _convention_fault(rig)
    return faults + ([convention] if convention else [] if any_unit else _spread_faults(rig))


def _lens_fault(camera: Camera) -> Message | None:
    k = camera.intrinsics
    if min(k.fx / k.width, k.fy / k.height) < FOCAL_LEAST:
        focal_px, size = min(k.fx, k.fy), f"{k.width} x {k.height}"
        return compose("focal-length-absurd", camera=camera.name, focal_px=focal_px, size=size)
    with np.errstate(all="ignore"):
        straight, distorted = _through_lens(camera)
        radius = np.linalg.norm(straight, axis=1)
        growth = (np.sum(distorted * straight, axis=1) / radius**2)[radius > 1e-6]  # negative: turned inside out
    lost = float(np.mean(~np.isfinite(radius)))
    if lost <= LENS_LOST_MOST and (growth > LENS_GROWTH_LEAST).all() and (growth < LENS_GROWTH_MOST).all():
        return None
    held = [f"{name} = {value:g}" for name, value in _coefficients(camera).items()]
    what = compose("lens-unmet", share=lost) if lost > LENS_LOST_MOST else compose("lens-shapeless")
    return compose("lens-absurd", camera=camera.name, coefficients=held, what=what)


def _principal_point_faults(rig: Rig) -> list[Message]:
    """Principal points that lie off the middle by one factor in all cameras, across and down: those of pictures of
    another size, or none at all. A crop moves them by pixels, and a shifted lens one way."""
    sizes = np.array([(camera.intrinsics.width, camera.intrinsics.height) for camera in rig], float)
    points = np.array([(camera.intrinsics.cx, camera.intrinsics.cy) for camera in rig])
    focal = np.array([(camera.intrinsics.fx, camera.intrinsics.fy) for camera in rig])
    if (np.abs(points) <= CORNER_PX).all() and (focal > FOCAL_LEAST_PX).all():  # else shares of the picture's size
        return [compose("principal-points-missing")]
    if (focal < FOCAL_LEAST_PX).all() and (points > 0.0).all() and (points < 1.0).all():
        return [compose("intrinsics-are-shares")]
    shares = (2.0 * points + 1.0) / sizes
    share = float(np.median(shares))
    if share <= 0.0 or abs(np.log(share)) < OTHER_SIZE or np.abs(shares / share - 1.0).max() > SIZE_SPREAD:
        return []
    told_share = float(f"{share:.2g}")  # principal points are not exactly in the middle
    return [compose("intrinsics-of-other-size", share=told_share, factor=1.0 / told_share)]


def _through_lens(camera: Camera) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """``X / Z, Y / Z`` without and with the lens, over the middle of the picture; NaN where no ray meets it.

    A recorded lens is asked over the middle of the pinhole's picture, for which its own is read: what a fisheye saw
    beyond has no place there, and says nothing against it."""
    k = camera.intrinsics
    edge = 0.5 * (1.0 - MIDDLE)
    sides = zip((k.width, k.height), GRID, strict=True)
    columns, rows = (np.linspace(edge * size, (1.0 - edge) * size - 1, count) for size, count in sides)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    middle, focal = np.array([k.cx, k.cy]), np.array([k.fx, k.fy])
    if camera.recorded is None:
        return camera.undistort(pixels), (pixels - middle) / focal
    return (pixels - middle) / focal, (camera.recorded.distorted(pixels, k.matrix()) - middle) / focal


def _coefficients(camera: Camera) -> dict[str, float]:
    d, lens = camera.intrinsics.distortion, camera.recorded
    if lens is None:
        return {"k1": d.k1, "k2": d.k2, "p1": d.p1, "p2": d.p2, "k3": d.k3}
    return dict(zip(COEFFICIENTS[lens.model], lens.coefficients, strict=True))


def _spread_faults(rig: Rig) -> list[Message]:
    centres = np.stack([camera.centre_world for camera in rig])
    spread = float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())
    if spread < ONE_PLACE_MM:
        return [compose("cameras-at-one-place")]
    if spread < LEAST_SPREAD_MM:
        return [compose("cameras-near", spread_mm=f"{spread:.3g}")]
    frame = frame_mm(rig)
    if frame < FRAME_LEAST_MM and frame * max(UNITS) >= FRAME_LEAST_MM:
        return [_unit_fault(frame)]
    if min(frame, spread) > FRAME_MOST_MM:
        factor = 10 ** round(np.log10(frame / FRAME_USUAL_MM))
        wrong = factor > UNIT_MOST
        remedy = compose("look-for-wrong-one") if wrong else compose("divide-translations", factor=factor)
        return [compose("cameras-show-much", frame_m=f"{frame / 1000:.3g}", remedy=remedy)]
    return []


def _unit_fault(frame: float) -> Message:
    """The unit that makes a head fit into the pictures; two that do are both named, for only the file's owner knows."""
    fitting = [unit for unit in UNITS if FRAME_LEAST_MM <= frame * unit <= UNIT_FRAME_MOST_MM]
    usual = sorted(fitting, key=lambda unit: abs(np.log(frame * unit / FRAME_USUAL_MM)))
    if len(usual) < 2:
        unit = usual[0] if usual else next(unit for unit in UNITS if frame * unit >= FRAME_LEAST_MM)
        return compose("cameras-show-little", frame_mm=f"{frame:.3g}", unit=UNITS[unit], factor=unit)
    factor, second = usual[:2]
    return compose(
        "cameras-show-little-of-two",
        frame_mm=f"{frame:.3g}",
        unit=UNITS[factor],
        factor=factor,
        other=UNITS[second],
        other_factor=second,
    )


def frame_mm(rig: Rig) -> float:
    """Returns what the pictures' longer side shows at the point nearest to all optical axes: the median over the
    cameras."""
    sides = []
    for camera in rig:
        k, distance = camera.intrinsics, float(np.linalg.norm(camera.centre_world - rig.centre_world()))
        sides.append(distance * max(k.width / k.fx, k.height / k.fy))
    return float(np.median(sides))


def _convention_fault(rig: Rig) -> Message | None:
    """Poses that look at no common point as they are written, and all at one when read in another convention."""
    if _share_looking_at_one_point(rig) > DIVERGING_MOST:
        return None
    fitting = [
        (other, remedy)
        for other, read, remedy in alternative_conventions(rig)
        if _share_looking_at_one_point(read) >= CONVERGING_LEAST
    ]
    if not fitting:
        return None
    (held, remedy), *others = fitting
    fault = compose("pose-convention", held=held, remedy=remedy)
    for other, its_remedy in others[:1]:  # y up and z backwards looks like translations of the wrong sign
        fault = compose("pose-convention-or", fault=fault, held=other, remedy=its_remedy)
    return fault


def alternative_conventions(rig: Rig) -> list[tuple[Message, Rig, Message]]:
    """Reads the poses in other conventions. Returns what each would hold, the rig so read, and the remedy."""
    return [
        (other, Rig(tuple(replace(c, camera_from_world=read(c.camera_from_world)) for c in rig)), remedy)
        for other, (read, remedy) in _CONVENTIONS.items()
    ]


def _share_looking_at_one_point(rig: Rig) -> float:
    """Share of the cameras that have the point nearest to all optical axes in their picture."""
    point: Float[np.ndarray, "1 3"] = rig.centre_world()[None]
    seen = 0
    for camera in rig:
        with np.errstate(all="ignore"):
            column, row = camera.project(point)[0]
        seen += bool(0 <= column <= camera.intrinsics.width - 1 and 0 <= row <= camera.intrinsics.height - 1)
    return seen / len(rig)


def _of_shifted_quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation whose quaternion x, y, z, w was read as w, x, y, z."""
    vector = vector_from_rotation(rotation)
    half = float(np.linalg.norm(vector)) / 2.0
    x, y, z, w = np.cos(half), *(vector / 2.0 * np.sinc(half / np.pi))
    axis = np.array([x, y, z])
    return rotation_from_vector(2.0 * np.arctan2(np.linalg.norm(axis), w) * axis / max(np.linalg.norm(axis), 1e-12))


_GL = np.diag([1.0, -1.0, -1.0])
_CONVENTIONS = {
    compose("held-inverse"): (lambda pose: pose.inverse(), compose("write-inverse")),
    compose("held-place"): (
        lambda pose: RigidTransform(pose.rotation, -pose.rotation @ pose.translation),
        compose("write-place"),
    ),
    compose("held-transposed"): (
        lambda pose: RigidTransform(pose.rotation.T, pose.translation),
        compose("transpose-rotations"),
    ),
    compose("held-axes-up"): (
        lambda pose: RigidTransform(_GL @ pose.rotation, _GL @ pose.translation),
        compose("negate-rows"),
    ),
    compose("held-inverse-axes-up"): (
        lambda pose: RigidTransform(_GL @ pose.inverse().rotation, _GL @ pose.inverse().translation),
        compose("write-inverse-negated"),
    ),
    compose("held-negated"): (
        lambda pose: RigidTransform(pose.rotation, -pose.translation),
        compose("negate-translations"),
    ),
    compose("held-quaternion"): (
        lambda pose: RigidTransform(_of_shifted_quaternion(pose.rotation), pose.translation),
        compose("write-real-part-first"),
    ),
}
