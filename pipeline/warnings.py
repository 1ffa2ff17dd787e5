"""Defines the codes of warnings for the operator, and the value that states the level of detail of a fit."""

from dataclasses import dataclass
from typing import Literal

from rig.messages.message import Message

WARNING_CODES = (
    "bust-guessed",
    "camera-gain",
    "camera-moved",
    "cameras-exchanged",
    "cameras-scaled",
    "cameras-uneven",
    "cap-not-found",
    "contour-implausible",
    "crown-low",
    "expression-doubtful",
    "eyes-closed",
    "face-elsewhere",
    "face-unseen",
    "features",
    "file-unread",
    "hair-beyond-head",
    "lens-doubtful",
    "level-lowered",
    "mask-contradicted",
    "mask-doubtful",
    "mask-inverted",
    "mask-loose",
    "mask-specks",
    "mask-undecided",
    "masks-exchanged",
    "masks-of-alpha",
    "masks-off-edges",
    "masks-turned",
    "moments-differ",
    "no-albedo",
    "no-bust",
    "no-chart",
    "no-face",
    "no-pores",
    "no-texture",
    "no-texture-layout",
    "old-setting",
    "outlines-loose",
    "outlines-unexplained",
    "picture-duplicated",
    "picture-levels",
    "picture-lost",
    "pictures-grey",
    "plates-exchanged",
    "pose-doubtful",
    "rims-empty",
    "scale-assumed",
    "scale-implausible",
    "setting-renamed",
    "size-unusual",
    "texture-sets-exchanged",
    "texture-sets-unused",
    "unknown-key",
    "view",
    "view-left-out",
    "view-unlike",
    "views-many",
)
"""Codes that a result's warnings may have; docs/operator.md says what each means and what to do."""


ReportWarning = Message
"""A warning of a result: a message whose code is one of ``WARNING_CODES``."""


@dataclass(frozen=True, slots=True)
class Detail:
    """Holds the level of detail that the fit reached, and the reason why it was not higher or lower."""

    level: Literal["span", "kernel", "photo", "fine"]
    reason: Message
