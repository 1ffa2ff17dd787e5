"""A served studio of six cameras with a drawn head in it, which turns when it is told to."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float

from rig.acquisition.commands import take_plates
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.rig_toml import read_rig_config
from rig.image import ImageRgb
from rig.studio.devices.serve import StudioDevices
from rig.studio.devices.streams import Film
from tests.support.drawn_faces import WALL
from tests.support.drawn_studio import LENS, drawn_pictures, drawn_studio

NOISE = 1.5  # grey levels: no two pictures of a camera are alike
NEAR = 3.0  # grey levels from the wall


@dataclass
class DrawnSitter:
    """Takes the pictures of the head, or of the studio without it."""

    seated: bool
    left_deg: float = 0.0
    _rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def __call__(self, camera: str, time_s: float) -> ImageRgb:
        picture = drawn_pictures(self.left_deg)[camera].astype(float)
        wall = np.linalg.norm(picture - WALL, axis=2) < NEAR if self.seated else np.ones(picture.shape[:2], bool)
        picture[wall] = (WALL + pattern(camera))[wall]
        return np.clip(picture + self._rng.normal(0.0, NOISE, picture.shape), 0, 255).astype(np.uint8)


@cache
def pattern(camera: str) -> Float[np.ndarray, "h w 1"]:
    """What is painted on the wall behind the head: without it no camera's view is known again."""
    drawn = np.random.default_rng(int(camera[-1])).normal(0.0, 14.0, (LENS.height // 6, LENS.width // 6))
    return cv2.resize(drawn, (LENS.width, LENS.height), interpolation=cv2.INTER_CUBIC)[:, :, None]


@dataclass
class DrawnRig:
    """Holds the studio and its rig.toml."""

    devices: StudioDevices
    toml: Path

    def turn(self, left_deg: float) -> None:
        """Shows the head turned to its left, at once."""
        sitter = DrawnSitter(True, left_deg)
        for name in self.devices.names:
            takes = [cv2.imencode(".jpg", sitter(name, 0.0)[:, :, ::-1])[1].tobytes() for _ in range(4)]
            self.devices.streams.show(name, Film(tuple(takes[:2]), tuple(takes[2:])))


@contextmanager
def drawn_rig(folder: Path) -> Iterator[DrawnRig]:
    folder.mkdir()
    write_rig(drawn_studio(), folder / "cameras.json")
    sources = DrawnSitter(False), DrawnSitter(True)
    with StudioDevices(folder, drawn_studio().names, *sources, calibration="cameras.json") as devices:
        take_plates(read_rig_config(folder / "rig.toml"))
        yield DrawnRig(devices, folder / "rig.toml")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[DrawnRig]:
    with drawn_rig(tmp_path / "studio") as opened:
        yield opened
