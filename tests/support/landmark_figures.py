"""Prints how well the face finder does on captures whose truth is known:

    python -m tests.support.landmark_figures ../shared/data/captures

Of each capture: views in which the subject's face was found, of those it is turned to (less than 90 degrees away); CPU
seconds; how far the triangulated points are from the true surface (median, mm). Where the truth has ICT-FaceKit's
vertices, how far they are from their own points on it (median and RMS, mm): with the network's biases left in, and
taken off as the pipeline does; by how many degrees and millimetres a head would be turned and shifted that lies as the
points say; and chi-square a degree of freedom of their errors, by all that is said of them (1 where that is right, less
where it is cautious).
"""

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.faces.landmark_map import LandmarkMap, built_in_map
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.networks import load_networks
from pipeline.faces.subject import find_subject
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.multiview.triangulation import triangulate_many
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.captures.capture_folder import read_capture
from rig.formats.meshes.mesh_file import read_mesh
from rig.geometry import rigid_fit, vector_from_rotation
from rig.rig import Rig

ICT_VERTICES = 11248  # come first in the truths that are drawn from ICT-FaceKit
NOSE_TIP = 1
EVERY = 9
HEADER = (
    "| capture | views | seconds | surface mm | biased mm median, RMS | unbiased mm median, RMS | turn deg | shift mm "
    "| chi-square |"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, help="the folder of captures and their .truth folders")
    folder = parser.parse_args().captures
    cv2.setNumThreads(1)  # CPU seconds of one thread: others wait busily
    print(HEADER)  # noqa: T201
    print("|---" * HEADER.count(" | ") + "|---|")  # noqa: T201
    for truth in sorted(folder.glob("*.truth")):
        print(_row(folder / truth.stem, truth))  # noqa: T201


def _row(path: Path, truth: Path) -> str:
    capture, _ = read_capture(path)
    rig, head = read_rig(truth / "cameras.json"), read_mesh(truth / "head.ply")
    start = time.process_time()
    found = find_subject(capture.images, rig, load_networks()).matched
    seconds = time.process_time() - start
    if found is None:
        return f"| {path.name} | none | {seconds:.2f} | | | | | | |"
    surface = np.median(SurfaceIndex(head.vertices, head.faces).closest(found.points_world).distances)
    turned_to = [c for c in rig if (c.centre_world - found.points_world[NOSE_TIP]) @ found.facing_world > 0.0]
    row = f"| {path.name} | {len(found.detections)} of {len(turned_to)} | {seconds:.2f} | {surface:.2f} |"
    if path.name not in ("draw-b", "beard-smile", "three-brows", "circle-hair"):
        return row + " | | | | |"
    of_model = built_in_map("ict-facekit")
    true = of_model.points(head.vertices[:ICT_VERTICES])
    apart, biased = (np.linalg.norm(points - true, axis=1) for points in (found.points_world, _biased(found, rig)))
    turn, shift = _posed(found, of_model, true)
    figures = [f" {np.median(each):.2f}, {np.sqrt((each**2).mean()):.2f} |" for each in (biased, apart)]
    squares = chi_square(found, of_model, true, head_axes(truth))
    return row + "".join(figures) + f" {turn:.1f} | {shift:.1f} | {squares:.2f} |"


def head_axes(truth: Path) -> Float[np.ndarray, "3 3"]:
    """world_from_head's rotation of a capture's truth."""
    meta = json.loads((truth / "meta.json").read_text(encoding="utf-8"))
    return np.array(meta["world_from_head"]["rotation"])


def chi_square(
    found: MatchedFaces, of_model: LandmarkMap, true: Float[np.ndarray, "468 3"], axes: Float[np.ndarray, "3 3"]
) -> float:
    """Squares of errors by their covariance, a degree of freedom: of each point's own noise, each view's, and the
    map's. Of every ``EVERY``-th point that does not slide: with all, a covariance of few modes would be rounding."""
    which = np.flatnonzero(~of_model.slides)[::EVERY]
    errors = (found.points_world - true)[which] @ axes - of_model.offset_mm[which]
    views = (found.shared_mm[:, which] @ axes).reshape(len(found.shared_mm), -1)
    of_points = np.zeros((len(which), 3, len(which), 3))
    of_points[np.arange(len(which)), :, np.arange(len(which)), :] = axes.T @ found.covariances[which] @ axes
    covariance = of_model.covariance(which) + views.T @ views + of_points.reshape(errors.size, -1)
    return float(errors.ravel() @ np.linalg.solve(covariance, errors.ravel()) / errors.size)


def _biased(found: MatchedFaces, rig: Rig) -> Float[np.ndarray, "468 3"]:
    """The points triangulated as the network puts them, with the same weights."""
    names = list(found.detections)
    pixels = np.stack([found.detections[name].landmarks_px for name in names])
    noise = np.stack([found.noise_px[name] for name in names])
    return triangulate_many(pixels, [rig[name] for name in names], noise).positions_world


def _posed(found: MatchedFaces, of_model: LandmarkMap, true: Float[np.ndarray, "468 3"]) -> tuple[float, float]:
    """Rotation (degrees) and shift of the middle (mm) between the true points and those found, of points that do not
    slide, by least squares."""
    firm = ~of_model.slides
    motion = rigid_fit(true[firm], found.points_world[firm])
    middle = true[firm].mean(axis=0)
    turn = np.degrees(np.linalg.norm(vector_from_rotation(motion.rotation)))
    return float(turn), float(np.linalg.norm(motion.apply(middle[None])[0] - middle))


if __name__ == "__main__":
    main()
