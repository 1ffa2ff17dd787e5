"""Labels what the pixels show: skin, hair or clothes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from jaxtyping import Float32
from numpy import ndarray

from pipeline.head_model.model import HeadModel
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap, classify_parts
from pipeline.settings import PHOTO_LEVELS
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.recorder import Staged, stage
from pipeline.stages.views import Views
from rig.mesh import Mesh


@dataclass(frozen=True, slots=True, eq=False)
class PartLabels:
    """Holds the part map of each camera, the probabilities of skin, hair and clothes at every pixel; empty if no stage
    needs them."""

    maps: Mapping[str, PartMap]

    def hair_probability(self) -> "OnePart":
        """Returns, for each camera, the probability of hair at every pixel."""
        return OnePart(self.maps, Part.HAIR)

    def skin_probability(self) -> "OnePart":
        """Returns, for each camera, the probability of skin at every pixel."""
        return OnePart(self.maps, Part.SKIN)


@dataclass(frozen=True, slots=True, eq=False)
class OnePart(Mapping[str, Float32[ndarray, "_ _"]]):
    """Gives the probability of one part at every pixel, by camera. Each map is computed when it is read: all of them
    would take four times the memory of what they follow from."""

    maps: Mapping[str, PartMap]
    part: Part

    def __getitem__(self, camera: str) -> Float32[ndarray, "_ _"]:
        return self.maps[camera].probability_of(self.part)

    def __iter__(self) -> Iterator[str]:
        return iter(self.maps)

    def __len__(self) -> int:
        return len(self.maps)


@stage("parts")
def label_parts(context: ReconstructionContext, views: Views, model: HeadModel, head_world: Mesh) -> Staged[PartLabels]:
    """Labels the pixels of every photograph as skin, hair or clothes, starting from a fitted head: ``head_world`` (mm),
    whose vertices are those of ``model``."""
    settings = context.settings
    if settings.detail not in PHOTO_LEVELS and settings.outputs.surface == "head":
        return Staged(PartLabels({}))
    landmarks_world = {name: head_world.vertices[vertex] for name, vertex in model.landmarks.items()}
    maps = classify_parts(
        views.capture.images,
        views.silhouettes,
        context.rig,
        head_world,
        model.levels["full"].face_region,
        landmarks_world,
        settings=settings.parts,
        report=context.progress,
    )
    return Staged(PartLabels(maps))
