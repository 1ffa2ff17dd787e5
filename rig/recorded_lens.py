"""Models lenses that Brown-Conrady distortion cannot represent, and undistorts their pictures on reading.

The rest of the program treats a camera with one of these lenses as a pinhole: ``Camera.intrinsics`` has no distortion,
and ``Camera.recorded`` is the lens of the picture files. The pinhole and the lens have the same focal lengths,
principal point and size, so that the resolution in the middle of the picture does not change. Pixels of a fisheye
outside the pinhole's picture are dropped.

The Kannala-Brandt model is ``theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`` with ``theta``
the angle to the axis (https://docs.opencv.org/4.x/db/d58/group__calib3d__fisheye.html). The rational model has OpenCV's
eight coefficients k1 k2 p1 p2 k3 k4 k5 k6 and a quotient as radial factor
(https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html)."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float, Shaped

LensModel = Literal["kannala-brandt", "rational"]
COEFFICIENTS: dict[LensModel, tuple[str, ...]] = {
    "kannala-brandt": ("k1", "k2", "k3", "k4"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
ROUNDS, EXACT = 100, 1e-12  # iterations and tolerance of the inverse of either polynomial, far below a visible error


@dataclass(frozen=True, slots=True)
class RecordedLens:
    """Holds a lens model and its coefficients in the order of ``COEFFICIENTS[model]``. ``skew`` is entry (0, 1) of the
    camera matrix, divided by fx."""

    model: LensModel
    coefficients: tuple[float, ...]
    skew: float = 0.0

    def distorted(self, pixels: Float[np.ndarray, "n 2"], matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 2"]:
        """Converts pixels of the undistorted picture to pixels of the file. ``matrix`` is the camera matrix."""
        import cv2  # here and below: 0.1 s that most starts do without

        rays = np.ones((len(pixels), 3))
        rays[:, :2] = (pixels - matrix[:2, 2]) / np.diag(matrix)[:2]
        lens, none = np.array(self.coefficients), np.zeros(3)
        if self.model == "kannala-brandt":
            projected = cv2.fisheye.projectPoints(rays[None], none, none, matrix, lens)[0]
        else:
            projected = cv2.projectPoints(rays, none, none, matrix, lens)[0]
        projected = projected.reshape(-1, 2)
        return projected + np.outer(_rows(projected, matrix), [self.skew * matrix[0, 0], 0.0])

    def undistorted(
        self, pixels: Float[np.ndarray, "n 2"], matrix: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "n 2"]:
        """Converts pixels of the file to pixels of the undistorted picture. ``matrix`` is the camera matrix."""
        import cv2

        straight = pixels - np.outer(_rows(pixels, matrix), [self.skew * matrix[0, 0], 0.0])
        lens, places = np.array(self.coefficients), straight.reshape(1, -1, 2)
        until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, ROUNDS, EXACT)
        if self.model == "kannala-brandt":
            undistorted = cv2.fisheye.undistortPoints(places, matrix, lens, R=None, P=matrix, criteria=until)
        else:
            undistorted = cv2.undistortPoints(places, matrix, lens, R=None, P=matrix, criteria=until)
        return np.asarray(undistorted).reshape(-1, 2)

    def undistort(
        self, picture: Shaped[np.ndarray, "h w ..."], matrix: Float[np.ndarray, "3 3"], *, smooth: bool = True
    ) -> Shaped[np.ndarray, "h w ..."]:
        """Returns the picture that a pinhole with camera matrix ``matrix`` would have taken. ``smooth`` interpolates;
        masks with hard edges need ``smooth=False``.

        Pixels outside the picture in the file become black."""
        import cv2

        across, down = _maps(self, (picture.shape[1], picture.shape[0]), tuple(matrix.ravel().tolist()))
        way = cv2.INTER_CUBIC if smooth else cv2.INTER_NEAREST
        return cv2.remap(picture, across, down, way, borderMode=cv2.BORDER_CONSTANT)


def _rows(pixels: Float[np.ndarray, "n 2"], matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " n"]:
    """Returns the normalised coordinate ``Y / Z`` of each pixel."""
    return (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1]


@lru_cache(maxsize=4)  # a photograph, its plates and its mask come one after the other
def _maps(lens: RecordedLens, size: tuple[int, int], values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    import cv2

    matrix, coefficients = np.array(values).reshape(3, 3), np.array(lens.coefficients)
    make = cv2.fisheye.initUndistortRectifyMap if lens.model == "kannala-brandt" else cv2.initUndistortRectifyMap
    across, down = make(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
    if lens.skew:
        across = across + (lens.skew * matrix[0, 0] / matrix[1, 1] * (down - matrix[1, 2])).astype(np.float32)
    return across, down
