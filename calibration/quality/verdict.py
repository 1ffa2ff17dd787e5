"""Judges whether a calibration is worth using, and what it lacks: shots may pass every check and still determine too
little.

The limits were chosen on simulated sessions of 4 to 30 shots (``tests.support.board_sessions``); no command prints
them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from calibration.quality.checks import Check
from rig.messages.message import Message, compose

Word = Literal["good", "usable", "poor"]

VIEWS_LEAST, VIEWS_GOOD = 3, 6  # Zhang's method needs three; from six on its lenses hardly gain
FOCAL_POOR, FOCAL_GOOD = 0.03, 0.01  # standard deviation of the focal length, as a share of it
POSE_POOR_PX, POSE_GOOD_PX = 1.0, 0.5  # of a pose, seen at the subject
COVERED_GOOD = 0.25  # share of the picture's twelfths that hold a corner: lenses are guessed beyond


@dataclass(frozen=True, slots=True)
class CameraEvidence:
    """Holds how well one camera is calibrated. ``focal_share`` is the relative standard deviation of its focal length;
    ``covered`` is the share of twelve equal parts of the picture in which corners were seen."""

    views: int
    focal_share: float
    pose_sigma_px: float
    covered: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Holds the verdict on a calibration: good, usable or poor. ``missing`` lists what would improve it, the most
    urgent first; empty if it is good."""

    word: Word
    missing: tuple[Message, ...]


def judge(cameras: Mapping[str, CameraEvidence], checks: Sequence[Check]) -> Verdict:
    """Judges a calibration by its weakest camera, and by whether held-out shots could be checked."""
    severe, mild = [], []

    def of(test: str, least: float, most: float) -> list[str]:
        return [name for name, camera in cameras.items() if least < getattr(camera, test) <= most]

    infinite = float("inf")
    if blind := [name for name, camera in cameras.items() if camera.views < VIEWS_LEAST]:
        severe.append(compose("views-too-few", cameras=blind, views=VIEWS_LEAST))
    if vague := of("focal_share", FOCAL_POOR, infinite):
        severe.append(compose("focal-poor", cameras=vague, percent=100 * FOCAL_POOR))
    if loose := of("pose_sigma_px", POSE_POOR_PX, infinite):
        severe.append(compose("pose-loose", cameras=loose, px=POSE_POOR_PX))
    if few := [name for name, camera in cameras.items() if VIEWS_LEAST <= camera.views < VIEWS_GOOD]:
        mild.append(compose("views-too-few", cameras=few, views=VIEWS_GOOD))
    if vague := of("focal_share", FOCAL_GOOD, FOCAL_POOR):
        mild.append(compose("focal-poor", cameras=vague, percent=100 * FOCAL_GOOD))
    if loose := of("pose_sigma_px", POSE_GOOD_PX, POSE_POOR_PX):
        mild.append(compose("pose-loose", cameras=loose, px=POSE_GOOD_PX))
    if bare := [name for name, camera in cameras.items() if camera.covered < COVERED_GOOD]:
        mild.append(compose("rim-uncovered", cameras=bare))
    if any(check.name == "held-out shots" and check.passed is None for check in checks):
        mild.append(compose("held-out-missing"))
    return Verdict("poor" if severe else "usable" if mild else "good", (*severe, *mild))
