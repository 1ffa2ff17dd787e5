"""Checks that new clean plates show an empty studio, before they replace others.

They are judged by what moves while they are taken, by their light, and by comparison with the plates in use. All are
pure functions of pictures."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from rig.acquisition.image_checks import disturbed, noise_of
from rig.acquisition.judgement import examine, judge
from rig.acquisition.plates import NO_PLATES, Plates
from rig.acquisition.shot import Fault, ShotFailed
from rig.acquisition.subject_place import find_subject
from rig.formats.rig_toml import ShotConfig
from rig.image import ImageRgb
from rig.messages.message import compose

SEEN_SHARE = 0.5  # of the cameras: all see a person in the seat; a change seen by one is of its own wall, or a bump


class PlatesRefused(ShotFailed):
    """Reports that new clean plates show a person. They are kept as the version ``version``; the old plates stay in
    use."""

    def __init__(self, faults: Sequence[Fault], version: str) -> None:
        super().__init__(faults)
        self.version = version


def plate_faults(taken: Mapping[str, Sequence[ImageRgb]], live: Collection[str], shot: ShotConfig) -> list[Fault]:
    """Returns the faults that pictures of the empty studio show by themselves. ``live``: cameras whose pictures come
    from a sensor and are not recorded."""
    faults = []
    for name, images in taken.items():
        if name in live and any(np.array_equal(images[0], other) for other in images[1:2]):
            faults.append(Fault("frozen", name, compose("plates-equal")))
        if disturbed(images, noise_of(images) or 0.0):
            faults.append(Fault("disturbed", name, compose("plates-disturbed")))
    first = {name: images[0] for name, images in taken.items()}
    light = judge(first, examine(first, NO_PLATES), NO_PLATES, shot)
    return faults + [fault for fault in light if fault.is_error]


def occupied(taken: Mapping[str, Sequence[ImageRgb]], before: Plates) -> list[Fault]:
    """Returns a fault for each camera whose new plate differs from the plate in use as if a person sat there. Returns
    none where fewer than ``SEEN_SHARE`` of the cameras do."""
    compared = [name for name in taken if name in before and taken[name][0].shape == before.first[name].shape]
    positions = {name: find_subject(taken[name][0], before.first[name]) for name in compared}
    faults = [
        Fault("occupied", name, compose("plate-differs", percent=position.share * 100))
        for name, position in positions.items()
        if position is not None
    ]
    return faults if len(faults) >= SEEN_SHARE * len(compared) else []
