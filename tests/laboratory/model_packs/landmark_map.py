"""Measures the face finder on renders of known heads, and writes the tables that ship with it.

    python -m tests.laboratory.model_packs.landmark_map COMMAND FOLDER --ict-facekit MODEL
        photograph, with --of makehuman --heads 60, then --of ict-facekit; tables writes pipeline/faces/packs/*.npz;
        check judges half of the heads by the others

(MODEL: ../shared/data/ict-facekit/ict_facekit_light.npz.)

What is measured, in turns until it settles: which surface point of each model a landmark is (the mean, over heads, of
where its triangulation meets the surface), how far it errs by the direction from which a camera looks (``view_bias``),
how much of an error is of one point, of a view, and of all views alike (modes of a covariance).
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from pipeline.applications.model_building.sources.imports import import_model
from pipeline.faces.detection import FaceDetection
from pipeline.faces.landmark_map import faces_digest
from pipeline.faces.networks import PACKS, FaceNetworks, load_networks
from pipeline.faces.points import PointTable, direction_from_face, place_face, point_table, view_terms
from pipeline.faces.triangulated_face import triangulate_face, unbiased_px
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel, assemble, load_model
from rig.geometry import Similarity, rigid_fit
from rig.mesh import vertex_normals
from rig.render.renderer import Renderer
from tests.laboratory.model_packs.landmark_renders import PhotographedHead, load_head, photograph_head, save_head
from tests.support.drawn_faces import drawn_face

MODELS = ("makehuman", "ict-facekit")
MIN_SCORE, MIN_VIEWS = 2.0, 5
NEAR = 0.25  # of a face's size: as far may the points' middle be from the true one's
TURNS = 4
RIDGE = 2.0  # views' worth of weight that keeps each term of the bias small
MODES = 16
BEHIND_EARS_MM = 10.0
MIRROR = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A photographed head and its model."""

    model: str
    head: PhotographedHead
    detections: Mapping[str, FaceDetection]


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """A model's surface point for each landmark."""

    rows: Int[np.ndarray, "468 3"]
    weights: Float[np.ndarray, "468 3"]

    def on(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "468 3"]:
        return (vertices[self.rows] * self.weights[..., None]).sum(axis=1)


Maps = Mapping[str, SurfacePoints]


def measured_mirror_images(networks: FaceNetworks) -> Int[np.ndarray, " 468"]:
    """Pairs the points by where the network puts them on a face that is its own mirror image."""
    found = []
    for scale in (0.6, 0.65, 0.7, 0.75):
        image = drawn_face(192, 192, ((95.5, 95.5),), scale=scale)
        mirrored = np.ascontiguousarray(image[:, ::-1])
        found += [networks.place_landmarks(image)[0], networks.place_landmarks(mirrored)[0]]
    points = np.mean(found, axis=0)
    turned = points * MIRROR + (191.0, 0.0, 0.0)
    return linear_sum_assignment(np.linalg.norm(points[:, None] - turned[None], axis=2))[1]


def load_measured(folder: Path, models: Mapping[str, HeadModel]) -> list[Measured]:
    """The heads that were photographed, with the views in which their faces were seen."""
    found = []
    for path in sorted(folder.glob("*.npz")):
        name, head = path.stem.rpartition("-")[0], load_head(path)
        marks = models[name].levels["full"].landmarks
        middle = head.vertices_world[[marks["exocanthion_right"], marks["exocanthion_left"], marks["subnasale"]]]
        seen = {
            view: face
            for view, face in head.detections(MIN_SCORE).items()
            if np.linalg.norm(
                face.landmarks_px[[33, 263, 2]].mean(axis=0) - head.rig[view].project(middle).mean(axis=0)
            )
            < NEAR * face.size_px
        }
        if len(seen) >= MIN_VIEWS:
            found.append(Measured(name, head, seen))
    return found


