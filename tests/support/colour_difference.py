"""Computes CIEDE2000, the visible difference of two colours (CIE 142-2001)."""

import numpy as np
from jaxtyping import Float, UInt8

from rig.colour_space import linear_from_srgb

XYZ_FROM_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)  # IEC 61966-2-1, D65


def lab_from_srgb(codes: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Converts sRGB codes to CIE L*a*b*, D65. (OpenCV's tables are wrong by up to 0.2.)"""
    xyz = linear_from_srgb(codes / 255.0) @ (XYZ_FROM_RGB / XYZ_FROM_RGB.sum(axis=1, keepdims=True)).T
    x, y, z = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


def difference_2000(one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Computes CIEDE2000 of pairs of L*a*b* colours, with all weights k = 1 (Sharma, Wu and Dalal, *The CIEDE2000
    Color-Difference Formula*, Color Research and Application 2005, whose equations the comments number)."""
    (l1, a1, b1), (l2, a2, b2) = one.T, other.T
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    stretch = 1.5 - 0.5 * np.sqrt(mean**7 / (mean**7 + 25.0**7))  # eq. (4), and 1 added as eq. (5) has it
    a1, a2 = stretch * a1, stretch * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)  # eq. (6)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360 for a, b in ((a1, b1), (a2, b2)))  # eq. (7)
    grey = c1 * c2 == 0
    turn = np.where(grey, 0.0, (h2 - h1 + 180) % 360 - 180)  # eq. (10)
    turn = np.where((turn == -180) & (h2 > h1), 180.0, turn)
    dl, dc, dh = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn) / 2)  # eq. (8), (9), (11)
    light, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    far = np.abs(h1 - h2) > 180
    hue = (h1 + h2 + np.where(far, np.where(h1 + h2 < 360, 360.0, -360.0), 0.0)) / 2  # eq. (14)
    hue = np.where(grey, h1 + h2, hue)
    waves = (
        1
        - 0.17 * np.cos(np.radians(hue - 30))
        + 0.24 * np.cos(np.radians(2 * hue))
        + 0.32 * np.cos(np.radians(3 * hue + 6))
        - 0.20 * np.cos(np.radians(4 * hue - 63))
    )  # eq. (15)
    turning = 60 * np.exp(-(((hue - 275) / 25) ** 2))  # twice eq. (16)
    rotation = -np.sin(np.radians(turning)) * 2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))  # eq. (17), (21)
    dl /= 1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2)  # eq. (18)
    dc /= 1 + 0.045 * chroma  # eq. (19)
    dh /= 1 + 0.015 * chroma * waves  # eq. (20)
    return np.sqrt(np.maximum(dl**2 + dc**2 + dh**2 + rotation * dc * dh, 0.0))  # eq. (22)
