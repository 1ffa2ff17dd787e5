"""Takes away what the subject's surface mirrors, as a filter before the lens does that is crossed with those of the
lamps."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rig.render.photograph import Gallery, Part
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.sensor.preset import Preset


def matt_light(
    renderer: Renderer, rig: Rig, parts: Sequence[Part], gallery: Gallery, preset: Preset
) -> Mapping[str, Float[np.ndarray, "_ _ 4"]]:
    """Returns what the cameras see of the subject without highlights, as ``Renderer.photograph`` returns it; nothing
    where the preset does not ask for it."""
    if not preset.polarised:
        return {}
    matt = [replace(part, oil=None, grain=replace(part.grain, gloss=0.0)) for part in parts]
    return renderer.photograph(rig, matt, gallery, samples=preset.samples)