def make_tables(measured: Sequence[Measured], models: Mapping[str, HeadModel], path: Path) -> tuple[Maps, list]:
    """Alternates between surface points and biases; leaves the table of points at ``path``, which the pipeline reads.

    Returns the surface points and, for each head, the triangulated points (world, mm).
    """
    for turn in range(TURNS + 1):
        points = [_triangulated(each) for each in measured]
        maps = _surface_points(measured, points, models)
        if turn == TURNS:
            return maps, points
        bias = _fitted_bias(measured, maps)
        shape, normals = _mean_shape(maps, models)
        table = replace(point_table(), view_bias=bias, shape_mm=shape, normals=normals)
        _write_points(path, table)
        noise, view_noise = _fitted_noise(measured, maps)
        _write_points(path, replace(table, point_noise=noise, view_noise=view_noise))
        print(f"turn {turn}: {_error_line(measured, points, maps)}")  # noqa: T201
    raise AssertionError


def _triangulated(each: Measured) -> Float[np.ndarray, "468 3"]:
    face = triangulate_face(each.detections, each.head.rig)
    assert face is not None
    return face.points.positions_world


def _surface_points(
    measured: Sequence[Measured], points: Sequence[Float[np.ndarray, "468 3"]], models: Mapping[str, HeadModel]
) -> Maps:
    """Where the triangulated points meet each head's surface, carried to the mean head; the median over the heads."""
    maps = {}
    for name, model in models.items():
        mean = model.vertices(np.zeros(0))
        faces = _front(model, mean)
        met = []
        for each, found in zip(measured, points, strict=True):
            if each.model == name:
                hits = SurfaceIndex(each.head.vertices_world, faces).closest(found)
                met.append((mean[faces[hits.triangles]] * hits.weights[..., None]).sum(axis=1))
        middle = np.median(met, axis=0)
        symmetric = (middle + middle[point_table().mirror_images] * MIRROR) / 2
        hits = SurfaceIndex(mean, faces).closest(symmetric)
        maps[name] = SurfacePoints(faces[hits.triangles], hits.weights)
    return maps


def _front(model: HeadModel, mean: Float[np.ndarray, "v 3"]) -> Int[np.ndarray, "f 3"]:
    """The triangles before the ears: half of the work."""
    faces, marks = model.levels["full"].faces, model.levels["full"].landmarks
    ears = mean[[marks["tragion_right"], marks["tragion_left"]], 2].mean()
    return faces[(mean[faces, 2] > ears - BEHIND_EARS_MM).all(axis=1)]


def _fitted_bias(measured: Sequence[Measured], maps: Maps) -> Float[np.ndarray, "8 468 2"]:
    """Least squares of what every view says against the true points, and its mirror image against theirs."""
    table = point_table()
    matrix, right = np.zeros((468, 8, 8)), np.zeros((468, 8, 2))
    for direction, miss, _ in _misses(measured, maps):
        for mirrored in (False, True):
            towards = direction * MIRROR if mirrored else direction
            miss_seen = miss[table.mirror_images] * (-1.0, 1.0) if mirrored else miss
            terms = view_terms(direction) * (view_terms(MIRROR) if mirrored else 1.0)
            weight = np.exp(-2.0 * table.point_noise[1] * (1.0 - table.normals @ towards))
            matrix += weight[:, None, None] * np.outer(terms, terms)
            right += weight[:, None, None] * terms[:, None] * miss_seen[:, None, :]
    matrix += RIDGE * np.diag([0.0, *[1.0] * 7])
    return np.linalg.solve(matrix, right).transpose(1, 0, 2)


def _misses(
    measured: Sequence[Measured], maps: Maps, *, unbiased: bool = False
) -> Iterator[tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "468 2"], Float[np.ndarray, "468 2"]]]:
    """Of every view: the direction from face to camera, and found minus true points, in shares of the face's size and
    level with it; last the same without the bias of the table."""
    for each in measured:
        true = maps[each.model].on(each.head.vertices_world)
        placed, _ = place_face(true)
        for view, face in each.detections.items():
            camera = each.head.rig[view]
            roll = np.deg2rad(face.roll_deg)
            level = np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
            projected = camera.project(true)
            misses = [
                (pixels - projected) @ level.T / face.size_px
                for pixels in (face.landmarks_px, unbiased_px(face, placed, camera))
            ]
            yield direction_from_face(placed, camera), misses[0], misses[1]


