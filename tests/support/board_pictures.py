"""A studio in which somebody holds the calibration board: recordings of a real one, shot by shot."""

from pathlib import Path

import cv2
import numpy as np

from rig.studio.devices.serve import StudioDevices


class BoardPictures:
    """An ImageSource: one recorded shot at a time, with sensor noise of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.shot = folder, 0
        self._noise = np.random.default_rng(0)

    def __call__(self, camera: str, time_s: float) -> np.ndarray:
        picture = cv2.imread(str(self.folder / camera / f"shot{self.shot:02}.jpg"))
        assert picture is not None
        noisy = picture[:, :, ::-1] + self._noise.standard_normal(picture.shape, np.float32)
        return np.clip(np.round(noisy), 0, 255).astype(np.uint8)

    def hold(self, studio: StudioDevices, shot: int) -> None:
        """From now on the studio's cameras see this shot."""
        studio.seat(False)
        self.shot = shot
        studio.seat(True)
