"""Whether a calibration is worth using, and what it lacks: shots may pass every check and still say too little.

The limits were chosen on planted sessions of 4 to 30 shots (``tests.support.board_sessions``); nothing prints them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from calibration.quality.checks import Check

Word = Literal["good", "usable", "poor"]

VIEWS_LEAST, VIEWS_GOOD = 3, 6  # Zhang's method needs three; from six on its lenses hardly gain
FOCAL_POOR, FOCAL_GOOD = 0.03, 0.01  # standard deviation of the focal length, as a share of it
POSE_POOR_PX, POSE_GOOD_PX = 1.0, 0.5  # of a pose, seen at the subject
COVERED_GOOD = 0.25  # share of the picture's twelfths that hold a corner: lenses are guessed beyond


@dataclass(frozen=True, slots=True)
class CameraEvidence:
    """``focal_share``: standard deviation of the focal length over it; ``covered``: share of the picture's twelfths."""

    views: int
    focal_share: float
    pose_sigma_px: float
    covered: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """``missing``: what would make it better, most urgent first; empty where it is good."""

    word: Word
    missing: tuple[str, ...]


def judge(cameras: Mapping[str, CameraEvidence], checks: Sequence[Check]) -> Verdict:
    """By its weakest camera."""
    severe, mild = [], []

    def say(where: list[str], names: list[str], what: str) -> None:
        if names:
            where.append(f"{', '.join(names)}: {what}")

    def of(test: str, least: float, most: float) -> list[str]:
        return [name for name, camera in cameras.items() if least < getattr(camera, test) <= most]

    infinite = float("inf")
    blind = [name for name, camera in cameras.items() if camera.views < VIEWS_LEAST]
    say(severe, blind, f"fewer than {VIEWS_LEAST} views of the board: turn it towards them in further shots")
    say(severe, of("focal_share", FOCAL_POOR, infinite), _focal(FOCAL_POOR))
    say(severe, of("pose_sigma_px", POSE_POOR_PX, infinite), _pose(POSE_POOR_PX))
    few = [name for name, camera in cameras.items() if VIEWS_LEAST <= camera.views < VIEWS_GOOD]
    say(mild, few, f"fewer than {VIEWS_GOOD} views of the board: turn it towards them in further shots")
    say(mild, of("focal_share", FOCAL_GOOD, FOCAL_POOR), _focal(FOCAL_GOOD))
    say(mild, of("pose_sigma_px", POSE_GOOD_PX, POSE_POOR_PX), _pose(POSE_GOOD_PX))
    bare = [name for name, camera in cameras.items() if camera.covered < COVERED_GOOD]
    say(mild, bare, "the board was never near the rim of the picture: bring it there")
    if any(check.name == "held-out shots" and check.passed is None for check in checks):
        mild.append("too few shots to hold some out and see whether the others foretell them: take 15 in all")
    return Verdict("poor" if severe else "usable" if mild else "good", (*severe, *mild))


def _focal(share: float) -> str:
    return f"focal length known no better than {100 * share:.0f} %: take shots with the board tilted, near and far"


def _pose(pixels: float) -> str:
    return f"pose looser than {pixels:.1f} px at the subject: take shots that they and their neighbours see at once"
