"""Defines the labels skin, hair and clothes (parts), their codes in ``bust.ply``, and their channels in a map of
probabilities.

A map's last axis holds skin, hair and clothes; there is no channel for surface that no camera sees. This module
contains all conversions between codes and channels."""

from enum import IntEnum

import numpy as np
from jaxtyping import Int, UInt8


class Part(IntEnum):
    """Names the label (skin, hair or clothes) of a vertex or surface point. The codes' numbers are stored in files and
    must not change."""

    UNSEEN = 0
    SKIN = 1
    HAIR = 2
    CLOTHES = 3

    @property
    def channel(self) -> int:
        """Returns the label's index along the last axis of a map of probabilities. Raises ValueError for UNSEEN."""
        return CHANNELS.index(self)


CHANNELS = (Part.SKIN, Part.HAIR, Part.CLOTHES)
"""The part of every channel."""


def codes_from_channels(channels: Int[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """Returns the label's code for each channel of a map of probabilities."""
    return np.array(CHANNELS, np.uint8)[channels]
