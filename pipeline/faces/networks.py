"""Loads MediaPipe's networks for faces, 468 face points and eyes, and runs them by OpenCV.

BlazeFace (Bazarevsky et al. 2019) finds faces. The network of Kartynnik et al., *Real-time facial surface geometry from
monocular video on mobile GPUs* (2019), places 468 points on a face. The network of Ablavatski et al., *Real-time pupil
tracking from monocular video for digital puppetry* (2020), places the lids and the iris of an eye. The networks' files
are in ``packs`` (Apache-2.0), and their sha256 is checked. OpenCV's classic engine is used, since the new engine of
version 5.0 returns only one output of a network.

Pixel (0, 0) of a network's input is the centre of its top-left pixel. A measurement confirmed this pixel position: the
x of a point and of its mirror image add up to 190.8 px, and 191 px are expected.
"""

import hashlib
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from rig.errors import EigenheadError

PACKS = Path(__file__).parent / "packs"
SHA256: Mapping[str, str] = MappingProxyType(
    {
        "face_detection_full_range.tflite": "99bf9494d84f50acc6617d89873f71bf6635a841ea699c17cb3377f9507cfec3",
        "face_landmark.tflite": "2efcb4f4de43c7614b80a3cc3e8a37354b3b3b40f75cce20f6f38f0f25d65493",
        "iris_landmark.tflite": "d1744d2a09c25f501d39eba4faff47e53ecca8852c5ce19bce8eeac39357521f",
    }
)
FINDER_SIZE, LANDMARK_SIZE, EYE_SIZE = 192, 192, 64  # px, of the networks' inputs
FINDER_STEP = 4  # px between the finder's cells
LANDMARKS = 468
LID_POINTS, IRIS_POINTS = 16, 5


class DamagedNetwork(EigenheadError):
    """Reports a network file that is missing or has the wrong sha256."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path}: {why}; install the program again")


@dataclass(frozen=True, slots=True, eq=False)
class FaceNetworks:
    """Holds the three loaded networks. Several threads may share the networks: a lock runs one network at a time."""

    finder: cv2.dnn.Net
    landmark: cv2.dnn.Net
    eye: cv2.dnn.Net
    _lock: Any = field(default_factory=threading.Lock, repr=False)

    def find(self, crop: UInt8[np.ndarray, "192 192 3"]) -> tuple[Float[np.ndarray, "n 8 2"], Float[np.ndarray, " n"]]:
        """Proposes a face for every cell of the 192 x 192 crop; most proposals are wrong and have a low score.

        Returns:
            For each cell a face's centre, width and height, right eye, left eye, tip of the nose, mouth, right and left
                tragion (the subject's right and left; px of the crop), and its score before the sigmoid.
        """
        names = ("reshaped_regressor_face_4", "reshaped_classifier_face_4")
        boxes, scores = self._run(self.finder, 2.0 * _blob(crop) - 1.0, names)
        cells = np.stack(np.meshgrid(*2 * [np.arange(0, FINDER_SIZE, FINDER_STEP)]), axis=-1).reshape(-1, 2)
        faces = boxes.reshape(-1, 8, 2).astype(float)
        at_cell = [0, 2, 3, 4, 5, 6, 7]  # all but the size
        faces[:, at_cell] += (cells + (FINDER_STEP - 1) / 2)[:, None]
        return faces, scores.ravel().astype(float)

    def place_landmarks(self, crop: UInt8[np.ndarray, "192 192 3"]) -> tuple[Float[np.ndarray, "468 3"], float]:
        """Returns the 468 points of the face that fills a crop (x, y and z in px of the crop) and the network's score,
        above 0 for a face."""
        points, score = self._run(self.landmark, _blob(crop), ("conv2d_20", "conv2d_30"))
        return points.reshape(LANDMARKS, 3).astype(float), float(score.ravel()[0])

    def place_eye(
        self, crop: UInt8[np.ndarray, "64 64 3"]
    ) -> tuple[Float[np.ndarray, "16 2"], Float[np.ndarray, "5 2"]]:
        """Returns the lids' edges and the iris (centre, left, top, right, bottom) of the eye in a crop (px of the
        crop). The crop must show a right eye, or the mirror image of a left eye."""
        eye, iris = self._run(self.eye, _blob(crop), ("output_eyes_contours_and_brows", "output_iris"))
        return eye.reshape(-1, 3)[:LID_POINTS, :2].astype(float), iris.reshape(IRIS_POINTS, 3)[:, :2].astype(float)

    def _run(self, network: cv2.dnn.Net, blob: Float32[np.ndarray, "1 3 s s"], names: Sequence[str]) -> Sequence[Any]:
        with self._lock:
            network.setInput(blob)
            return network.forward(list(names))


def load_networks(folder: Path = PACKS) -> FaceNetworks:
    """Loads the three networks from a folder (0.05 s, 25 MB). Raises DamagedNetwork."""
    finder, landmark, eye = (_load(folder / name) for name in SHA256)
    return FaceNetworks(finder, landmark, eye)


def _load(path: Path) -> cv2.dnn.Net:
    try:
        raw = path.read_bytes()
    except OSError as fault:
        raise DamagedNetwork(path, fault.strerror or "cannot be read") from None
    if hashlib.sha256(raw).hexdigest() != SHA256[path.name]:
        raise DamagedNetwork(path, "the file of a face network is damaged (its sha256 is another)")
    # Of a network in memory OpenCV 5.0 passes the wished engine over, so it reads the file again.
    return cv2.dnn.readNetFromTFLite(str(path), cv2.dnn.ENGINE_CLASSIC)


def _blob(crop: UInt8[np.ndarray, "s s 3"]) -> Float32[np.ndarray, "1 3 s s"]:
    """Converts a crop to the networks' input: colour planes with values from 0 to 1."""
    return np.ascontiguousarray(crop.transpose(2, 0, 1)[None], np.float32) / np.float32(255.0)
