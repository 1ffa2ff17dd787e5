"""Foreign models: nothing of their distribution may get lost, and what they lack is filled in sensibly."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from pipeline.applications.model_building.sources.imports import (
    ICT_LANDMARKS_68,
    ICT_VERTICES,
    CannotImport,
    Foreign,
    adopt,
    import_model,
    read_ict_compact,
    read_ict_repository,
    read_plain,
    read_statismo,
)
from pipeline.head_model import landmarks
from pipeline.head_model.model import HeadModel, load_model
from pipeline.head_model.model_file import save_model
from tests.pipeline.applications.model_building.sources.test_fetch import write_obj
from tests.support.shared_data import shared


@pytest.fixture
def small(model: HeadModel) -> dict[str, np.ndarray]:
    """A foreign model of 540 vertices whose 6 modes are far from orthogonal, in head axes and mm."""
    mixing = np.random.default_rng(3).standard_normal((6, 6)) + np.eye(6)
    modes = np.tensordot(mixing, model.basis("p99", 6), 1)
    place = model.levels["p99"].landmarks
    return {
        "mean": model.vertices(np.zeros(0), "p99"),
        "modes": modes,
        "faces": model.levels["p99"].faces,
        "landmark_names": np.array(list(place)),
        "landmark_vertices": np.array(list(place.values())),
        "subjects": np.array([7, 4, 3]),
        "licence": np.array("CC0-1.0"),
    }


def covariance(modes: np.ndarray) -> np.ndarray:
    flat = modes.reshape(len(modes), -1).astype(float)
    return flat.T @ flat


def test_plain_npz_keeps_its_vertices_and_its_gaussian(tmp_path: Path, small: dict[str, np.ndarray]) -> None:
    """Modes A and B give the same N(mean, A^T A) if and only if A^T A = B^T B."""
    np.savez(tmp_path / "small.npz", allow_pickle=False, **small)
    parts = import_model(tmp_path / "small.npz", name="tiny")
    assert parts.name == "tiny"
    assert import_model(tmp_path).mean.shape == parts.mean.shape  # a folder that holds one file is that file
    assert parts.subjects == {"total": 7, "male": 4, "female": 3}
    assert parts.licence == "CC0-1.0"
    gram = parts.modes.reshape(6, -1) @ parts.modes.reshape(6, -1).T
    np.testing.assert_allclose(gram, np.diag(parts.sigma**2), atol=1e-6 * gram.max())
    wanted = covariance(small["modes"])
    np.testing.assert_allclose(covariance(parts.modes), wanted, atol=1e-5 * np.abs(wanted).max())
    moved = parts.mean - small["mean"]
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-9)
    np.testing.assert_array_equal(parts.faces[: len(small["faces"])], small["faces"])
    assert {n: parts.landmarks[n] for n in landmarks.NAMES} == dict(
        zip(small["landmark_names"].tolist(), small["landmark_vertices"].tolist(), strict=True)
    )
    save_model(tmp_path / "tiny.npz", parts)
    model = load_model(tmp_path / "tiny.npz")
    assert model.levels["full"].count == len(small["mean"])  # the identity


def test_plain_npz_with_unit_modes_and_sigma(tmp_path: Path, small: dict[str, np.ndarray]) -> None:
    sigma = np.arange(6, 0, -1.0)
    np.savez(tmp_path / "unit.npz", allow_pickle=False, **(small | {"sigma": sigma}))
    got = read_plain(tmp_path / "unit.npz").modes
    np.testing.assert_allclose(got, small["modes"] * sigma[:, None, None], rtol=1e-6)


def test_statismo_file(tmp_path: Path, small: dict[str, np.ndarray]) -> None:
    flat, place = small["modes"].reshape(6, -1), small["landmark_names"].tolist().index("pronasale")
    length = np.linalg.norm(flat, axis=1)
    with h5py.File(tmp_path / "basel.h5", "w") as file:
        file["shape/model/mean"] = small["mean"].ravel()
        file["shape/model/pcaBasis"] = (flat / length[:, None]).T
        file["shape/model/pcaVariance"] = length**2
        file["shape/representer/cells"] = small["faces"].T
        tip = small["mean"][small["landmark_vertices"][place]]
        file["metadata/landmarks/json"] = f'[{{"id": "center.nose.tip", "coordinates": {tip.tolist()}}}]'
    got = read_statismo(tmp_path / "basel.h5")
    np.testing.assert_allclose(got.modes, small["modes"], atol=1e-4)
    np.testing.assert_array_equal(got.faces, small["faces"])
    assert got.landmarks == {"pronasale": small["landmark_vertices"][place]}


def test_ict_repository_layout(tmp_path: Path) -> None:
    """A stand-in repository written from the compact copy: centimetres, and parts inside the head to be left out."""
    compact = np.load(shared("data/ict-facekit/ict_facekit_light.npz"))
    folder = tmp_path / "FaceXModel"
    folder.mkdir()
    inside = np.zeros((5, 3))
    inner_faces = np.array([[ICT_VERTICES, ICT_VERTICES + 1, ICT_VERTICES + 2], [0, 1, ICT_VERTICES]])
    faces = np.concatenate([compact["faces"], inner_faces])
    mean = compact["mean"].astype(float)
    write_obj(folder / "generic_neutral_mesh.obj", np.concatenate([mean, inside]) / 10, faces)
    for k in range(2):
        shape = np.concatenate([mean + compact["modes"][k].astype(float), inside]) / 10
        write_obj(folder / f"identity{k:03}.obj", shape, faces[:1])
    got = read_ict_repository(tmp_path)
    np.testing.assert_allclose(got.mean, mean, atol=1e-5 * 10)
    np.testing.assert_allclose(got.modes, compact["modes"][:2].astype(float), atol=1e-4)
    np.testing.assert_array_equal(got.faces, compact["faces"])
    assert got.licence == "MIT"
    assert got.landmarks["pronasale"] == compact["landmarks68"][30] == ICT_LANDMARKS_68[30]


@pytest.mark.slow
def test_ict_compact_copy_reproduces_the_original(tmp_path: Path) -> None:
    """Random draws of the original, at 100 modes, to under 0.05 mm; and landmarks where a face has them."""
    path = shared("data/ict-facekit/ict_facekit_light.npz")
    save_model(tmp_path / "ict.npz", import_model(path))
    model, original = load_model(tmp_path / "ict.npz"), np.load(path)
    assert len(model.modes) == 100
    assert 0 < model.figures["draws_mm"] < 0.05
    flat = model.modes.reshape(100, -1).astype(float)
    modes, rng = original["modes"].astype(float), np.random.default_rng(11)
    shift = model.vertices(np.zeros(0))[0] - original["mean"][0]
    for _ in range(10):
        draw = original["mean"] + np.tensordot(rng.standard_normal(100), modes, 1)
        z = flat @ (draw + shift - model.mean).ravel() / model.sigma.astype(float) ** 2
        assert np.linalg.norm(model.vertices(z) - shift - draw, axis=1).max() < 0.05
    at = {n: model.vertices(np.zeros(0))[v] for n, v in model.landmarks.items()}
    for name in landmarks.PAIRED:  # the mean is symmetric, the landmarks must be too
        left, right = at[f"{name}_left"], at[f"{name}_right"] * [-1, 1, 1]
        assert np.linalg.norm(left - right) < 6.0, name
    assert at["pogonion"][1] > at["gnathion"][1]
    assert at["sublabiale"][1] > at["pogonion"][1]
    assert at["glabella"][1] > at["nasion"][1]
    assert at["zygion_left"][0] > at["alare_left"][0] > 12


def test_what_cannot_be_a_head_is_refused(tmp_path: Path, small: dict[str, np.ndarray]) -> None:
    def refused(match: str, **change: np.ndarray) -> None:
        np.savez(tmp_path / "bad.npz", allow_pickle=False, **(small | change))
        with pytest.raises(CannotImport, match=match):
            import_model(tmp_path / "bad.npz")

    refused("shapes do not fit", mean=small["mean"][:-1])
    refused("not finite", mean=np.full_like(small["mean"], np.nan))
    refused("face index", faces=small["faces"] + 100)
    refused("convert it to mm", mean=small["mean"] / 1000, modes=small["modes"] / 1000)
    np.savez(tmp_path / "lacks.npz", mean=small["mean"])
    with pytest.raises(CannotImport, match="lacks modes, faces"):
        import_model(tmp_path / "lacks.npz")
    with pytest.raises(CannotImport, match="no such file"):
        import_model(tmp_path / "nothing.stl")
    with pytest.raises(CannotImport, match="FaceXModel"):
        import_model(tmp_path)


def test_openings_are_closed_but_the_neck(model: HeadModel) -> None:
    """Cut an eye-sized hole into the head: adopting the model closes it again, without a new vertex."""
    level = model.levels["p99"]
    mean = model.vertices(np.zeros(0), "p99")
    hole = level.landmarks["endocanthion_left"]
    foreign = Foreign(
        name="holed",
        licence="CC0-1.0",
        source="test",
        notice="",
        mean=mean,
        modes=model.basis("p99", 3),
        faces=level.faces[~(level.faces == hole).any(1)],
        landmarks={n: v for n, v in level.landmarks.items() if n != "endocanthion_left"} | {"endocanthion_left": 0},
        subjects={"total": 0, "male": 0, "female": 0},
    )
    parts = adopt(foreign)
    save = parts.faces
    edges = np.sort(np.concatenate([save[:, [0, 1]], save[:, [1, 2]], save[:, [2, 0]]]), 1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 1).sum() == level.boundary.sum()  # only the neck's edges are open


def test_expressions_beside_the_compact_copy_come_with_it() -> None:
    """55 of the 57 move the skin; they are the file's own, on the same vertices."""
    path = shared("data/ict-facekit/ict_facekit_light.npz")
    original = np.load(shared("data/ict-facekit/ict_facekit_expressions.npz"))
    found = read_ict_compact(path).expressions
    assert found is not None
    assert len(found) == 55
    assert not {"PupilDilate_L", "PupilDilate_R"} & set(found.names)
    place = original["names"].tolist().index("mouthSmile_L")
    np.testing.assert_array_equal(found.shapes[found.names.index("mouthSmile_L")], original["shapes"][place])
