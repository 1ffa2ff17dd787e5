"""Checks the cameras of a rig before any picture is read. Reports all faults with remedies."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rig.camera import Camera
from rig.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from rig.messages.message import Message, compose
from rig.recorded_lens import COEFFICIENTS
from rig.rig import Rig

ONE_PLACE_MM = 1e-3  # spread of camera centres below which all count as one point
LEAST_SPREAD_MM = 20.0  # of the camera centres; a rig of two metres whose file is in metres has 2
LENS_GROWTH_LEAST, LENS_GROWTH_MOST = 0.4, 1.5  # distorted / undistorted radius: 0.6 for a barrel lens of 100 degrees
LENS_LOST_MOST = 0.1  # share of the picture's middle that the lens model maps no ray to
MIDDLE = 0.6  # of width and height: where boards are shown and subjects stand; beyond it a good calibration may fold
# over
FOCAL_LEAST = 0.15  # of the picture's width; 0.26 is a fisheye of 220 degrees, a pinhole of 0.15 sees 147
FRAME_LEAST_MM = 100.0  # longer side of what the pictures show where the cameras look: half a head
FRAME_USUAL_MM = 600.0  # the simulated studio's arrangements have 556 to 559
FRAME_MOST_MM = 10_000.0  # a head is 2 % of the side then; for the spread too, since nearly parallel axes meet anywhere
AWAY_MOST_MM = 1e6  # from the world's origin: meshes hold 24 bits of a number, 0.06 mm there
UNIT_MOST = 1_000_000  # units per millimetre (nanometres); a larger factor is no unit
UNITS = {10: compose("centimetres"), 25.4: compose("inches"), 100: compose("decimetres"), 1000: compose("metres")}
UNIT_FRAME_MOST_MM = 2500.0  # limit for a guessed unit: a head fills a twelfth of the picture then
FOCAL_LEAST_PX = 10.0  # smaller focal lengths, and their principal points, are shares of the picture's size
CORNER_PX = 1.0  # a principal point that was left out is 0, or half a pixel from it
OTHER_SIZE = 0.4  # logarithm of the ratio of sizes, from which on it is a fault
SIZE_SPREAD = 0.2  # relative scatter of the cameras' ratios, up to which they count as one
GRID = (9, 7)
CONVERGING_LEAST, DIVERGING_MOST = 0.9, 0.5  # share of cameras whose picture contains the common point


def rig_faults(rig: Rig, *, any_unit: bool = False) -> list[Message]:
    """Returns faults of the cameras: impossible lenses, poses in another convention or unit, coinciding cameras.

    ``any_unit`` skips the check of the unit, if a known length from ``scale.json`` will define the unit."""
    of_all = _principal_point_faults(rig)
    if of_all:  # other faults would only follow from this one
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
        # Negative where the lens turns the picture inside out.
        growth = (np.sum(distorted * straight, axis=1) / radius**2)[radius > 1e-6]
    lost = float(np.mean(~np.isfinite(radius)))
    if lost <= LENS_LOST_MOST and (growth > LENS_GROWTH_LEAST).all() and (growth < LENS_GROWTH_MOST).all():
        return None
    held = [f"{name} = {value:g}" for name, value in _coefficients(camera).items()]
    what = compose("lens-unmet", share=lost) if lost > LENS_LOST_MOST else compose("lens-shapeless")
    return compose("lens-absurd", camera=camera.name, coefficients=held, what=what)


def _principal_point_faults(rig: Rig) -> list[Message]:
    """Returns a fault if the intrinsics belong to pictures of another size, are fractions of the picture's size, or
    lack principal points.

    If the intrinsics belong to another size, all principal points differ from the middle by the same factor,
    horizontally and vertically. A crop instead shifts principal points by some number of pixels, and a shift lens moves
    them in only one direction."""
    sizes = np.array([(camera.intrinsics.width, camera.intrinsics.height) for camera in rig], float)
    points = np.array([(camera.intrinsics.cx, camera.intrinsics.cy) for camera in rig])
    focal = np.array([(camera.intrinsics.fx, camera.intrinsics.fy) for camera in rig])
    if (np.abs(points) <= CORNER_PX).all() and (
        focal > FOCAL_LEAST_PX
    ).all():  # smaller focal lengths: see intrinsics-are-shares
        return [compose("principal-points-missing")]
    if (focal < FOCAL_LEAST_PX).all() and (points > 0.0).all() and (points < 1.0).all():
        return [compose("intrinsics-are-shares")]
    shares = (2.0 * points + 1.0) / sizes
    share = float(np.median(shares))
    if share <= 0.0 or abs(np.log(share)) < OTHER_SIZE or np.abs(shares / share - 1.0).max() > SIZE_SPREAD:
        return []
    rounded_share = float(f"{share:.2g}")  # principal points are not exactly in the middle
    return [compose("intrinsics-of-other-size", share=rounded_share, factor=1.0 / rounded_share)]


def _through_lens(camera: Camera) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Returns normalised coordinates ``X / Z, Y / Z`` without and with distortion, on a grid over the middle of the
    picture. The coordinates are NaN at pixels without a ray.

    If the picture files are undistorted on reading, the grid covers the undistorted picture. Pixels of a fisheye
    outside this grid are never used, so the lens model need not be valid there."""
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
    away = float(np.linalg.norm(np.median(centres, axis=0)))
    if away > AWAY_MOST_MM:
        return [compose("cameras-away", away_km=f"{away * 1e-6:.3g}", step_mm=f"{away * 2.0**-24:.2g}")]
    return []


def _unit_fault(frame: float) -> Message:
    """Returns a fault that names the unit of the poses in which a head would fit into the pictures. If two units are
    possible, the fault names both."""
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
    """Returns the length (mm) that the longer side of a picture covers at the point nearest to all optical axes, as the
    median over the cameras."""
    sides = []
    for camera in rig:
        k, distance = camera.intrinsics, float(np.linalg.norm(camera.centre_world - rig.centre_world()))
        sides.append(distance * max(k.width / k.fx, k.height / k.fy))
    return float(np.median(sides))


def _convention_fault(rig: Rig) -> Message | None:
    """Returns a fault if the cameras would point at one point only if their poses had another convention."""
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
    for other, other_remedy in others[:1]:  # y up and z backwards looks like translations of the wrong sign
        fault = compose("pose-convention-or", fault=fault, held=other, remedy=other_remedy)
    return fault


def alternative_conventions(rig: Rig) -> list[tuple[Message, Rig, Message]]:
    """Returns, for each other convention of poses, its description, the rig read by it, and the remedy."""
    return [
        (other, Rig(tuple(replace(c, camera_from_world=read(c.camera_from_world)) for c in rig)), remedy)
        for other, (read, remedy) in _CONVENTIONS.items()
    ]


def _share_looking_at_one_point(rig: Rig) -> float:
    """Returns the fraction of the cameras whose picture contains the point nearest to all optical axes."""
    point: Float[np.ndarray, "1 3"] = rig.centre_world()[None]
    inside = 0
    for camera in rig:
        with np.errstate(all="ignore"):
            column, row = camera.project(point)[0]
        inside += bool(0 <= column <= camera.intrinsics.width - 1 and 0 <= row <= camera.intrinsics.height - 1)
    return inside / len(rig)


def _of_shifted_quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Returns the correct rotation if ``rotation`` comes from a quaternion x, y, z, w that was read as w, x, y, z."""
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
