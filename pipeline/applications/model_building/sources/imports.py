"""Imports head models of other formats: ICT-FaceKit, statismo and Basel HDF5 files, plain npz.

Every reader returns a ``Foreign`` model in millimetres and head-frame axes; ``adopt`` converts it to this project's
form. The imported model keeps its vertices. Modes that are not orthogonal are replaced by the principal axes of the
same Gaussian (``pca.orthogonalised``), so the probability of every head stays the same. Landmarks that the source lacks
come from the default model, which is fitted to the imported mean head and then warped onto it. The imported model's
face region follows from its landmarks. New triangles between existing vertices close the openings of eyes and mouth,
which hides what is behind."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist

from pipeline.applications.model_building.training.training import Training, above_neck, face_region, finish
from pipeline.geometry.registration.nonrigid import warp_by_landmarks
from pipeline.geometry.registration.rigid import motion_about, motion_columns, solve_with_prior
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.expressions import Expressions, visible
from pipeline.head_model.landmarks import MIDLINE, NAMES, mirrored
from pipeline.head_model.model import HeadModel, load_model
from pipeline.head_model.model_file import ModelParts, read_parts, rounded
from pipeline.head_model.pca import Components, orthogonalised
from pipeline.head_model.subdivision import boundary_loops, close_loop, vertex_areas
from rig.errors import EigenheadError, how_to_install
from rig.formats.meshes.pickled_arrays import DAMAGE, open_npz
from rig.geometry import RigidTransform, rigid_fit
from rig.mesh import vertex_normals
from rig.messages.message import compose
from rig.progress import Progress, discard_progress

Vertices = Float[np.ndarray, "V 3"]


class CannotImport(EigenheadError):
    """Reports a file or folder that contains no readable head model."""

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(
            f"{path} cannot be imported as a head model: {why}. Readable are ICT-FaceKit (its repository or compact "
            "npz), statismo or Basel HDF5 files, and npz files with mean, modes, faces and landmarks (docs/models.md)"
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Foreign:
    """Holds an imported head model before its conversion, in mm and in the head frame's axes (x to the subject's left,
    y up, z out of the face)."""

    name: str
    licence: str
    source: str
    notice: str
    mean: Vertices
    modes: Float[np.ndarray, "M V 3"]  # mm per standard deviation; need not be orthogonal
    faces: Int[np.ndarray, "F 3"]
    landmarks: Mapping[str, int]  # those that are known
    subjects: Mapping[str, int]
    expressions: Expressions | None = None  # displacements in mm


def read_obj(path: Path, *, polygons: bool = True) -> tuple[Vertices, list[list[int]]]:
    """Returns vertices and polygons in the order of the file; trimesh would merge and reorder vertices, to which
    published indices refer."""
    vertices, faces = [], []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("v "):
                vertices.append(line.split()[1:4])
            elif polygons and line.startswith("f "):
                faces.append([int(corner.split("/")[0]) - 1 for corner in line.split()[1:]])
    return np.array(vertices, float), faces


ICT_NAME = "ict-facekit"
ICT_LICENCE = "MIT"
ICT_SOURCE = "ICT-FaceKit Light, https://github.com/ICT-VGL/ICT-FaceKit (FaceXModel)"
ICT_NOTICE = "Copyright (c) 2020 USC Institute for Creative Technologies. MIT licence; keep this notice with copies."
ICT_EXPRESSIONS = "_expressions.npz"  # how the compact copy's second file ends
ICT_EXPRESSION = re.compile(r"(brow|cheek|eye|jaw|mouth|nose)[A-Za-z]+(_[LR])?")
ICT_VERTICES = 11248  # face, head and neck; sockets, teeth, eyeballs and lashes follow (README of ICT-FaceKit)
ICT_LANDMARKS_68 = (
    1225, 1888, 1052, 367, 1719, 1722, 2199, 1447, 966, 3661, 4390, 3927, 3924, 2608, 3272, 4088, 3443, 268, 493, 1914,
    2044, 1401, 3615, 4240, 4114, 2734, 2509, 978, 4527, 4942, 4857, 1140, 2075, 1147, 4269, 3360, 1507, 1542, 1537,
    1528, 1518, 1511, 3742, 3751, 3756, 3721, 3725, 3732, 5708, 5695, 2081, 0, 4275, 6200, 6213, 6346, 6461, 5518, 5957,
    5841, 5702, 5711, 5533, 6216, 6207, 6470, 5517, 5966,
)  # fmt: skip

MULTI_PIE = {
    "nasion": 27, "pronasale": 30, "subnasale": 33, "labiale_superius": 51, "labiale_inferius": 57, "gnathion": 8,
    "exocanthion_right": 36, "endocanthion_right": 39, "endocanthion_left": 42, "exocanthion_left": 45,
    "cheilion_right": 48, "cheilion_left": 54,
}  # fmt: skip
"""Those of the 26 landmarks that the 68 points of Multi-PIE hold (Gross et al. 2010)."""

_BASEL_NAMES = {
    "right.eye.corner_outer": "exocanthion_right", "right.eye.corner_inner": "endocanthion_right",
    "left.eye.corner_outer": "exocanthion_left", "left.eye.corner_inner": "endocanthion_left",
    "center.nose.tip": "pronasale", "center.nose.attachement_to_philtrum": "subnasale",
    "right.lips.corner": "cheilion_right", "left.lips.corner": "cheilion_left", "center.chin.tip": "gnathion",
    "center.lips.upper.outer": "labiale_superius", "center.lips.lower.outer": "labiale_inferius",
}  # fmt: skip


def import_model(path: Path, *, name: str | None = None, report: Progress = discard_progress) -> ModelParts:
    """Reads a model of another format and converts it; a model file of this project only gets the new name.

    A folder with exactly one model file is read as that file. Raises CannotImport without a readable model."""
    files = [f for f in path.iterdir() if f.suffix.lower() in (".npz", ".h5", ".hdf5")] if path.is_dir() else []
    files = [f for f in files if not f.name.endswith(ICT_EXPRESSIONS)]  # read with the identities beside it
    path = files[0] if len(files) == 1 else path
    if path.is_dir():
        foreign = read_ict_repository(path, report=report)
    elif path.suffix.lower() in (".h5", ".hdf5"):
        foreign = read_statismo(path)
    elif path.suffix.lower() == ".npz":
        try:
            with open_npz(path) as file:
                ours, compact = "meta" in file, "landmarks68" in file
            if ours:
                parts = read_parts(path)[0]
                return replace(parts, name=name) if name else parts
            foreign = read_ict_compact(path) if compact else read_plain(path)
        except (OSError, *DAMAGE) as fault:
            raise CannotImport(path, compose("file-incomplete", reason=str(fault)).text) from None
    else:
        raise CannotImport(path, "it is neither a folder nor .npz, .h5 or .hdf5" if path.exists() else "no such file")
    return adopt(replace(foreign, name=name) if name else foreign, report=report)


def read_ict_compact(path: Path) -> Foreign:
    """Returns the model in ICT-FaceKit Light's one-file copy: mean, modes, faces, landmarks68 (mm). Raises
    CannotImport."""
    with open_npz(path) as file:
        mean, modes, faces = (file[key] for key in ("mean", "modes", "faces"))
        points = file["landmarks68"]
    return replace(_ict(mean.astype(float), modes, faces, points), expressions=_compact_expressions(path, mean))


def _compact_expressions(path: Path, mean: np.ndarray) -> Expressions | None:
    """Returns the expressions from the file beside the identity file: names and displacements of its vertices in mm."""
    beside = path.with_name(path.stem.removesuffix("_light") + ICT_EXPRESSIONS)
    if not beside.is_file():
        return None
    with open_npz(beside) as file:
        names, shapes = tuple(str(name) for name in file["names"]), file["shapes"].astype(np.float32)
    if shapes.shape != (len(names), *mean.shape) or not np.isfinite(shapes).all():
        raise CannotImport(beside, f"{len(names)} names, shapes {shapes.shape} and a mean {mean.shape} do not fit")
    return visible(Expressions(names, shapes))


def read_ict_repository(folder: Path, *, report: Progress = discard_progress) -> Foreign:
    """Returns the model in a checkout of ICT-FaceKit's repository: generic_neutral_mesh.obj, identity000.obj and so on,
    in centimetres."""
    inside = next((f for f in (folder, folder / "FaceXModel") if (f / "generic_neutral_mesh.obj").is_file()), None)
    if inside is None:
        raise CannotImport(folder, "it has no FaceXModel/generic_neutral_mesh.obj")
    neutral, polygons = read_obj(inside / "generic_neutral_mesh.obj")
    paths = sorted(inside.glob("identity[0-9][0-9][0-9].obj"))
    if not paths:
        raise CannotImport(folder, "FaceXModel holds no identity000.obj and following")
    modes = _displacements(folder, paths, neutral, "reading identity shapes", report)
    skin = [p for p in polygons if max(p) < ICT_VERTICES]
    faces = np.array([(p[0], p[k], p[k + 1]) for p in skin for k in range(1, len(p) - 1)], np.int32)
    found = _ict(neutral[:ICT_VERTICES] * 10.0, modes, faces, np.array(ICT_LANDMARKS_68))
    return replace(found, expressions=_repository_expressions(inside, neutral, report))


def _repository_expressions(folder: Path, neutral: Vertices, report: Progress) -> Expressions | None:
    """Returns the expressions from mesh files named after them: browDown_L.obj and so on. Raises CannotImport."""
    paths = [path for path in sorted(folder.glob("*.obj")) if ICT_EXPRESSION.fullmatch(path.stem)]
    if not paths:
        return None
    shapes = _displacements(folder, paths, neutral, "reading expressions", report)
    return visible(Expressions(tuple(p.stem for p in paths), shapes))


def _displacements(
    folder: Path, paths: list[Path], neutral: Vertices, stage: str, report: Progress
) -> Float[np.ndarray, "M S 3"]:
    """Returns the displacements (mm) of the meshes in ``paths`` (cm) from the neutral mesh. Raises CannotImport."""
    shapes = []
    for k, path in enumerate(paths):
        vertices, _ = read_obj(path, polygons=False)
        if len(vertices) != len(neutral):
            raise CannotImport(folder, f"{path.name} has {len(vertices)} vertices, the neutral mesh {len(neutral)}")
        shapes.append((vertices - neutral)[:ICT_VERTICES] * 10.0)
        report(stage, (k + 1) / len(paths))
    return np.array(shapes, np.float32)


def _ict(mean: np.ndarray, modes: np.ndarray, faces: np.ndarray, points: np.ndarray) -> Foreign:
    return Foreign(
        name=ICT_NAME,
        licence=ICT_LICENCE,
        source=ICT_SOURCE,
        notice=ICT_NOTICE,
        mean=mean,
        modes=modes.astype(np.float32),
        faces=faces.astype(np.int32),
        landmarks={name: int(points[index]) for name, index in MULTI_PIE.items()},
        subjects={"total": 0, "male": 0, "female": 0},  # the repository does not say
    )


def read_statismo(path: Path) -> Foreign:
    """Returns the model in a statismo file, such as Basel Face Model 2017 and 2019: shape/model/{mean, pcaBasis,
    pcaVariance}, mm.

    Basel models have the axes of this project's head frame: y up, z out of the face. Landmarks are read from
    metadata/landmarks/json."""
    try:
        import h5py
    except ImportError:
        raise CannotImport(path, f"HDF5 needs h5py: {how_to_install('imports')}") from None
    try:
        with h5py.File(path) as file:
            top = "shape/" if "shape/model" in file else ""
            mean, basis, variance, cells = (
                np.asarray(file[top + part])
                for part in ("model/mean", "model/pcaBasis", "model/pcaVariance", "representer/cells")
            )
            marks = "metadata/landmarks/json"
            text = np.asarray(file[marks]).ravel()[0] if marks in file else None
    except (OSError, KeyError) as fault:
        raise CannotImport(path, f"it lacks a part of a statismo shape model ({fault})") from None
    faces = (cells.T if cells.shape[0] == 3 and cells.shape[1] != 3 else cells).astype(np.int32)
    modes = (basis.astype(float) * np.sqrt(variance.astype(float))).T.reshape(len(variance), -1, 3)
    points = mean.astype(float).reshape(-1, 3)
    return Foreign(
        name=path.stem,
        licence="see the source",
        source=f"statismo file {path.name}",
        notice="The licence of the imported file applies; Basel Face Models are for non-commercial use only.",
        mean=points,
        modes=modes.astype(np.float32),
        faces=faces,
        landmarks=_basel_landmarks(json.loads(text), points) if text is not None else {},
        subjects={"total": 0, "male": 0, "female": 0},
    )


def _basel_landmarks(listed: list[dict], mean: Vertices) -> dict[str, int]:
    named = {_BASEL_NAMES.get(entry["id"], entry["id"]): np.asarray(entry["coordinates"], float) for entry in listed}
    return {n: int(np.linalg.norm(mean - p, axis=1).argmin()) for n, p in named.items() if n in NAMES}


def read_plain(path: Path) -> Foreign:
    """Reads a model from an npz file of mean (V, 3), modes (M, V, 3) and faces (F, 3), in mm; docs/models.md describes
    it. A mode is the displacement of one standard deviation or, if the file contains sigma, a vector of unit length.

    Optional entries are: sigma (M,), standard deviations of unit modes; landmark_names, landmark_vertices; name,
    licence, source, notice; subjects (total, male, female)."""
    with open_npz(path) as file:
        missing = [key for key in ("mean", "modes", "faces") if key not in file]
        if missing:
            raise CannotImport(path, f"it lacks {', '.join(missing)}")
        arrays = {key: file[key] for key in file.files}
    modes = arrays["modes"].astype(float)
    if "sigma" in arrays:
        modes = modes * arrays["sigma"].astype(float)[:, None, None]
    _check_plain(path, arrays["mean"], modes, arrays["faces"])
    names, vertices = arrays.get("landmark_names", np.array([])), arrays.get("landmark_vertices", np.array([]))
    people = [int(x) for x in arrays.get("subjects", np.zeros(3, int))]
    return Foreign(
        name=str(arrays.get("name", path.stem)),
        licence=str(arrays.get("licence", "not stated")),
        source=str(arrays.get("source", path.name)),
        notice=str(arrays.get("notice", "")),
        mean=arrays["mean"].astype(float),
        modes=modes.astype(np.float32),
        faces=arrays["faces"].astype(np.int32),
        landmarks={str(n): int(v) for n, v in zip(names, vertices, strict=True) if str(n) in NAMES},
        subjects=dict(zip(("total", "male", "female"), people, strict=True)),
    )


def _check_plain(path: Path, mean: np.ndarray, modes: np.ndarray, faces: np.ndarray) -> None:
    if mean.ndim != 2 or mean.shape[1] != 3 or modes.shape[1:] != mean.shape or faces.ndim != 2 or faces.shape[1] != 3:
        raise CannotImport(path, f"shapes do not fit: mean {mean.shape}, modes {modes.shape}, faces {faces.shape}")
    if not (np.isfinite(mean).all() and np.isfinite(modes).all()):
        raise CannotImport(path, "it holds a value that is not finite")
    if faces.min() < 0 or faces.max() >= len(mean):
        raise CannotImport(path, "a face index lies outside the vertices")


def adopt(foreign: Foreign, *, report: Progress = discard_progress) -> ModelParts:
    """Converts an imported model to the parts of a model file: orthogonal modes, all 26 landmarks, head frame, face
    region, closed openings, decimated meshes. Raises CannotImport if a part of the head model cannot be computed."""
    extent = float(np.ptp(foreign.mean, axis=0).max())
    if not 100 < extent < 600:
        raise CannotImport(foreign.name, f"its mean is {extent:.3g} mm large, which no head is: convert it to mm")
    report("turning modes", 0.0)
    modes, sigma = orthogonalised(foreign.modes)
    report("carrying landmarks over", 0.0)
    faces = close_openings(foreign.mean, foreign.faces)
    landmarks = complete_landmarks(foreign.mean, faces, foreign.landmarks)
    mean = foreign.mean - foreign.mean[[landmarks["tragion_right"], landmarks["tragion_left"]]].mean(0)
    training = Training(
        name=foreign.name,
        licence=foreign.licence,
        source=foreign.source,
        notice=foreign.notice,
        subjects=foreign.subjects,
        heads=np.zeros((0, *mean.shape)),
        faces=faces,
        landmarks=landmarks,
        subdivisions=0,
    )
    components = Components(mean, modes, sigma, np.zeros((0, len(sigma))))
    figures = {"draws_mm": largest_miss(foreign.modes, modes, sigma)}
    parts = finish(training, components, face_region(mean, landmarks), figures, report=report)
    return replace(parts, expressions=foreign.expressions)


MISSED_DRAWS = 10  # random heads
OPENING_MM = 90.0  # of eyes and mouth; the neck is wider


def largest_miss(
    original: Float[np.ndarray, "M V 3"], modes: Float[np.ndarray, "K V 3"], sigma: Float[np.ndarray, " K"]
) -> float:
    """Returns the largest distance (mm) between vertices of random heads of the original model and their best fits by
    the converted model."""
    theirs, ours = (m.reshape(len(m), -1).astype(float) for m in (original, rounded(modes)))
    heads = np.random.default_rng(11).standard_normal((MISSED_DRAWS, len(theirs))) @ theirs
    missed = heads - (heads @ ours.T / sigma**2) @ ours
    return float(np.linalg.norm(missed.reshape(MISSED_DRAWS, -1, 3), axis=2).max())


def close_openings(vertices: Vertices, faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "G 3"]:
    """Returns the faces, and additional faces that close every opening up to ``OPENING_MM`` wide except the neck."""
    loops = boundary_loops(faces)
    if not loops:
        return faces
    widths = [float(np.ptp(vertices[loop], axis=0).max()) for loop in loops]
    strips = [
        close_loop(vertices, loop)
        for loop, width in zip(loops, widths, strict=True)
        if width < min(OPENING_MM, max(widths)) and len(loop) > 2
    ]
    return np.concatenate([faces, *strips]).astype(np.int32)


def complete_landmarks(mean: Vertices, faces: Int[np.ndarray, "F 3"], known: Mapping[str, int]) -> dict[str, int]:
    """Returns all 26 landmarks as vertex indices: the known landmarks, and the others from the default model after
    fitting and warping it to this mean head."""
    if set(known) >= set(NAMES):
        return {name: int(known[name]) for name in NAMES}
    default = load_model()
    shared = [name for name in NAMES if name in known]
    start = _start(default, mean, {name: known[name] for name in shared})
    fitted = _likeness(default, mean, faces, start)
    at = np.array([fitted[default.landmarks[name]] for name in NAMES])
    if len(shared) >= 4:
        here = np.array([fitted[default.landmarks[name]] for name in shared])
        # definitions of landmarks differ slightly between sources, so the warp approximates the known ones
        at = warp_by_landmarks(here, mean[[known[name] for name in shared]], at, smoothing=20.0)
    at = _symmetric(at, mean, SurfaceIndex(mean, faces))
    ours = vertex_normals(fitted, default.levels["full"].faces)[[default.landmarks[name] for name in NAMES]]
    # normals count too: position alone would put the wing of the nose inside the nostril
    away = cdist(at, mean) ** 2 + (10.0**2) * cdist(ours, vertex_normals(mean, faces)) ** 2
    away[:, np.setdiff1d(np.arange(len(mean)), faces)] = np.inf
    placed = {name: int(v) for name, v in zip(NAMES, away.argmin(1), strict=True)}
    return placed | {name: int(known[name]) for name in shared}


def _symmetric(at: Float[np.ndarray, "26 3"], mean: Vertices, surface: SurfaceIndex) -> Float[np.ndarray, "26 3"]:
    """Returns landmarks averaged with their mirror images if the mean head is symmetric (to 0.5 mm).

    The default model is not exactly symmetric: on a perfectly symmetric head, its fit alone puts one ear's landmark 3
    mm higher than the other's."""
    middle = 2 * at[[NAMES.index(name) for name in MIDLINE], 0].mean() * np.array([1.0, 0.0, 0.0])
    flip = np.array([-1.0, 1.0, 1.0])
    if np.median(surface.closest(mean[::7] * flip + middle).distances) > 0.5:
        return at
    return (at + at[[NAMES.index(mirrored(name)) for name in NAMES]] * flip + middle) / 2


