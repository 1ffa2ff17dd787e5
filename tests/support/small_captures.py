"""A capture of three small pictures, as a folder, and ways to harm it."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.formats.pictures.images import encode_image
from rig.geometry import look_at
from rig.rig import Rig

RNG = np.random.default_rng(0)
HEIGHT, WIDTH = 48, 64


def small_rig() -> Rig:
    intrinsics = Intrinsics(WIDTH, HEIGHT, 90.0, 90.0, 31.5, 23.5)
    places = ([-300.0, 0.0, 900.0], [0.0, 0.0, 1000.0], [300.0, 0.0, 900.0])
    up = np.array([0.0, 1.0, 0.0])
    return Rig(
        tuple(Camera(n, intrinsics, look_at(np.array(p), np.zeros(3), up)) for n, p in zip("abc", places, strict=True))
    )


def picture() -> np.ndarray:
    return RNG.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def small_capture() -> Capture:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[10:40, 20:50] = True
    return Capture(
        images={name: picture() for name in "abc"},
        backgrounds={"a": (picture(),), "b": (picture(), picture())},
        masks={"c": mask},
        features={"pronasale": {"a": np.array([31.25, 20.5]), "b": np.array([-0.5, 47.5])}},
    )


def damage(path: str, data: bytes) -> Callable[[Path], None]:
    def harm(folder: Path) -> None:
        (folder / path).write_bytes(data)

    return harm


def remove(path: str) -> Callable[[Path], None]:
    return lambda folder: (folder / path).unlink()


def rename(path: str, other: str) -> Callable[[Path], None]:
    def harm(folder: Path) -> None:
        (folder / path).rename(folder / other)

    return harm


png = partial(encode_image, ".png")
FEATURES = "eigenhead-features/1"


def points(document: Any) -> Callable[[Path], None]:
    return damage("features.json", json.dumps(document).encode())


def feature(views: Any) -> Callable[[Path], None]:
    return points({"format": "eigenhead-features/1", "points": {"pronasale": views}})


def all_points(views: Callable[[str, list[float]], tuple[str, Any]]) -> Callable[[Path], None]:
    """Rewrites every point of three landmarks in three cameras."""
    pixels = {"a": [20.0, 30.0], "b": [40.0, 25.0], "c": [50.0, 20.0]}
    names = ("pronasale", "subnasale", "gnathion")
    return points({"format": FEATURES, "points": {name: dict(views(*of) for of in pixels.items()) for name in names}})
