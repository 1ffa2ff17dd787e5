"""A model of FLAME's structure that nobody's licence covers: a head of the default model's 5 % level with two eyeballs,
300 smooth random modes of shape and 100 of expression, five joints; and the surface, written anew from the paper's
equations."""

import pickle
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import trimesh
from scipy.spatial.transform import Rotation

from pipeline.applications.templates.carrying import bind_vertices, surface_binding
from pipeline.applications.templates.flame_model import FlameModel
from pipeline.applications.templates.template_file import Template
from pipeline.head_model.model import HeadModel, load_model
from rig.formats.meshes.polygon_obj import PolygonMesh
from rig.mesh import vertex_normals

SHAPES, EXPRESSIONS = 300, 100
EYES_M = np.array([[-0.031, 0.0125, 0.062], [0.031, 0.0125, 0.062]])
JAW_M, NECK_M, ROOT_M = np.array([0.0, -0.02, 0.02]), np.array([0.0, -0.06, -0.02]), np.array([0.0, -0.12, -0.03])


def made_up_flame(seed: int = 0) -> dict[str, Any]:
    """The arrays of the model's file, in metres."""
    rng = np.random.default_rng(seed)
    level, mean = load_model().levels["p95"], load_model().vertices(np.zeros(0), "p95") / 1000.0
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.012)
    size = len(ball.vertices)
    vertices = np.concatenate([mean, *(np.array(ball.vertices) + eye for eye in EYES_M)])
    faces = np.concatenate([level.faces, *(np.array(ball.faces) + len(mean) + k * size for k in (0, 1))])
    count = len(vertices)
    shape = smooth_modes(vertices, SHAPES, 0.003, rng)
    face = np.exp(-np.maximum(0.04 - vertices[:, 2], 0.0) / 0.02)[:, None, None]
    expression = smooth_modes(vertices, EXPRESSIONS, 0.002, rng) * face
    weights = np.zeros((count, 5))
    low = 1.0 / (1.0 + np.exp((vertices[:, 1] - NECK_M[1]) / 0.01))
    chin = (1.0 - low) / (1.0 + np.exp(((vertices[:, 1] + 0.03) - 0.3 * (0.06 - vertices[:, 2])) / 0.008))
    weights[:, 0], weights[:, 2] = low, chin
    weights[:, 1] = 1.0 - low - chin
    for k in (0, 1):
        weights[len(mean) + k * size : len(mean) + (k + 1) * size] = np.eye(5)[3 + k]
    regressor = np.zeros((5, count))
    for k, joint in enumerate((ROOT_M, NECK_M, JAW_M)):
        near = np.argsort(np.linalg.norm(mean - joint, axis=1))[:40]
        regressor[k, near] = 1.0 / 40
    for k in (0, 1):
        regressor[3 + k, len(mean) + k * size : len(mean) + (k + 1) * size] = 1.0 / size
    return {
        "v_template": vertices,
        "shapedirs": np.concatenate([shape, expression], axis=2),
        "posedirs": smooth_modes(vertices, 36, 0.001, rng) * 0.3,
        "J_regressor": regressor,
        "weights": weights,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.int64),
        "f": faces.astype(np.uint32),
    }


def smooth_modes(vertices: np.ndarray, count: int, largest_m: float, rng: np.random.Generator) -> np.ndarray:
    """Waves over the surface, each shorter and weaker than the one before."""
    modes = np.empty((len(vertices), 3, count))
    for k in range(count):
        length = 0.25 / (1.0 + 0.05 * k)
        waves = rng.normal(size=(6, 3)) / length * 2.0
        phases, directions = rng.uniform(0, 2 * np.pi, 6), rng.normal(size=(6, 3))
        modes[:, :, k] = largest_m / (1.0 + 0.02 * k) * np.sin(vertices @ waves.T + phases) @ directions / 6.0
    return modes


