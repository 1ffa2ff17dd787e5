"""Lists all guards, and refuses captures: every refusal goes through this module.

A guard refuses a capture only if two independent kinds of evidence agree and the head would otherwise be wrong. Missing
or damaged input needs no such evidence: its reader refuses it.

In: the error that a check would raise, and the face in the photographs. Out: that error, or a warning instead.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from pipeline.faces.networks import load_networks
from pipeline.faces.subject import SearchEffort, find_subject
from pipeline.warnings import ReportWarning
from rig.errors import EigenheadError
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.rig import Rig

MIN_FACE_VIEWS = 2  # one view does not tell a face's size


@dataclass(frozen=True, slots=True)
class Guard:
    """Describes a check that can refuse a capture or leave a view out.

    Attributes:
        codes: of its messages.
        evidence: the independent kinds of evidence that must agree.
        prevents: what would be delivered without it.
        kind: ``refuses`` the capture, or ``warns`` or leaves a view out. ``damaged`` input leaves no head possible.
    """

    codes: tuple[str, ...]
    evidence: tuple[str, ...]
    prevents: str
    kind: Literal["refuses", "warns", "damaged"] = "refuses"


GUARDS = (
    Guard(("size-refused",), ("diameters in the outlines, of views whose middles meet",
          "no face of a human's size in the photographs"),
          "a head of the wrong size, in outlines that all count as clutter"),
    Guard(("too-few-views",), ("outlines of fewer than three views are usable", "no face that two views agree on"),
          "a head without a pose"),
    Guard(("pictures-exchanged",), ("tangent planes agree after an exchange",
          "the face is not where the pictures as filed show it"), "a head of pictures under wrong cameras"),
    Guard(("pictures-the-same",), ("pictures are equal in every pixel", "fewer than three differ"), "a flat head",
          kind="damaged"),
    Guard(("other-rig", "other-lenses", "other-convention", "principal-points-from-below", "rig-mirrored",
           "pictures-flipped", "pictures-turned"),
          ("tangent planes miss the outlines", "the face's landmarks do not meet in most cameras before it"),
          "a distorted head of wrong cameras"),
    Guard(("outlines-unexplained",), ("the fitted head explains hardly any outline",
          "the face lies elsewhere than the head's"), "another head than the subject's"),
    Guard(("features-beside-face", "features-of-size", "features-from-bottom", "features-transposed",
           "features-of-other-pictures", "features-of-no-landmark", "features-sides-exchanged", "too-few-features",
           "too-few-features-remarks"),
          ("feature points contradict each other or a head", "the face in the photographs, where there is one"),
          "a head turned by wrong feature points"),
    Guard(("no-subject",), ("outlines have no volume in common", "no face that two views agree on"), "a head anywhere"),
    Guard(("camera-moved",), ("tangent planes of one camera agree on a shift", "the others agree without it"),
          "a head widened by one camera", kind="warns"),
    Guard(("view-left-out",), ("contrast along the outline, or area against the other cameras",),
          "a head pressed into a wrong outline", kind="warns"),
    Guard(("mask-contradicted",), ("dense depth of other views outside a silhouette",), "a cut bust", kind="warns"),
    Guard(("crown-low",), ("planes that touch the crown", "the face says where the skull is"), "a head with a flat top",
          kind="warns"),
    Guard(("moments-differ",), ("landmarks of a view against those of the others",), "a face between two moments",
          kind="warns"),
    Guard(("view-unlike",), ("colours of a view against the others', on the fitted head",),
          "a face between two moments", kind="warns"),
    Guard(("lens-doubtful",), ("rays of points on the subject",), "a head bent by a wrong lens", kind="warns"),
    Guard(("mask-loose",), ("tangent planes of one camera",), "a head widened by a loose mask", kind="warns"),
    Guard(("scale-implausible",), ("diameters in the outlines",), "a head of the wrong size", kind="warns"),
    Guard(("outlines-loose",), ("tangent planes of most cameras",), "a head widened by loose masks", kind="warns"),
)  # fmt: skip
_BY_CODE = {code: guard for guard in GUARDS for code in guard.codes}


@dataclass(frozen=True, slots=True, eq=False)
class FaceEvidence:
    """Holds the evidence of the subject's face about the capture: where the face is, which way is up, and which views
    show it there. The face has a human's size, and its landmarks meet within their noise.

    ``missed`` are the views that must show the face but do not show it there.
    """

    centre_world: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]  # world from face: leftwards, up, ahead
    views: tuple[str, ...]
    missed: tuple[str, ...]

    @property
    def up_world(self) -> Float[np.ndarray, " 3"]:
        """Returns the subject's upward direction."""
        return self.rotation[:, 1]

    def skull_world(self, from_face_mm: tuple[float, float, float]) -> Float[np.ndarray, " 3"]:
        """Returns the point ``from_face_mm`` behind the face."""
        return self.centre_world + self.rotation @ np.array(from_face_mm)

    @property
    def holds_the_rig(self) -> bool:
        """Tells whether most cameras in front of the face show it where the calibration predicts it."""
        return len(self.views) > 2 * len(self.missed)


def find_face_evidence(images: Mapping[str, ImageRgb], rig: Rig) -> FaceEvidence | None:
    """Finds the subject's face; None if no two photographs agree on a face of a human's size."""
    subject = find_subject(images, rig, load_networks(), effort=SearchEffort(with_eyes=False))
    face = subject.matched
    if face is None or len(face.detections) < MIN_FACE_VIEWS:
        return None
    missed = tuple(name for name in subject.expected if name not in face.detections)
    placed = face.world_from_face
    return FaceEvidence(placed.translation, placed.rotation, tuple(face.detections), missed)


FindFace = Callable[[Mapping[str, ImageRgb], Rig], FaceEvidence | None]


@dataclass(frozen=True, slots=True)
class Guards:
    """Decides whether a capture is refused. With ``anyway``, a refusal becomes a warning of a doubtful pose."""

    anyway: bool = False
    find_face: FindFace = find_face_evidence

    def refuse(self, refusal: EigenheadError) -> ReportWarning:
        """Raises the refusal, or returns the warning that replaces it. Raises KeyError for a refusal that is not in the
        list of guards."""
        if not self.anyway or _BY_CODE[refusal.message.code].kind == "damaged":
            raise refusal
        return compose("pose-doubtful", finding=compose("refusal-overruled", refusal=refusal.message))


STRICT = Guards()
