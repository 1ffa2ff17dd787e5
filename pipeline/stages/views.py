"""Finds the silhouettes (the paper's section 5.4), and decides which views are used."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.imaging.silhouette import Silhouette
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.recorder import Staged
from pipeline.view_checks.lens_distortion import judge_distortion
from pipeline.view_checks.usable_views import usable_views
from rig.capture import Capture


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Holds the capture with every picture under the right camera, and silhouettes; excluded views are marked as not
    usable.

    For each camera that had a wrong picture, ``assignment`` has the name under which the correct one was filed.
    """

    capture: Capture
    silhouettes: Mapping[str, Silhouette]
    assignment: Mapping[str, str]


def find_views(context: ReconstructionContext) -> Staged[Views]:
    """Finds the silhouettes of the capture and decides which views are used. Refuses with TooFewViews,
    ExchangedPictures, WrongRig, WrongScale."""
    settings, rig = context.settings, context.rig

    def segmented(capture: Capture) -> dict[str, Silhouette]:
        return context.segment(capture, rig, report=context.progress)

    found = usable_views(context.capture, rig, segmented, exchanged=settings.exchanged_pictures, guards=context.guards)
    return Staged(Views(found.capture, found.silhouettes, found.pictures), [*settings.warnings, *found.warnings])


def check_lenses(context: ReconstructionContext, views: Views) -> Staged[None]:
    """Warns if only the rig or only the pictures have lens distortion."""
    return Staged(None, judge_distortion(views.capture.images, views.silhouettes, context.rig))
