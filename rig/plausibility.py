"""What can be said against a rig before a picture of it is looked at: every fault at once, each with its remedy."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rig.camera import Camera
from rig.geometry import RigidTransform
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
UNITS = {10: "centimetres", 100: "decimetres", 1000: "metres"}
GRID = (9, 7)
CONVERGING_LEAST, DIVERGING_MOST = 0.9, 0.5  # share of cameras that have the common point in their picture


def rig_faults(rig: Rig, *, any_unit: bool = False) -> list[str]:
    """Faults of the cameras alone: lenses that map no picture, poses in another convention or unit, no base line.
    ``any_unit``: a known length beside them will tell the unit."""
    faults = [fault for camera in rig if (fault := _lens_fault(camera))]
    convention = _convention_fault(rig)
    return faults + ([convention] if convention else [] if any_unit else _spread_faults(rig))


def _lens_fault(camera: Camera) -> str | None:
    k = camera.intrinsics
    if min(k.fx / k.width, k.fy / k.height) < FOCAL_LEAST:
        return (
            f"{camera.name}: a focal length of {min(k.fx, k.fy):g} px is absurd for {k.width} x {k.height} pixels: "
            "of one in mm give mm times the picture's width in px, divided by the sensor's in mm"
        )
    with np.errstate(all="ignore"):
        straight, distorted = _through_lens(camera)
        radius = np.linalg.norm(straight, axis=1)
        growth = (np.sum(distorted * straight, axis=1) / radius**2)[radius > 1e-6]  # negative: turned inside out
    lost = float(np.mean(~np.isfinite(radius)))
    if lost <= LENS_LOST_MOST and (growth > LENS_GROWTH_LEAST).all() and (growth < LENS_GROWTH_MOST).all():
        return None
    told = ", ".join(f"{name} = {value:g}" for name, value in _coefficients(camera).items())
    what = f"no ray meets {lost:.0%} of its middle" if lost > LENS_LOST_MOST else "it bends it out of all shape"
    return f"{camera.name}: the lens is absurd ({told}; {what}): calibrate it again"


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


def _spread_faults(rig: Rig) -> list[str]:
    centres = np.stack([camera.centre_world for camera in rig])
    spread = float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())
    if spread < ONE_PLACE_MM:
        return ["every camera stands at one place: nothing can be measured without a base line; calibrate the rig"]
    if spread < LEAST_SPREAD_MM:
        return [
            f"the cameras stand within {spread:.3g} mm of each other: their translations look like metres, "
            "and millimetres are wanted; multiply them by 1000, or, of a scene without a scale, by what a known length "
            "in it tells"
        ]
    frame = frame_mm(rig)
    unit = next((unit for unit in UNITS if frame * unit >= FRAME_LEAST_MM), None)
    if frame < FRAME_LEAST_MM and unit is not None:
        return [
            f"the pictures show {frame:.3g} mm where the cameras look, and no head fits: their translations look like "
            f"{UNITS[unit]}, and millimetres are wanted; multiply them by {unit}"
        ]
    if min(frame, spread) > FRAME_MOST_MM:
        factor = 10 ** round(np.log10(frame / FRAME_USUAL_MM))
        remedy = f"divide their translations by {factor}" if factor <= UNIT_MOST else "look for one that is wrong"
        return [
            f"the pictures show {frame / 1000:.3g} m where the cameras look, and a head would be lost there: "
            f"translations are wanted in millimetres; {remedy}"
        ]
    return []


def frame_mm(rig: Rig) -> float:
    """What the pictures' longer side shows at the point nearest to all optical axes: the median over the cameras."""
    sides = []
    for camera in rig:
        k, distance = camera.intrinsics, float(np.linalg.norm(camera.centre_world - rig.centre_world()))
        sides.append(distance * max(k.width / k.fx, k.height / k.fy))
    return float(np.median(sides))


def _convention_fault(rig: Rig) -> str | None:
    """Poses that look at no common point as they are written, and all at one when read in another convention."""
    if _share_looking_at_one_point(rig) > DIVERGING_MOST:
        return None
    for other, read, remedy in readings(rig):
        if _share_looking_at_one_point(read) >= CONVERGING_LEAST:
            return (
                f"camera_from_world holds {other}: as written the cameras look at no common point, "
                f"and read so they do; {remedy}"
            )
    return None


def readings(rig: Rig) -> list[tuple[str, Rig, str]]:
    """The rig with its poses read in other conventions: what they would hold, the rig so read, and the remedy."""
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


_GL = np.diag([1.0, -1.0, -1.0])
_CONVENTIONS = {
    "world_from_camera": (lambda pose: pose.inverse(), "write the inverse of each pose"),
    "the camera's place in translation": (
        lambda pose: RigidTransform(pose.rotation, -pose.rotation @ pose.translation),
        "write -rotation @ place",
    ),
    "the rotation transposed": (
        lambda pose: RigidTransform(pose.rotation.T, pose.translation),
        "transpose each rotation",
    ),
    "camera axes with y up and z backwards": (
        lambda pose: RigidTransform(_GL @ pose.rotation, _GL @ pose.translation),
        "negate the second and third row of each pose (x right, y down, z forward)",
    ),
    "world_from_camera with y up and z backwards": (
        lambda pose: RigidTransform(_GL @ pose.inverse().rotation, _GL @ pose.inverse().translation),
        "write the inverse of each pose, its second and third row negated",
    ),
}
