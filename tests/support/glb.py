"""Files of one mesh, and a GLB taken apart by a reader of the tests' own."""

import json
import struct
from typing import Any

from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.polygon_obj import scene_obj_bytes
from rig.formats.meshes.scene import Part, Scene
from rig.mesh import Mesh


def opened_glb(glb: bytes) -> tuple[dict[str, Any], bytes]:
    """Returns the document and the buffer of a GLB whose header holds."""
    magic, version, length = struct.unpack_from("<4sII", glb)
    assert (magic, version, length) == (b"glTF", 2, len(glb))
    (size,) = struct.unpack_from("<I", glb, 12)
    return json.loads(glb[20 : 20 + size]), glb[28 + size :]


def glb_bytes(mesh: Mesh, *, extras: dict[str, Any] | None = None, **shown: Any) -> bytes:
    """A GLB of one mesh, with its colours or the fields ``shown`` of a part."""
    return scene_glb_bytes(Scene([Part("head", mesh, **shown)]), extras)


def obj_bytes(mesh: Mesh) -> bytes:
    """An OBJ of one mesh with its colours."""
    return scene_obj_bytes(Scene([Part("head", mesh)]))
