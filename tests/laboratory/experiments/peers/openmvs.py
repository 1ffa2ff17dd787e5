"""Runs OpenMVS for comparison, on this project's undistorted photographs, masks and cameras.

OpenMVS is under the AGPL, so that nothing of it is part of the project: a user builds it and names the folder of its
programs (https://github.com/cdcseacave/openMVS; InterfaceCOLMAP, DensifyPointCloud, ReconstructMesh, RefineMesh). Its
input is what its makers ask for: a COLMAP model in text (https://colmap.github.io/format.html#text-format) whose points
say which views belong together. These are points of the visual hull, in every view that sees their side of it.
"""

import resource
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from pipeline.stereo.crops import MAX_UNSEEN_PX, Crop
from rig.camera import Camera
from rig.errors import EigenheadError, InputError
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh

PROGRAMS = ("InterfaceCOLMAP", "DensifyPointCloud", "ReconstructMesh", "RefineMesh")
SEEDS = 4000  # points of the hull
FACING = 0.35  # cosine above which a view looks at a point's side of the hull
TIMEOUT_S = 3600.0  # a program: its longest took 380 CPU s on eleven views
COLMAP_PX = 0.5  # the centre of the top-left pixel there


class PeerFailed(EigenheadError):
    """Reports that a program of the peer ended without a result."""

    def __init__(self, program: str, why: str) -> None:
        super().__init__(f"{program}: {why}")


def programs_in(folder: Path) -> dict[str, Path]:
    """Returns the programs by name. Raises InputError that names every missing one."""
    found = {name: folder / name for name in PROGRAMS}
    missing = [name for name, path in found.items() if not path.is_file()]
    if missing:
        raise InputError(str(folder), [f"holds no {name}" for name in missing])
    return found


def surface_by_openmvs(
    crops: Sequence[Crop], hull_world: Mesh, programs: Mapping[str, Path], folder: Path
) -> tuple[Mesh, float]:
    """Runs OpenMVS. Returns its refined surface (world frame, mm) and the processor seconds of its programs.

    ``crops``: of the photographs, with their masks. ``hull_world``: the visual hull. ``programs``: by name. ``folder``:
    empty; receives the input and all that the programs write.

    Raises PeerFailed with the program's last words.
    """
    write_input(crops, hull_world, folder)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    masks = ("--mask-path", str(folder / "masks"), "--ignore-mask-label", "0")
    images = ("--image-folder", str(folder / "images"))
    _run(programs, "InterfaceCOLMAP", folder, "-i", str(folder), "-o", "scene.mvs", *images)
    _run(programs, "DensifyPointCloud", folder, "-i", "scene.mvs", "-o", "dense.mvs", *masks)
    _run(programs, "ReconstructMesh", folder, "-i", "dense.mvs", "-p", "dense.ply", "-o", "mesh.mvs")
    _run(programs, "RefineMesh", folder, "-i", "dense.mvs", "-m", "mesh.ply", "-o", "refined.mvs")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    if not (folder / "refined.ply").is_file():
        raise PeerFailed("RefineMesh", "left no refined.ply")
    return read_mesh(folder / "refined.ply"), seconds


def _run(programs: Mapping[str, Path], name: str, folder: Path, *arguments: str) -> None:
    command = [str(programs[name].resolve()), "-w", str(folder), *arguments]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired as late:
        raise PeerFailed(name, f"did not end within {TIMEOUT_S:.0f} s") from late
    except OSError as error:
        raise PeerFailed(name, f"does not start ({error.strerror or error})") from error
    if done.returncode:
        said = (done.stdout + done.stderr).strip().splitlines()[-3:]
        raise PeerFailed(name, f"ended with {done.returncode}: {' / '.join(said) or 'it said nothing'}")


def write_input(crops: Sequence[Crop], hull_world: Mesh, folder: Path) -> None:
    """Writes ``images``, ``masks`` and ``sparse`` (cameras.txt, images.txt, points3D.txt) as the programs read them."""
    rows = np.random.default_rng(0).permutation(len(hull_world.vertices))[:SEEDS]
    points, normals = hull_world.vertices[rows], hull_world.normals()[rows]
    seen = np.stack([_faces_camera(each.camera, points, normals) for each in crops])
    points, seen = points[seen.sum(axis=0) >= 2], seen[:, seen.sum(axis=0) >= 2]
    for name in ("images", "masks", "sparse"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    cameras, images = [], []
    for number, (view, at) in enumerate(zip(crops, seen, strict=True), start=1):
        camera = view.camera
        write_image(folder / "images" / f"{camera.name}.png", view.colour)
        distance_px = view.levels[0].distance_px
        label = ((distance_px > MAX_UNSEEN_PX) & (distance_px < 0.0)).astype(np.uint8) * 255
        write_image(folder / "masks" / f"{camera.name}.mask.png", np.repeat(label[:, :, None], 3, axis=2))
        k, pose = camera.intrinsics, camera.camera_from_world
        lens = (k.fx, k.fy, k.cx + COLMAP_PX, k.cy + COLMAP_PX)
        cameras.append(f"{number} PINHOLE {k.width} {k.height} {_numbers(lens)}")
        x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
        images.append(f"{number} {_numbers((w, x, y, z, *pose.translation))} {number} {camera.name}.png")
        pixels = camera.project(points[at]) + COLMAP_PX
        images.append(
            " ".join(f"{u:.3f} {v:.3f} {p + 1}" for (u, v), p in zip(pixels, np.flatnonzero(at), strict=True))
        )
    place_of = np.cumsum(seen, axis=1) - 1  # row of a point among those of a view
    tracks = [
        f"{p + 1} {_numbers(point)} 128 128 128 0.5 "
        + " ".join(f"{v + 1} {place_of[v, p]}" for v in np.flatnonzero(seen[:, p]))
        for p, point in enumerate(points)
    ]
    for name, lines in {"cameras": cameras, "images": images, "points3D": tracks}.items():
        (folder / "sparse" / f"{name}.txt").write_text("\n".join(lines) + "\n")


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _faces_camera(
    camera: Camera, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    towards = camera.centre_world - points
    facing = (towards * normals).sum(axis=1) > FACING * np.linalg.norm(towards, axis=1)
    pixels = np.nan_to_num(camera.project(points), nan=-1.0)
    inside = (pixels > 0) & (pixels < (camera.intrinsics.width - 1, camera.intrinsics.height - 1))
    return facing & inside.all(axis=1)
