"""Decides which level of a mask is the subject: white by our convention, black where programs mark what to ignore.

Background covers all borders of a picture but one (the subject's shoulders fill the bottom, or another side if the
camera hangs on its side), and the subject covers the middle. A mask is inverted if both criteria say so. They
contradict each other for a close-up that fills the frame and for a subject beside the middle; such views follow the
majority of the others."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

Convention = Literal["white", "black"]

BORDER_MARGIN = 0.15  # of the borders' length, by which one convention must fit better: shoulders leave 0.25 and more
MIDDLE_RADIUS = 0.06  # of the picture's longer side: half a face
MIDDLE_MARGIN = 0.3  # by which the share of white in the middle must differ from one half


def subject_convention(
    mask: Bool[np.ndarray, "h w"], middle_px: Float[np.ndarray, " 2"] | None = None
) -> Convention | None:
    """Returns which level is the subject, by this mask alone: white or black; None if the criteria disagree.

    Args:
        mask: True where it is white.
        middle_px: pixel of the point at which the cameras look; by default the middle of the picture.
    """
    sides = np.sort([mask[0].mean(), mask[-1].mean(), mask[:, 0].mean(), mask[:, -1].mean()])
    white_at_borders, black_at_borders = float(sides[:3].mean()), float(1.0 - sides[1:].mean())
    height, width = mask.shape
    x, y = ((width - 1) / 2, (height - 1) / 2) if middle_px is None else middle_px
    reach = max(1, round(MIDDLE_RADIUS * max(width, height)))
    column, row = int(np.clip(x, 0, width - 1)), int(np.clip(y, 0, height - 1))
    about = mask[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
    inside = float(about.mean()) - 0.5
    if white_at_borders + BORDER_MARGIN < black_at_borders and inside > MIDDLE_MARGIN:
        return "white"
    if black_at_borders + BORDER_MARGIN < white_at_borders and inside < -MIDDLE_MARGIN:
        return "black"
    return None


def inverted_masks(
    masks: Mapping[str, Bool[np.ndarray, "_ _"]], middles_px: Mapping[str, Float[np.ndarray, " 2"]]
) -> list[str]:
    """Returns the names of the masks whose subject is black. Undecided masks follow the majority of the others.

    Args:
        masks: by camera, True where they are white.
        middles_px: by camera, the pixel of the point at which all cameras look.
    """
    said = {name: subject_convention(mask, middles_px.get(name)) for name, mask in masks.items()}
    black = [name for name, convention in said.items() if convention == "black"]
    white = [name for name, convention in said.items() if convention == "white"]
    follow = len(black) > len(white)
    return [name for name, convention in said.items() if convention == "black" or (convention is None and follow)]
