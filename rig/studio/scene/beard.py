"""Makes a full beard: a copy of the lower face, thicker, curled, and with strands."""

import numpy as np
from jaxtyping import Float

from rig.errors import InputError
from rig.mesh import Mesh, vertex_normals
from rig.messages.message import compose
from rig.studio.scene.anatomy import Anatomy, Landmarks
from rig.studio.scene.curls import curled
from rig.studio.scene.hair import Hair, HairStyle, grow_strands
from rig.studio.scene.skin_texture import smoothstep

SUNK_MM = 2.0  # below the skin where no beard grows


def grow_beard(head: Mesh, body: Anatomy, style: HairStyle, rng: np.random.Generator) -> Hair:
    """Grows beard and moustache on a head (head frame, mm). ``style`` sets thickness, curls and strands.

    Raises InputError for a head without landmarks.
    """
    if not body.landmarks:
        raise InputError("beard", [compose("beard-without-landmarks")])
    share = beard_share(head.vertices, body)
    faces = head.faces[(share[head.faces] > 0.0).any(axis=1)]
    normals = vertex_normals(head.vertices, head.faces)
    outward = normals - np.array([0.0, 0.45, 0.0])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    chin = np.exp(-((head.vertices[:, 1] - body.chin_y) ** 2) / (2 * 26.0**2))
    height = share * style.thickness_mm * (0.45 + 0.55 * chin) - SUNK_MM * (1.0 - np.clip(4.0 * share, 0.0, 1.0))
    vertices = head.vertices + height[:, None] * outward
    vertices, shade = curled(vertices, normals, style.curl_mm, np.clip(2.0 * share, 0.0, 1.0), rng)
    along = 3.0 * (np.array([0.0, -1.0, 0.15]) + 0.3 * normals)
    strands = grow_strands(vertices, faces, along, (share > 0.3).astype(float), style, rng)
    return Hair(vertices, faces, vertices * (1.0, 0.4, 1.0), shade, *strands)


def beard_share(vertices: Float[np.ndarray, "v 3"], body: Anatomy) -> Float[np.ndarray, " v"]:
    """Returns how densely beard grows at each vertex, 0 to 1: on jaw, chin and upper lip, up to the ears, not on the
    lips."""
    marks, (x, y, z) = body.landmarks, vertices.T
    mouth, ears = marks["stomion"], body.ears
    across = (x - mouth[0]) / body.half_breadth
    cheek = mouth[1] + 6.0 + (ears[1] - mouth[1]) * np.minimum(np.abs(across), 1.0) ** 3
    lip = marks["subnasale"][1] - 5.0 - 0.02 * (x - mouth[0]) ** 2  # the moustache's upper edge
    share = smoothstep(4.0, -5.0, y - np.maximum(cheek, lip))
    share *= smoothstep(-26.0, -12.0, y - body.chin_y - 0.3 * np.abs(x - mouth[0]))
    share *= smoothstep(4.0, 14.0, z - ears[2])
    return share * (1.0 - _lips(vertices, marks))


def _lips(vertices: Float[np.ndarray, "v 3"], marks: Landmarks) -> Float[np.ndarray, " v"]:
    right, left = marks["cheilion_right"], marks["cheilion_left"]
    top, bottom = marks["labiale_superius"][1] + 0.5, marks["labiale_inferius"][1] - 3.5
    half = (left[0] - right[0]) / 2
    across = (vertices[:, 0] - (left[0] + right[0]) / 2) / (half + 1.0)
    down = (vertices[:, 1] - (top + bottom) / 2) / (0.5 * (top - bottom))
    return smoothstep(1.35, 0.9, np.hypot(across, down))
