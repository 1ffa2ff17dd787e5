"""A served studio of six cameras with a drawn head in it, which turns when it is told to."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.acquisition.commands import take_plates
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.rig_toml import read_rig_config
from rig.image import ImageRgb
from rig.studio.devices.serve import StudioDevices
from rig.studio.devices.streams import Film
from tests.support.drawn_studio import drawn_pictures, drawn_studio, hidden_from

NOISE = 1.5  # grey levels: no two pictures of a camera are alike


@dataclass
class DrawnSitter:
    """Takes the pictures of the head, or of the studio without it."""

    seated: bool
    left_deg: float = 0.0
    _rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def __call__(self, camera: str, time_s: float) -> ImageRgb:
        shown = drawn_pictures(self.left_deg)
        picture = (shown if self.seated else hidden_from(list(shown), shown))[camera].astype(float)
        return np.clip(picture + self._rng.normal(0.0, NOISE, picture.shape), 0, 255).astype(np.uint8)


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


@pytest.fixture
def screenshots() -> Path:
    return Path(os.environ.get("EIGENHEAD_SCREENSHOTS") or Path(__file__).parents[4] / "out" / "screenshots")
