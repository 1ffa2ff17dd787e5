"""The subject's face in the photographs: where it is, how it is turned, 468 landmarks on it."""

from dataclasses import dataclass

from pipeline.faces.subject import SubjectFaces, find_subject
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.recorder import Staged, stage
from rig.capture import Capture


@dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """What the networks found; None where the settings do not ask them."""

    subject: SubjectFaces | None


@stage("faces")
def find_faces(context: ReconstructionContext, capture: Capture) -> Staged[Faces]:
    """Finds the subject's face in every photograph that shows it."""
    if not context.settings.faces.find:
        return Staged(Faces(None))
    subject = find_subject(
        capture.images, context.rig, context.networks, report=lambda share: context.progress("faces", share)
    )
    return Staged(Faces(subject))
