"""Judges the light, the focus and the cameras' views in the pictures of a shot. The module also judges whether new
clean plates show an empty studio: by their light, by motion between them, and by comparison with the plates in use."""

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from statistics import median

import numpy as np

from rig.acquisition.image_checks import Registration, blur_px, disturbed, exposure, find_subject, noise_of, register
from rig.acquisition.plates import NO_PLATES, Plates
from rig.acquisition.shot import Fault, PictureCheck, ShotFailed
from rig.formats.rig_toml import ShotConfig
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.rig import Rig

SEEN_SHARE = 0.5  # of the cameras: all see a person in the seat; a change seen by one is of its own wall, or a bump
OtherView = Callable[[str, Registration], str | None]

LEVEL_WITHOUT_PLATES = 64.0  # a studio picture's mean, where there is no plate to compare with
BLACK_LEVEL = 0.02  # of the plate's brightness: below it nothing is visible in a picture
# Measured on two rendered captures of eleven cameras: own background 0.35 to 0.75 (lamps off: 0.12 to 0.5), another
# camera's up to 0.07. Between the two bounds the other cameras' plates are compared.
FOUND_LEAST, FOUND_SURELY = 0.1, 0.25
# On plain walls under soft light, path traced with the subject's shadow, own backgrounds are found down to 0.0, and 0.3
# of their patches look alike where they were; another camera's textured background up to 0.18.
MIN_IN_PLACE = 0.2
# A movement counts by what is left of it after so many of its standard deviations. On the same captures, whose cameras
# never moved, the corners of the image are extrapolated by up to 4.2 px, which leaves 0.3 px at most.
MOVED_DEVIATIONS = 3.0
MOVED_DARK_PX = 3.0  # the same with the lamps off: up to 2.6 px without any movement


def plate_level(plate: ImageRgb | None) -> float:
    """Returns the mean value (0 to 255) of a clean plate, which a picture by the same camera should also have."""
    return LEVEL_WITHOUT_PLATES if plate is None else max(float(plate[::4, ::4].mean()), 1.0)


def examine_picture(image: ImageRgb, plate: ImageRgb | None) -> PictureCheck:
    """Measures the exposure and blur of one picture, and the agreement of its background with the clean plate."""
    light = exposure(image)
    black = light.mean < BLACK_LEVEL * plate_level(plate)
    return PictureCheck(light, blur_px(image), None if plate is None or black else register(image, plate))


def examine(images: Mapping[str, ImageRgb], plates: Plates) -> dict[str, PictureCheck]:
    """Measures all pictures in parallel. Returns the measurements by camera."""
    with ThreadPoolExecutor(4) as pool:
        examined = pool.map(lambda name: examine_picture(images[name], plates.first.get(name)), images)
        return dict(zip(images, examined, strict=True))


def judge(
    images: Mapping[str, ImageRgb], checks: Mapping[str, PictureCheck], plates: Plates, shot: ShotConfig
) -> list[Fault]:
    """Returns the faults of a shot's pictures, judged by their measurements and by comparison with clean plates."""
    levels = {name: plate_level(plates.first.get(name)) for name in checks}
    return judge_checks(
        checks, levels, shot, lambda name, registration: _whose_view(name, images[name], registration, plates)
    )


def judge_checks(
    checks: Mapping[str, PictureCheck],
    levels: Mapping[str, float],
    shot: ShotConfig,
    whose_view: OtherView = lambda name, registration: None,
) -> list[Fault]:
    """Returns the faults of pictures, judged by their measurements alone.

    Args:
        checks: the measurements by camera.
        levels: mean value that each camera's picture should have; without one its light is not judged.
        shot: limits of rig.toml.
        whose_view: for each camera whose picture fits another camera's clean plate better than its own, that other
            camera.
    """
    faults, lit = _light_faults(checks, levels, shot)
    for name, check in checks.items():
        if check.exposure.clipped_share > shot.clipped_most:
            share = check.exposure.clipped_share * 100
            faults.append(Fault("overexposed", name, compose("picture-burnt-out", percent=share)))
        if lit[name] and check.blur_px is not None and check.blur_px > shot.blur_most_px:
            width = compose("picture-blurred", width_px=check.blur_px, allowed_px=shot.blur_most_px)
            faults.append(Fault("blurred", name, width))
        if check.registration is not None:
            faults.extend(_view_faults(name, check.registration, lit[name], shot, whose_view))
    return faults


