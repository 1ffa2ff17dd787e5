"""Finds the subject's face in the photographs: where it is, how it is turned, and 468 landmarks on it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pipeline.detail.eyelids import MIN_HALF_OPENING
from pipeline.faces.eyes import eye_openings
from pipeline.faces.irises import Iris, UnseenEye, find_irises
from pipeline.faces.networks import load_networks
from pipeline.faces.subject import SubjectFaces, find_subject
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.recorder import Staged
from pipeline.stages.views import Views, without_odd_views
from pipeline.view_checks.one_moment import OddView, check_one_moment, without_views
from pipeline.view_checks.usable_views import MIN_VIEWS
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """Holds the subject's faces in the photographs; ``subject`` is None if the settings do not ask for them.

    ``eye_openings`` says how far the lids of each eye stand apart (``faces.eyes``), and ``eyes`` has the irises or why
    they are not seen, if the views agree on the subject's face. ``contradicting``: views that show another moment or
    person than the others, and are kept since it is not known which are right.
    """

    subject: SubjectFaces | None
    eye_openings: Mapping[str, float] = field(default_factory=dict)
    eyes: Mapping[str, Iris | UnseenEye] = field(default_factory=dict)
    contradicting: tuple[OddView, ...] = ()


def find_faces(context: ReconstructionContext, views: Views) -> Staged[tuple[Views, Faces]]:
    """Finds the subject's face in every photograph that shows it. Views of another moment or of another person are
    left out where it is certain and ``MIN_VIEWS`` others remain."""
    if not context.settings.faces.find:
        return Staged((views, Faces(None)))
    images, rig = views.capture.images, context.rig
    subject = find_subject(  # the networks end with it: 60 MB that no later stage needs
        images, rig, load_networks(), report=lambda share: context.progress("faces", share)
    )
    check = check_one_moment(subject, images, rig)
    odd = [view.camera for view in check.odd]
    fewer = without_odd_views(views, odd)
    if odd and check.certain and fewer.count_usable() >= MIN_VIEWS:
        faces = _measure_eyes(without_views(subject, odd, rig), images, rig)
        warnings = [compose("moments-differ", camera=view.camera, offset_mm=view.offset_mm) for view in check.odd]
        return Staged((fewer, faces), warnings)
    return Staged((views, replace(_measure_eyes(subject, images, rig), contradicting=check.odd)))


def _measure_eyes(subject: SubjectFaces, images: Mapping[str, ImageRgb], rig: Rig) -> Faces:
    """Returns the subject's faces with what they show of the eyes."""
    if subject.matched is None:
        return Faces(subject)
    openings = eye_openings(subject.matched, rig)
    closed = frozenset(side for side, opening in openings.items() if opening < MIN_HALF_OPENING)
    return Faces(subject, openings, find_irises(subject.matched, images, rig, closed))