def _start(default: HeadModel, mean: Vertices, known: Mapping[str, int]) -> RigidTransform:
    """Returns the starting pose for fitting the default model to a mean head, from common landmarks or else from the
    tip of the nose."""
    ours = default.vertices(np.zeros(0))
    if len(known) >= 3:
        source = ours[[default.landmarks[name] for name in known]]
        return rigid_fit(source, mean[list(known.values())])
    nose = mean[mean[:, 2].argmax()]
    return RigidTransform(np.eye(3), nose - ours[default.landmarks["pronasale"]])


def _likeness(default: HeadModel, mean: Vertices, faces: Int[np.ndarray, "F 3"], start: RigidTransform) -> Vertices:
    """Returns the head of the default model that best fits the mean head without its neck."""
    areas = vertex_areas(mean, faces)
    placed = start.apply(default.vertices(np.zeros(0)))
    chin = placed[default.landmarks["gnathion"]]
    index = int(np.linalg.norm(mean - chin, axis=1).argmin())
    use = (above_neck(mean, {"gnathion": index}) > 0) & (areas > 0)
    some = np.flatnonzero(use)[:: max(1, int(use.sum()) // 3000)]  # enough for 60 modes, and three times faster
    z, place = fit_surface(default, mean[some], areas[some] * (areas[use].sum() / areas[some].sum()), start, 60)
    return place.apply(default.vertices(z))


STEP_MM = 5e-3  # mean move of a step at which the iteration ends
MAX_STEPS = 40
SPREAD_MM = 10.0  # residuals of neighbouring points are not independent: one counts per so many mm squared of surface


def fit_surface(
    model: HeadModel,
    points: Float[np.ndarray, "N 3"],
    weights: Float[np.ndarray, " N"],
    start: RigidTransform,
    count: int,
    *,
    sigma_mm: float = 0.5,
) -> tuple[Float[np.ndarray, " m"], RigidTransform]:
    """Estimates the pose and ``count`` coefficients that bring the model's surface to the points, under the prior of
    the coefficients. Returns the coefficients (standard deviations) and target_from_head.

    ``weights`` are the areas (mm²) that the points represent; ``sigma_mm`` is the standard deviation of a residual. The
    first steps fit only the pose and few modes and downweight distant points (Geman and McClure), so that a rough start
    does not distort the head."""
    basis, faces = model.basis("full", count), model.levels["full"].faces
    z, pose = np.zeros(count), start
    information = weights / SPREAD_MM**2 / sigma_mm**2
    for step in range(MAX_STEPS):
        active = count if step >= 8 else (0, 0, 0, 5, 5, 15, 15, 30)[step]
        hits = SurfaceIndex(pose.apply(model.vertices(z)), faces).closest(points)
        scale = max(3.0 * float(np.median(hits.distances)), 3.0 * sigma_mm) if step < 12 else np.inf
        robust = (1 + (hits.distances / scale) ** 2) ** -2
        few, normals, centre = basis[:active], hits.normals, points.mean(0)
        turned = normals @ pose.rotation  # n^T R
        along = np.einsum("mncx,nc,nx->nm", few[:, faces[hits.triangles]], hits.weights, turned, optimize=True)
        columns = np.concatenate([along, motion_columns(hits.points - centre, normals)], axis=1)
        ahead, prior = np.einsum("nx,nx->n", points - hits.points, normals), np.repeat([1.0, 0.0], [len(few), 6])
        state = np.concatenate([z[: len(few)], np.zeros(6)])
        delta = solve_with_prior(columns, ahead, information * robust, prior, state)
        z[: len(few)] += delta[: len(few)]
        moved = motion_about(centre, delta[len(few) :]) @ pose
        pose = RigidTransform(moved.rotation, moved.translation)
        if step > 12 and float(np.abs(columns @ delta).mean()) < STEP_MM:
            break
    return z, pose
