"""A GLB taken apart by a reader of the tests' own."""

import json
import struct
from typing import Any


def opened_glb(glb: bytes) -> tuple[dict[str, Any], bytes]:
    """Returns the document and the buffer of a GLB whose header holds."""
    magic, version, length = struct.unpack_from("<4sII", glb)
    assert (magic, version, length) == (b"glTF", 2, len(glb))
    (size,) = struct.unpack_from("<I", glb, 12)
    return json.loads(glb[20 : 20 + size]), glb[28 + size :]
