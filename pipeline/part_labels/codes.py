"""Defines the parts that a surface shows, as ``bust.ply`` stores them, and the channel of each in a map of
probabilities.

The last axis of a map holds skin, hair and clothes; there is no channel for unseen surface. All conversions between
codes and channels are here.
"""

from enum import IntEnum

import numpy as np
from jaxtyping import Int, UInt8


class Part(IntEnum):
    """Names the part of the subject at a vertex or a point of the surface. The numbers are stored in files and never
    change."""

    UNSEEN = 0
    SKIN = 1
    HAIR = 2
    CLOTHES = 3

    @property
    def channel(self) -> int:
        """Returns the part's index along the last axis of probabilities. Raises ValueError for UNSEEN."""
        return CHANNELS.index(self)


CHANNELS = (Part.SKIN, Part.HAIR, Part.CLOTHES)
"""The part of every channel."""


def codes_from_channels(channels: Int[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """Returns the code of the part that belongs to each channel."""
    return np.array(CHANNELS, np.uint8)[channels]
