"""Defines the inputs and resources that every stage of a reconstruction may use."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol, runtime_checkable

from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from pipeline.segmentation.segment import segment
from pipeline.settings import Settings
from pipeline.view_checks.guards import Guards
from rig.capture import Capture, ReadImage
from rig.progress import Progress, discard_progress
from rig.render.compute import ComputeDevice
from rig.render.renderer import Renderer
from rig.rig import Rig


@runtime_checkable
class Segment(Protocol):
    """Declares the type of a function that computes the silhouettes of a capture, with or without a cache."""

    def __call__(self, capture: Capture, rig: Rig, /, *, report: Progress) -> dict[str, Silhouette]:
        """Returns the silhouette of every camera."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ReconstructionContext:
    """Holds one capture with all inputs of its reconstruction, and resources of the caller.

    Attributes:
        capture: the shot as it was read.
        rig: the cameras as calibrated.
        model: the head model with all its modes.
        settings: of this reconstruction.
        renderer: an OpenGL context of the calling thread.
        progress: called with a stage's name and its finished fraction; raises Cancelled to stop.
        segment: computes the silhouettes of a capture; a caller that caches them passes its own function.
        read_original: reads a picture at the size of its file, for the detail ``pores``; None where there are no files.
        device: GPU that compares the photographs; None uses the processor.
    """

    capture: Capture
    rig: Rig
    model: HeadModel
    settings: Settings
    renderer: Renderer
    progress: Progress = discard_progress
    segment: Segment = field(default=segment)
    device: ComputeDevice | None = None
    read_original: ReadImage | None = None

    @property
    def guards(self) -> Guards:
        """Returns the object through which every check refuses a capture."""
        return Guards(self.settings.anyway)

    def within_stage(self, name: str) -> "ReconstructionContext":
        """Returns a context that reports all progress under the stage ``name``, whatever name the called code gives."""
        return replace(self, progress=partial(_report_as, self.progress, name))


def _report_as(progress: Progress, stage: str, _: str, fraction: float) -> None:
    progress(stage, fraction)
