"""Finds the subject's face in the photographs: its position, its direction, and 468 landmarks."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pipeline.faces.eyes import closed_by_openings, eye_openings
from pipeline.faces.irises import Iris, UnseenEye, find_irises
from pipeline.faces.networks import load_networks
from pipeline.faces.subject import SubjectFaces, find_subject
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.recorder import Staged
from pipeline.view_checks.one_moment import judge_moments
from rig.capture import Capture


@dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """Holds the subject's face in the photographs; ``subject`` is None if the settings disable the search.

    If the views agree on the face, ``eye_openings`` holds the opening of each eye (``faces.eyes``), and ``eyes`` the
    irises, or the reasons why they were not measured.
    """

    subject: SubjectFaces | None
    eye_openings: Mapping[str, float] = field(default_factory=dict)
    eyes: Mapping[str, Iris | UnseenEye] = field(default_factory=dict)


def find_faces(context: ReconstructionContext, capture: Capture) -> Staged[Faces]:
    """Finds the subject's face in every photograph that shows it."""
    if not context.settings.faces.find:
        return Staged(Faces(None))
    subject = find_subject(  # the networks end with it: 60 MB that no later stage needs
        capture.images, context.rig, load_networks(), report=lambda share: context.progress("faces", share)
    )
    warnings = judge_moments(subject, context.rig)
    if subject.matched is None:
        return Staged(Faces(subject))
    openings = eye_openings(subject.matched, context.rig)
    irises = find_irises(subject.matched, capture.images, context.rig, closed_by_openings(openings))
    return Staged(Faces(subject, openings, irises), warnings)
