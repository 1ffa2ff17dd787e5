"""Writes a simulated capture as a capture folder (docs/capture-format.md), and its ground truth as a second folder."""

import io
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rig.files import write_atomically
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.captures.capture_folder import write_capture
from rig.formats.meshes.ply import write_ply
from rig.formats.pictures.images import write_image
from rig.studio.scene.eyes import LIMBUS_MM
from rig.studio.scene.simulate import SimulatedCapture
from rig.studio.sensor.preset import REALISM, made_real


def simulate_to_folder(out: Path, simulated: SimulatedCapture, *, seed: int | None = None) -> Path:
    """Writes a simulated capture to the folder ``out`` and its ground truth to the folder ``<out>.truth``. Returns the
    path of ``<out>.truth``.

    The truth folder contains the true cameras (cameras.json) and the head (head.ply, world frame, mm, lit colours) with
    a Boolean for each vertex in face_mask.npy and colour_mask.npy. Masks of the subject with hair and clothes are in
    silhouettes/, masks of the bare head in head_silhouettes/, and the coverage of pixels (0 to 255) in coverage/. The
    pixel labels in parts/ are 0 background, 1 skin, 2 hair or beard, 3 clothes, cap or glasses. Surface points that two
    or more cameras see are in visible.npz.
    """
    write_capture(out, simulated.capture, simulated.rig)
    truth = out.with_name(out.name + ".truth")
    write_truth(truth, simulated, seed=seed)
    return truth


def write_truth(folder: Path, simulated: SimulatedCapture, *, seed: int | None = None) -> None:
    """Writes only the ground truth of a simulated capture to ``folder``."""
    scene = simulated.scene
    count = len(scene.head.vertices)
    face = np.ones(count, bool) if scene.face_region is None else np.asarray(scene.face_region)
    nothing = np.zeros(count)
    folder.mkdir(parents=True, exist_ok=True)
    assert scene.head.colours is not None
    write_ply(
        folder / "head.ply",
        scene.head,
        normals=scene.head.normals(),
        colours=scene.head.colours,
        quality=nothing,
        views=nothing.astype(np.uint8),
        comments=("simulated truth, unit mm, frame world",),
    )
    np.save(folder / "face_mask.npy", face)
    np.save(folder / "colour_mask.npy", face & scene.photographed)
    for name, view in scene.views.items():
        write_image(folder / "silhouettes" / f"{name}.png", view.mask.astype(np.uint8) * 255)
        write_image(folder / "head_silhouettes" / f"{name}.png", scene.head_masks[name].astype(np.uint8) * 255)
        coverage = np.rint(255 * np.clip(view.subject[:, :, 3], 0, 1)).astype(np.uint8)
        write_image(folder / "coverage" / f"{name}.png", coverage)
        write_image(folder / "parts" / f"{name}.png", scene.parts[name])
    write_atomically(folder / "visible.npz", _npz_bytes(scene.visible.arrays()))
    write_rig(scene.true_rig, folder / "cameras.json")
    write_atomically(folder / "meta.json", json.dumps(_meta(simulated, int(face.sum()), seed), indent=1).encode())


def _npz_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _meta(simulated: SimulatedCapture, face_vertices: int, seed: int | None) -> dict[str, object]:
    scene = simulated.scene
    pose = scene.world_from_head
    return {
        "name": scene.name,
        "subject": scene.name,
        "seed": seed,
        "hairstyle": list(scene.preset.hairstyle),
        "realism": [name for name in REALISM if made_real(scene.preset, (name,)) == scene.preset],
        "features": bool(simulated.capture.features),
        "vertices": len(scene.head.vertices),
        "face_vertices": face_vertices,
        "world_from_head": {
            "scale": pose.scale,
            "rotation": pose.rotation.tolist(),
            "translation": (pose.translation / pose.scale).tolist(),  # x_world = s (R x_head + t)
        },
        "landmarks_world": {name: point.tolist() for name, point in scene.landmarks_world.items()},
        "eyes_world": {
            side: {
                "centre": eye.centre.tolist(),
                "gaze": eye.gaze.tolist(),
                "iris_centre": eye.iris_centre.tolist(),
                "iris_radius_mm": LIMBUS_MM,
            }
            for side, eye in scene.eyes_world.items()
        },
        "faults": [{"kind": f.kind, "camera": f.camera, "amount": f.strength} for f in simulated.faults],
    }
