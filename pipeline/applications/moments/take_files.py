"""Reconstructs a take from its captures, and writes the result files.

``neutral.ply``      the person's head without expression: head frame, mm; quality is its standard deviation
``neutral.glb``      the same in metres, with the person's blendshapes as morph targets under Apple's 52 names
``shapes.npz``       names (n), shapes (n v 3, mm at weight 1) and deviations (n v, mm), in vertex order
``take.npz``         moments (k), expressions (e), weights and weight_deviations (k e), rotations (k 3 3),
                     translations (k 3, mm), scale, heads (k v 3, head frame, mm) and deviations (k v, mm)
``moments/<name>/``  the result folder of each moment, all with the same vertex order
``report.json``      the report, written last
"""

import io
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from pipeline.applications.moments.take import Take, reconstruct_take
from pipeline.head_model.expressions import ARKIT
from pipeline.head_model.model import load_model
from pipeline.results.reconstruction import QUALITY, Reconstruction
from pipeline.results.write import write_result
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext, Segment
from rig.capture import Capture
from rig.files import document_sha256, write_atomically
from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.ply import ply_bytes
from rig.formats.meshes.scene import Part, Scene
from rig.mesh import Mesh
from rig.messages.message import documents_of
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.rig import Rig

FORMAT = "eigenhead-take/1"
FILES = ("neutral.ply", "neutral.glb", "shapes.npz", "take.npz", "report.json")
TOLD = 0.02  # a smaller weight is left out of report.json


class Shot(NamedTuple):
    """Holds a capture, and the function that computes its silhouettes."""

    capture: Capture
    rig: Rig
    segment: Segment


def make_take(
    folder: Path, shots: Mapping[str, Shot], *, model: str, settings: Settings, report: Progress
) -> dict[str, Any]:
    """Reconstructs a take from its captures and writes it into ``folder``; ``shots`` are indexed by capture. Returns
    the content of report.json. Raises the errors of ``reconstruct_take``, UnknownModel or BadModel, and OSError."""
    head_model, colours = load_model(model), Colours()

    def deliver(name: str, result: Reconstruction) -> None:
        write_result(folder / "moments" / name, result, shots[name].capture)
        colours.take_over(result)

    with Renderer.create() as renderer:
        contexts = {
            name: ReconstructionContext(shot.capture, shot.rig, head_model, settings, renderer, segment=shot.segment)
            for name, shot in shots.items()
        }
        found = reconstruct_take(contexts, deliver, report=report)
    digests = {name: document_sha256(shot.capture.digests) for name, shot in shots.items()}
    return write_take(folder, found, colours, digests)


def warning_lines(document: Mapping[str, Any]) -> list[str]:
    """Returns the warnings in a take's report.json as lines of text; those of a capture begin with its name."""
    lines = [f"{each['code']}: {each['message']}" for each in document["warnings"]]
    for moment in document["moments"]:
        lines += [f"{moment['name']}: {each['code']}: {each['message']}" for each in moment["warnings"]]
    return lines


class Colours:
    """Collects the colours of the neutral head: each vertex gets its colour from the capture in which most images show
    it."""

    def __init__(self) -> None:
        self.colours: UInt8[np.ndarray, "v 3"] | None = None
        self.views: UInt8[np.ndarray, " v"] | None = None

    def take_over(self, result: Reconstruction) -> None:
        """Copies a capture's colours at vertices that more of its images show than in earlier captures."""
        found = result.texturing.vertices
        if self.colours is None or self.views is None:
            self.colours, self.views = found.colours.copy(), found.views.copy()
            return
        more = found.views > self.views
        self.colours[more], self.views[more] = found.colours[more], found.views[more]


def write_take(folder: Path, take: Take, colours: Colours, digests: Mapping[str, str]) -> dict[str, Any]:
    """Writes the files of a take next to its captures' folders, each under a temporary name first, report.json last.
    Returns the content of report.json. ``digests`` are the SHA-256 of each capture's inputs. Raises OSError."""
    person, model = take.person, take.model
    assert colours.colours is not None
    assert colours.views is not None
    mesh = Mesh(person.neutral, model.levels["full"].faces, colours.colours)
    normals = mesh.normals()
    comments = ["unit mm", "frame head", f"model sha256 {model.sha256}", f"version eigenhead {version('eigenhead')}"]
    data = ply_bytes(
        mesh,
        normals=normals,
        colours=colours.colours,
        quality=person.deviation_mm.astype(np.float32),
        views=colours.views,
        comments=[*comments, QUALITY],
    )
    write_atomically(folder / "neutral.ply", data)
    morphs = {name: shape for name, shape in zip(ARKIT, person.shapes, strict=True) if shape.any()}
    extras = {"unit": "m", "frame": "head", "model": {"name": model.name, "sha256": model.sha256}}
    write_atomically(
        folder / "neutral.glb", scene_glb_bytes(Scene([Part("head", mesh, normals, None, morphs)]), extras)
    )
    _write_arrays(
        folder / "shapes.npz", names=np.array(ARKIT), shapes=person.shapes, deviations=person.shape_deviation_mm
    )
    _write_arrays(
        folder / "take.npz",
        moments=np.array([each.name for each in take.moments]),
        expressions=np.array(model.expressions.names),
        weights=np.stack([each.weights for each in take.moments]),
        weight_deviations=np.stack([each.weight_deviation for each in take.moments]),
        rotations=np.stack([each.world_from_head.rotation for each in take.moments]),
        translations=np.stack([each.world_from_head.translation for each in take.moments]),
        scale=np.array(take.moments[0].world_from_head.scale),
        heads=np.stack([each.head for each in take.moments]).astype(np.float32),
        deviations=np.stack([each.deviation_mm for each in take.moments]).astype(np.float32),
    )
    document = take_document(take, digests)
    write_atomically(folder / "report.json", json.dumps(document, indent=1, allow_nan=False).encode())
    return document


def take_document(take: Take, digests: Mapping[str, str]) -> dict[str, Any]:
    """Returns the content of a take's report.json."""
    names, model = take.model.expressions.names, take.model
    face = model.levels["full"].face_region
    return {
        "format": FORMAT,
        "version": version("eigenhead"),
        "model": {"name": model.name, "sha256": model.sha256},
        "neutral": {"deviation_mm": float(np.sqrt((take.person.deviation_mm[face] ** 2).mean()))},
        "own_shapes": list(take.person.shown),
        "moments": [
            {
                "name": each.name,
                "folder": f"moments/{each.name}",
                "inputs_sha256": digests[each.name],
                "detail": each.detail,
                "weights": {
                    name: {"weight": float(weight), "deviation": float(deviation)}
                    for name, weight, deviation in zip(names, each.weights, each.weight_deviation, strict=True)
                    if weight >= TOLD
                },
                "world_from_head": {
                    "scale": each.world_from_head.scale,
                    "rotation": each.world_from_head.rotation.tolist(),
                    "translation": each.world_from_head.translation.tolist(),
                },
                "deviation_mm": float(np.sqrt((each.deviation_mm[face] ** 2).mean())),
                "apart_sigmas": each.apart,
                "warnings": documents_of(each.warnings),
            }
            for each in take.moments
        ],
        "warnings": documents_of(take.warnings),
    }


def _write_arrays(path: Path, **arrays: Any) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(path, buffer.getvalue())
