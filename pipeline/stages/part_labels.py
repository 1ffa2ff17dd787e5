"""Labels each pixel as skin, hair or clothes, and finds a cap of known colour."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from pipeline.head_model.gaussian_process import model_basis
from pipeline.head_model.model import HeadModel
from pipeline.part_labels.cap import Cap, find_cap
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap, classify_parts
from pipeline.part_labels.votes import parts_shown
from pipeline.settings import PHOTO_LEVELS
from pipeline.stages.alignment import Alignment
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.recorder import Staged
from pipeline.stages.views import Views
from rig.camera import Camera
from rig.colour_space import linear_from_srgb, srgb_from_text
from rig.mesh import Mesh
from rig.messages.message import compose


@dataclass(frozen=True, slots=True, eq=False)
class PartLabels:
    """Holds, for each camera, a map of the probabilities of skin, hair and clothes at every pixel; empty if no stage
    needs the maps. A ``cap`` counts as clothes."""

    maps: Mapping[str, PartMap]
    cap: Cap | None = None

    def hiding_probability(self) -> "OnePart":
        """Returns, for each camera, the probability at every pixel that hair or a cap hides the skin."""
        return OnePart(self.maps, Part.HAIR, {} if self.cap is None else self.cap.masks)

    def shares(self, camera: Camera, points: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
        """Returns the probabilities (0 to 1) that a view shows skin, hair and clothes at points (world frame, mm).
        Without a map everything counts as skin."""
        if camera.name not in self.maps:
            return np.tile([1.0, 0.0, 0.0], (len(points), 1))
        return parts_shown(points, self.maps[camera.name], camera)

    def skin_probability(self) -> "OnePart":
        """Returns, for each camera, the probability of skin at every pixel."""
        return OnePart(self.maps, Part.SKIN)


@dataclass(frozen=True, slots=True, eq=False)
class OnePart(Mapping[str, Float32[ndarray, "_ _"]]):
    """Holds the probability of one part at every pixel, by camera; it is 1 where one of the ``masks`` is true. A map is
    computed only when it is read, to save memory."""

    maps: Mapping[str, PartMap]
    part: Part
    masks: Mapping[str, Bool[ndarray, "_ _"]] = field(default_factory=dict)

    def __getitem__(self, camera: str) -> Float32[ndarray, "_ _"]:
        probability = self.maps[camera].probability_of(self.part)
        if camera in self.masks:
            probability[self.masks[camera]] = 1.0
        return probability

    def __iter__(self) -> Iterator[str]:
        return iter(self.maps)

    def __len__(self) -> int:
        return len(self.maps)


def find_worn_cap(context: ReconstructionContext, views: Views, alignment: Alignment) -> Staged[Cap | None]:
    """Finds the cap in the photographs by the colour in the settings, on the aligned mean head. Returns None if the
    settings name no cap. Returns None with the warning ``cap-not-found`` if the photographs do not show the cap."""
    settings = context.settings.cap
    if settings.colour is None:
        return Staged(None)
    model = model_basis(context.model, context.settings)
    full, head = model.levels["full"], alignment.world_from_head.apply(model.vertices(np.zeros(0)))
    cap = find_cap(
        views.capture.images,
        {name: each.mask for name, each in views.silhouettes.items() if each.quality.usable},
        context.rig,
        Mesh(head, full.faces),
        full.face_region,
        {name: head[vertex] for name, vertex in model.landmarks.items()},
        colour=linear_from_srgb(np.array(srgb_from_text(settings.colour))),
        thickness_mm=settings.thickness_mm,
    )
    if cap.is_found:
        return Staged(cap)
    return Staged(None, [compose("cap-not-found", colour=settings.colour, share=cap.share)])


def label_parts(
    context: ReconstructionContext, views: Views, model: HeadModel, head_world: Mesh, cap: Cap | None
) -> Staged[PartLabels]:
    """Labels the pixels of every photograph as skin, hair or clothes, starting from the fitted head ``head_world`` (mm)
    with the vertices of ``model``. Pixels of the ``cap`` count as clothes."""
    settings = context.settings
    if settings.detail not in PHOTO_LEVELS and settings.outputs.surface == "head":
        return Staged(PartLabels({}, cap))
    landmarks_world = {name: head_world.vertices[vertex] for name, vertex in model.landmarks.items()}
    images, face, rig = views.capture.images, model.levels["full"].face_region, context.rig
    maps = classify_parts(images, views.silhouettes, rig, head_world, face, landmarks_world, report=context.progress)
    return Staged(PartLabels({name: _with_cap(part, cap) for name, part in maps.items()}, cap))


def _with_cap(part: PartMap, cap: Cap | None) -> PartMap:
    return part if cap is None or part.camera not in cap.masks else part.with_clothes(cap.masks[part.camera])