def flame_surface(arrays: dict[str, Any], parameters: dict[str, np.ndarray]) -> np.ndarray:
    """The vertices that parameters by GaussianAvatars' names make (m), by 4 x 4 matrices down the chain of joints."""
    shape, expression = parameters["shape"].ravel(), parameters["expr"].ravel()
    modes = arrays["shapedirs"]
    shaped = arrays["v_template"] + modes[:, :, : len(shape)] @ shape
    shaped = shaped + modes[:, :, SHAPES : SHAPES + len(expression)] @ expression
    if "static_offset" in parameters:
        shaped = shaped + parameters["static_offset"][0]
    joints = arrays["J_regressor"] @ shaped
    names = ("rotation", "neck_pose", "jaw_pose", "eyes_pose")
    pose = np.concatenate([parameters[name].ravel() for name in names]).reshape(5, 3)
    turns = Rotation.from_rotvec(pose).as_matrix()
    feature = (turns[1:] - np.eye(3)).reshape(-1)
    posed = shaped + arrays["posedirs"] @ feature
    places: list[np.ndarray] = []
    for joint in range(5):
        above = int(arrays["kintree_table"][0][joint])
        local = np.eye(4)
        local[:3, :3] = turns[joint]
        local[:3, 3] = joints[joint] - (joints[above] if joint else 0.0)
        places.append(places[above] @ local if joint else local)
    out = np.zeros_like(posed)
    for joint, place in enumerate(places):
        from_rest = place.copy()
        from_rest[:3, 3] -= place[:3, :3] @ joints[joint]
        moved = posed @ from_rest[:3, :3].T + from_rest[:3, 3]
        out += arrays["weights"][:, [joint]] * moved
    return out + parameters["translation"].ravel()


def some_parameters(seed: int = 1) -> dict[str, np.ndarray]:
    """Those of an unlike head that turns, opens its mouth and looks aside."""
    rng = np.random.default_rng(seed)
    return {
        "shape": rng.normal(size=SHAPES),
        "expr": rng.normal(size=(1, EXPRESSIONS)),
        "rotation": np.array([[2.9, 0.4, -0.3]]),
        "neck_pose": np.array([[0.05, -0.12, 0.04]]),
        "jaw_pose": np.array([[0.22, 0.01, -0.02]]),
        "eyes_pose": np.array([[0.05, 0.2, 0.01, 0.06, 0.17, -0.02]]),
        "translation": np.array([[0.3, 1.2, -0.4]]),
    }


def write_archive(path: Path, arrays: dict[str, Any]) -> Path:
    np.savez(path, **arrays)
    return path


def write_pickle(path: Path, arrays: dict[str, Any], protocol: int = 2) -> Path:
    """As the published files are: chumpy's arrays of the modes, a sparse regressor, and text beside them."""
    module = types.ModuleType("chumpy.ch")

    class Ch:
        def __init__(self, x: np.ndarray) -> None:
            self.x = x

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    module.Ch = Ch  # type: ignore[attr-defined]
    content = dict(arrays) | {"bs_type": "lrotmin", "bs_style": "lbs"}
    content["shapedirs"], content["v_template"] = Ch(arrays["shapedirs"]), Ch(arrays["v_template"])
    content["J_regressor"] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    sys.modules |= {"chumpy": types.ModuleType("chumpy"), "chumpy.ch": module}
    try:
        path.write_bytes(pickle.dumps(content, protocol=protocol))
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]
    return path


def flame_template(model: FlameModel, head: HeadModel, name: str = "flame") -> Template:
    """The template that the made-up model's mesh becomes, without a registration: its head is the default model's."""
    level, mean = head.levels["p95"], head.vertices(np.zeros(0))
    rest, skin = model.template * 1000.0, head.levels["p95"].count
    attachment, _, _ = bind_vertices(
        mean[level.rows], vertex_normals(mean[level.rows], level.faces), mean, head.levels["full"].faces
    )
    size = (len(rest) - skin) // 2
    wholes = np.repeat([-1, 0, 1], [skin, size, size])
    corners = model.faces.ravel()
    nowhere = np.full(len(corners), -1, np.int32)
    return Template(
        name=name,
        source="generic_model.pkl",
        source_sha256="fa" * 32,
        model_name=head.name,
        model_sha256=head.sha256,
        mesh=PolygonMesh(rest, np.full(len(model.faces), 3, np.int32), corners, np.zeros((0, 2)), nowhere),
        surface_binding=surface_binding(rest, np.arange(skin), attachment, wholes),
        flame=model,
    )