def _mean_shape(
    maps: Maps, models: Mapping[str, HeadModel]
) -> tuple[Float[np.ndarray, "468 3"], Float[np.ndarray, "468 3"]]:
    """Points and normals on the mean of the models' mean heads, in the first one's axes."""
    shapes, normals = [], []
    for name, model in models.items():
        mean = model.vertices(np.zeros(0))
        points = maps[name].on(mean)
        there = maps[name].on(vertex_normals(mean, model.levels["full"].faces))
        motion = rigid_fit(points, shapes[0]) if shapes else Similarity.identity()
        shapes.append(motion.apply(points))
        normals.append(there @ motion.rotation.T)
    mirror = point_table().mirror_images
    shape, normal = np.mean(shapes, axis=0), np.mean(normals, axis=0)
    shape, normal = (shape + shape[mirror] * MIRROR) / 2, (normal + normal[mirror] * MIRROR) / 2
    return shape - shape.mean(axis=0), normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _fitted_noise(measured: Sequence[Measured], maps: Maps) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Size and growth: of a point's residuals after triangulation, and of a view's middle against the truth."""
    turned, squares, facing, shifts = [], [], [], []
    for each in measured:
        face = triangulate_face(each.detections, each.head.rig)
        assert face is not None
        views = len(face.detections)
        left = 2 * views / (2 * views - 3)  # what a triangulation takes of its residuals
        normals = point_table().normals @ face.world_from_face.rotation.T
        for view, residual in zip(face.detections, face.points.residuals_px, strict=True):
            towards = each.head.rig[view].centre_world - face.points.positions_world
            turned.append(1.0 - (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1))
            squares.append(left * (residual**2).mean(axis=1) / face.detections[view].size_px ** 2)
    for direction, _, miss in _misses(measured, maps):
        seen = point_table().normals @ direction > 0.2
        facing.append(1.0 - direction[2])
        shifts.append((miss[seen].mean(axis=0) ** 2).mean())
    return (
        _growth(np.concatenate(turned), np.concatenate(squares), np.linspace(0.0, 1.4, 8)),
        _growth(np.array(facing), np.array(shifts), np.linspace(0.0, 1.0, 6)),
    )


def _growth(
    x: Float[np.ndarray, " n"], squares: Float[np.ndarray, " n"], edges: Float[np.ndarray, " e"]
) -> Float[np.ndarray, " 2"]:
    """``a, b`` of a standard deviation ``a exp(b x)``, from mean squares in bins of ``x``."""
    inside = [(x >= low) & (x < high) for low, high in pairwise(edges)]
    middles = [float(x[each].mean()) for each in inside]
    logs = [0.5 * float(np.log(squares[each].mean())) for each in inside]
    slope, start = np.polyfit(middles, logs, 1)
    return np.array([np.exp(start), slope])


def _error_line(measured: Sequence[Measured], points: Sequence[Float[np.ndarray, "468 3"]], maps: Maps) -> str:
    """Medians of how far triangulated points are from the true ones."""
    apart = {
        name: [
            float(np.median(np.linalg.norm(found - maps[name].on(each.head.vertices_world), axis=1)))
            for each, found in zip(measured, points, strict=True)
            if each.model == name
        ]
        for name in maps
    }
    return ", ".join(f"{name} {np.median(found):.2f} mm ({len(found)} heads)" for name, found in apart.items())


def _write_points(path: Path, table: PointTable) -> None:
    np.savez_compressed(
        path,
        mirror_images=table.mirror_images.astype(np.int16),
        shape_mm=table.shape_mm.astype(np.float32),
        normals=table.normals.astype(np.float32),
        view_bias=table.view_bias.astype(np.float32),
        point_noise=table.point_noise.astype(np.float32),
        view_noise=table.view_noise.astype(np.float32),
    )
    point_table.cache_clear()


def _write_maps(
    path: Path,
    measured: Sequence[Measured],
    points: Sequence[Float[np.ndarray, "468 3"]],
    maps: Maps,
    models: Mapping[str, HeadModel],
) -> None:
    """Surface points, what is left of an error in the mean, and its covariance, which the models share."""
    errors, of = _errors(measured, points, maps)
    arrays: dict[str, np.ndarray] = {}
    mirror = point_table().mirror_images
    for name in maps:
        offset = errors[of == name].mean(axis=0)
        offset = (offset + offset[mirror] * MIRROR) / 2
        errors[of == name] -= offset
        arrays |= {
            f"{name}_faces": np.array(faces_digest(models[name])),
            f"{name}_rows": maps[name].rows.astype(np.int32),
            f"{name}_weights": maps[name].weights.astype(np.float32),
            f"{name}_offset_mm": offset.astype(np.float32),
        }
    both = np.concatenate([errors, errors[:, mirror] * MIRROR])
    _, sizes, directions = np.linalg.svd(both.reshape(len(both), -1), full_matrices=False)
    modes = (sizes[:MODES, None] / np.sqrt(len(both)) * directions[:MODES]).reshape(MODES, -1, 3)
    variance = np.maximum((both**2).mean(axis=0) - (modes**2).sum(axis=0), 0.0)
    arrays |= {"shared_mm": modes.astype(np.float32), "deviation_mm": np.sqrt(variance).astype(np.float32)}
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def _errors(
    measured: Sequence[Measured], points: Sequence[Float[np.ndarray, "468 3"]], maps: Maps
) -> tuple[Float[np.ndarray, "n 468 3"], np.ndarray]:
    """Triangulated minus true points in the head frame (mm), and whose they are."""
    errors = [
        (found - maps[each.model].on(each.head.vertices_world)) @ each.head.world_from_head.rotation
        for each, found in zip(measured, points, strict=True)
    ]
    return np.array(errors), np.array([each.model for each in measured])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("photograph", "tables", "check"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--of", choices=MODELS, default=MODELS[0], help="whose heads are photographed")
    parser.add_argument("--heads", type=int, default=60)
    parser.add_argument("--ict-facekit", type=Path, required=True, help="ict_facekit_light.npz, or its repository")
    arguments = parser.parse_args()
    models = {"makehuman": load_model(), "ict-facekit": assemble(import_model(arguments.ict_facekit), "")}
    if arguments.command == "photograph":
        _photograph(models[arguments.of], arguments.of, arguments.folder, arguments.heads)
        return
    measured = load_measured(arguments.folder, models)
    if arguments.command == "check":
        _check(measured, models)
        return
    maps, points = make_tables(measured, models, PACKS / "points.npz")
    _write_maps(PACKS / "landmark_maps.npz", measured, points, maps, models)


def _photograph(model: HeadModel, name: str, folder: Path, heads: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    networks = load_networks()
    with Renderer.create() as renderer:
        for number in range(heads):
            path = folder / f"{name}-{number:03}.npz"
            if not path.exists():
                save_head(path, photograph_head(model, number, networks, renderer))
                print(path)  # noqa: T201


def _check(measured: Sequence[Measured], models: Mapping[str, HeadModel]) -> None:
    """Prints how far the points of the second half of the heads are, by tables from the first half."""
    path = PACKS / "points.npz"
    shipped = path.read_bytes()
    try:
        maps, _ = make_tables(measured[::2], models, path)
        held = measured[1::2]
        print("held out:", _error_line(held, [_triangulated(each) for each in held], maps))  # noqa: T201
        _write_points(path, replace(point_table(), view_bias=np.zeros((8, 468, 2))))
        bare = [_triangulated(each) for each in held]
        print("held out, biases left in:", _error_line(held, bare, maps))  # noqa: T201
    finally:
        path.write_bytes(shipped)
        point_table.cache_clear()


if __name__ == "__main__":
    main()