def _light_faults(
    checks: Mapping[str, PictureCheck], levels: Mapping[str, float], shot: ShotConfig
) -> tuple[list[Fault], dict[str, bool]]:
    """Returns the faults of exposure, and for each camera whether its picture is bright enough to judge the view."""
    ratios = {name: check.exposure.mean / levels[name] for name, check in checks.items() if name in levels}
    common = median(ratios.values()) if len(ratios) >= 3 else 1.0
    faults: list[Fault] = []
    if common < shot.dark_below:
        faults.append(Fault("lights-off", None, compose("pictures-dark", percent=common * 100)))
    for name, ratio in ratios.items():
        if ratio < shot.dark_below * min(1.0, common):
            code = "picture-uneven-brightness" if common < shot.dark_below else "picture-dark"
            faults.append(Fault("dark", name, compose(code, percent=ratio / min(1.0, common) * 100)))
    return faults, {name: ratios.get(name, 1.0) >= shot.dark_below for name in checks}


def _view_faults(
    name: str, registration: Registration, lit: bool, shot: ShotConfig, whose_view: OtherView
) -> list[Fault]:
    if not registration.conclusive:
        return []
    if registration.found < (FOUND_SURELY if lit else FOUND_LEAST):
        other = whose_view(name, registration)
        if other is not None:
            return [Fault("swapped", name, compose("picture-of-other-camera", other=other))]
        if registration.found < FOUND_LEAST:
            return [] if registration.in_place >= MIN_IN_PLACE else [Fault("view", name, compose("background-unknown"))]
        if registration.found < registration.in_place:  # the few that agree on a movement do so by chance
            return []
    most_px = shot.moved_most_px if lit else max(shot.moved_most_px, MOVED_DARK_PX)
    if registration.moved_px - MOVED_DEVIATIONS * registration.moved_sd_px > most_px:
        return [Fault("moved", name, compose("background-moved", moved_px=registration.moved_px))]
    return []


def _whose_view(name: str, image: ImageRgb, registration: Registration, plates: Plates) -> str | None:
    """Returns a camera whose clean plate fits the picture far better than the plate of ``name``, or None."""
    others = {other: register(image, plate).found for other, plate in plates.first.items() if other != name}
    best = max(others, key=lambda other: others[other], default=None)
    return best if best is not None and others[best] >= max(FOUND_LEAST, 2 * registration.found) else None


def size_faults(images: Mapping[str, ImageRgb], rig: Rig) -> list[Fault]:
    """Returns a fault for each picture whose camera is not calibrated, or is calibrated for another size."""
    faults = []
    for name, image in images.items():
        if name not in rig:
            faults.append(Fault("size", name, compose("camera-not-calibrated")))
            continue
        lens = rig[name].intrinsics
        size, wanted = f"{image.shape[1]} x {image.shape[0]}", f"{lens.width} x {lens.height}"
        if size != wanted:
            faults.append(Fault("size", name, compose("picture-size-wrong", size=size, wanted=wanted)))
    return faults


class PlatesRefused(ShotFailed):
    """Reports that new clean plates show a person. The new plates are stored as ``version`` and not used."""

    def __init__(self, faults: Sequence[Fault], version: str) -> None:
        super().__init__(faults)
        self.version = version


def plate_faults(taken: Mapping[str, Sequence[ImageRgb]], live: Collection[str], shot: ShotConfig) -> list[Fault]:
    """Returns the faults of new clean plates, without comparison to older plates. ``live`` holds the cameras with a
    sensor; other cameras replay recorded pictures."""
    faults = []
    for name, images in taken.items():
        if name in live and any(np.array_equal(images[0], other) for other in images[1:2]):
            faults.append(Fault("frozen", name, compose("plates-equal")))
        if disturbed(images, noise_of(images) or 0.0):
            faults.append(Fault("disturbed", name, compose("plates-disturbed")))
    first = {name: images[0] for name, images in taken.items()}
    light = judge(first, examine(first, NO_PLATES), NO_PLATES, shot)
    return faults + [fault for fault in light if fault.is_error]


def find_occupied(taken: Mapping[str, Sequence[ImageRgb]], before: Plates) -> list[Fault]:
    """Returns a fault for each camera whose new plate differs from the plate in use in a region of a head's size.
    Returns no fault if the plates of less than the fraction ``SEEN_SHARE`` of all cameras differ."""
    compared = [name for name in taken if name in before and taken[name][0].shape == before.first[name].shape]
    positions = {name: find_subject(taken[name][0], before.first[name]) for name in compared}
    faults = [
        Fault("occupied", name, compose("plate-differs", percent=position.share * 100))
        for name, position in positions.items()
        if position is not None
    ]
    return faults if len(faults) >= SEEN_SHARE * len(compared) else []
