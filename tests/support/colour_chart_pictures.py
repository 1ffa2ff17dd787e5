"""Photographs a colour chart where the subject will sit, as a clean plate from which true colours are found.

It is a flat ColorChecker Classic (279 x 190 mm) at the position of the head, turned to one camera, in the studio's
light.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rig.studio.scene.lights import LAMPS, Lamp, dome
from rig.studio.scene.simulate import Scene
from rig.studio.sensor.sensor import expose, focus

WIDTH_MM, HEIGHT_MM = 279.0, 190.0
PATCH_PX, GAP_PX = 48, 8
FRAME = 0.03  # linear, between the patches
SUPERSAMPLED = 2


def chart_picture(patches: Float[np.ndarray, "24 3"]) -> Float[np.ndarray, "h w 3"]:
    """Draws the colour chart by itself: four rows of six patches, linear reflectances."""
    step = PATCH_PX + GAP_PX
    picture = np.full((4 * step + GAP_PX, 6 * step + GAP_PX, 3), FRAME, np.float32)
    for i, colour in enumerate(patches):
        y, x = GAP_PX + step * (i // 6), GAP_PX + step * (i % 6)
        picture[y : y + PATCH_PX, x : x + PATCH_PX] = colour
    return picture


def chart_plate(
    scene: Scene,
    camera: str,
    patches: Float[np.ndarray, "24 3"],
    rng: np.random.Generator,
    *,
    turned_to: str,
    lamps: Sequence[Lamp] = LAMPS,
) -> UInt8[np.ndarray, "h w 3"]:
    """Takes a clean plate with ``camera`` of the empty studio with the colour chart in the subject's place. The chart
    faces the camera ``turned_to``."""
    seen, view = scene.true_rig[camera], scene.views[camera]
    middle = scene.world_from_head.translation
    normal = scene.true_rig[turned_to].centre_world - middle
    normal = normal / np.linalg.norm(normal)
    right = np.cross((0.0, 1.0, 0.0), normal)  # as who looks at the chart has it
    right = right / np.linalg.norm(right)
    up = np.cross(normal, right)
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * (WIDTH_MM / 2, HEIGHT_MM / 2)
    directions, sent = dome(lamps)
    light = np.clip(directions @ normal, 0.0, None) @ sent
    chart = (chart_picture(patches) * light).astype(np.float32)
    height, width = chart.shape[:2]
    there = seen.project(middle + corners @ np.stack([right, up]))
    place = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
    matrix = cv2.getPerspectiveTransform(place, there.astype(np.float32))
    scale = np.diag([SUPERSAMPLED, SUPERSAMPLED, 1.0])
    rows, columns = view.backdrop.shape[:2]
    large = cv2.warpPerspective(
        np.dstack([chart, np.ones(chart.shape[:2], np.float32)]),
        scale @ matrix,
        (SUPERSAMPLED * columns, SUPERSAMPLED * rows),
    )
    drawn = cv2.resize(large, (columns, rows), interpolation=cv2.INTER_AREA)
    return expose(focus(drawn[:, :, :3] + (1 - drawn[:, :, 3:]) * view.backdrop, view.sensor), view.sensor, rng)
