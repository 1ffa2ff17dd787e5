"""The whole visible surface of a capture, coloured: from the photographs and the fitted head to ``Bust``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.dense.depth_map import DepthMap
from pipeline.dense.part_votes import PartVotes
from pipeline.dense.surface.fusion import BustSurface, fuse
from pipeline.dense.window_bias import WindowBias
from pipeline.imaging.cpu_raster import depth_maps as rastered_depths
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import Settings
from pipeline.texture.vertex_colours import texture
from rig.capture import Capture
from rig.mesh import Mesh
from rig.rig import Rig

Report = Callable[[str, float], None]


@dataclass(frozen=True, slots=True, eq=False)
class Bust:
    """A closed surface of all that the cameras see, with its colours (sRGB). ``views`` are the images that coloured a
    vertex, 0 = filled from its neighbours."""

    surface: BustSurface
    normals: Float[np.ndarray, "v 3"]
    colours: UInt8[np.ndarray, "v 3"]
    views: UInt8[np.ndarray, " v"]
    spacing_mm: float

    @property
    def mesh_world(self) -> Mesh:
        return self.surface.mesh_world


def make_bust(
    depth_maps: Sequence[DepthMap],
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    head_world: Mesh,
    votes: PartVotes | None,
    bias: WindowBias,
    settings: Settings,
    *,
    head_skin_world: Mesh | None = None,
    report: Report,
) -> Bust:
    """The fused surface in the photographs' colours, hidden by its own parts where these stand before each other.

    Raises NoSurface where fewer than three views know any depth.
    """
    given = (depth_maps, silhouettes, rig, head_world, votes, bias, settings.bust)
    surface = fuse(*given, head_skin_world=head_skin_world, report=report)
    mesh = surface.mesh_world
    normals = mesh.normals()
    depths = rastered_depths(rig, mesh)
    coloured = texture(mesh, normals, capture, silhouettes, rig, depths, settings.texture)
    return Bust(surface, normals, coloured.colours, coloured.views, settings.bust.spacing_mm)
