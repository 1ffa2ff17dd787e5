"""Lists every code with its English template. A code is stable; its template may be reworded at any time.

A new message needs: its code and template in a module of ``rig/messages/english``, its German in
``server/console/static/messages_de.js``, and ``compose(code, ...)`` where it is used. Tests hold the three together.
"""

from collections.abc import Mapping
from types import MappingProxyType, ModuleType

from rig.messages.english import batch, calibration, cameras, formats, general, pipeline, rig, server

AREAS: tuple[ModuleType, ...] = (batch, calibration, cameras, formats, general, pipeline, rig, server)


def _all() -> dict[str, str]:
    templates: dict[str, str] = {}
    for area in AREAS:
        assert not templates.keys() & area.TEMPLATES.keys(), "a code stands in two areas"
        templates |= area.TEMPLATES
    return templates


CATALOGUE: Mapping[str, str] = MappingProxyType(_all())
