"""Decides about every refusal of a capture.

A capture is refused only if two independent kinds of evidence agree that the head would be wrong. Missing or damaged
input is refused when it is read.

Given the error that a check would raise, the module raises it or returns a warning instead.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

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
DAMAGED = ("pictures-the-same",)  # codes of refusals that leave no head possible


@dataclass(frozen=True, slots=True, eq=False)
class FaceEvidence:
    """Holds what the subject's face shows about a capture: where the face is, which way is up, and which views show it
    there. The face has a human's size, and its landmarks triangulate within their noise.

    ``missed`` are the views that do not show the face at its predicted position, although they must see it.
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
        """Returns the point (world frame, mm) that lies ``from_face_mm`` behind the face."""
        return self.centre_world + self.rotation @ np.array(from_face_mm)

    @property
    def holds_the_rig(self) -> bool:
        """Returns True if most cameras in front of the face show it where the calibration predicts it."""
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
    """Decides whether a capture is refused. With ``anyway``, a refusal becomes a warning that the pose is doubtful."""

    anyway: bool = False
    find_face: FindFace = find_face_evidence

    def refuse(self, refusal: EigenheadError) -> ReportWarning:
        """Raises the refusal, or returns the warning that takes its place."""
        if not self.anyway or refusal.message.code in DAMAGED:
            raise refusal
        return compose("pose-doubtful", finding=compose("refusal-overruled", refusal=refusal.message))


STRICT = Guards()
