"""Finds the silhouettes (section 5.4), and decides which views take part."""

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
    """Holds the capture with every picture under the right camera, and its silhouettes; views that take no part are
    marked as not usable.

    ``assignment`` has an entry for each camera under whose name another's picture was filed: the name under which its
    own was found.
    """

    capture: Capture
    silhouettes: Mapping[str, Silhouette]
    assignment: Mapping[str, str]


def find_views(context: ReconstructionContext) -> Staged[Views]:
    """Finds the silhouettes of the capture and decides which views take part. Refuses with TooFewViews,
    ExchangedPictures, WrongRig, WrongScale."""
    settings, rig = context.settings, context.rig

    def segmented(capture: Capture) -> dict[str, Silhouette]:
        return context.segment(capture, rig, report=context.progress)

    found = usable_views(context.capture, rig, segmented, exchanged=settings.exchanged_pictures, guards=context.guards)
    return Staged(Views(found.capture, found.silhouettes, found.pictures), [*settings.warnings, *found.warnings])


def check_lenses(context: ReconstructionContext, views: Views) -> Staged[None]:
    """Warns if the pictures were undistorted though the rig has distortion, or the other way round."""
    return Staged(None, judge_distortion(views.capture.images, views.silhouettes, context.rig))
