"""The shipped default model: what the file promises, the levels, evaluation of subsets, damage."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.head_model import landmarks
from pipeline.head_model.model import HeadModel, load_model, model_info, with_modes
from pipeline.head_model.model_file import BadModel, read_parts, save_model
from pipeline.head_model.model_names import UnknownModel, list_models, model_path
from pipeline.head_model.subdivision import boundary_loops, check_manifold, opened_faces
from rig.mesh import face_normals, vertex_normals


def test_the_database_is_the_papers(model: HeadModel) -> None:
    assert model.name == "makehuman-138"
    assert dict(model.subjects) == {"total": 138, "male": 97, "female": 41}
    assert len(model.modes) == 137
    assert model.levels["full"].count >= 48_000
    assert model.licence.startswith("CC0")
    assert len(model.sha256) == 64
    assert set(model.landmarks) == set(landmarks.NAMES)
    assert len(landmarks.NAMES) == 26
    info = model_info(model)
    assert (info["modes"], info["landmarks"], info["sha256"]) == (137, 26, model.sha256)
    assert info["faces"] > info["vertices"]
    assert 0.5 < info["generalisation_mm"] < 2.0


def test_the_mean_head_has_a_human_size_and_the_head_frame(model: HeadModel) -> None:
    mean = model.vertices(np.zeros(0))
    at = {name: mean[index] for name, index in model.landmarks.items()}
    assert at["exocanthion_left"][0] > 30 > -30 > at["exocanthion_right"][0]  # x to the subject's left
    assert at["glabella"][1] > at["pronasale"][1] > at["gnathion"][1]  # y up
    assert at["pronasale"][2] > max(p[2] for n, p in at.items() if n != "pronasale")  # z out of the face
    skull = mean[(mean[:, 1] > 20)]
    assert 135 < np.ptp(skull[np.abs(skull[:, 1] - 60) < 10, 0]) < 170  # head breadth: 150 mm (Farkas), +-4 sd
    assert 175 < np.ptp(skull[:, 2]) < 215  # head length: 195 mm
    assert 80 < at["exocanthion_left"][0] - at["exocanthion_right"][0] < 100
    assert np.abs(mean[[model.landmarks["tragion_left"], model.landmarks["tragion_right"]]].mean(0)).max() < 0.5


def test_every_level_is_one_outward_surface_open_only_at_the_neck(model: HeadModel) -> None:
    for name, level in model.levels.items():
        check_manifold(level.faces)
        v = model.vertices(np.zeros(0), name)
        assert np.unique(level.faces).tolist() == list(range(level.count)), name
        normals = vertex_normals(v, level.faces)
        outward = ((v - v.mean(0)) * normals).sum(1) > 0
        assert outward.mean() > 0.85, name
        assert v[level.boundary, 1].max() < -80, name  # below the chin
        assert set(level.landmarks) == set(landmarks.NAMES), name
        area = np.linalg.norm(face_normals(v, level.faces), axis=1) / 2
        assert area.min() > 0, name


def test_the_neck_is_cut_clean(model: HeadModel) -> None:
    """The border of the mean is plane and convex: its turns add up to one, where a saw's would add up to several."""
    for name, level in model.levels.items():
        (loop,) = boundary_loops(level.faces)
        border = model.vertices(np.zeros(0), name)[loop]
        centred = border - border.mean(0)
        assert np.abs(centred @ np.linalg.svd(centred)[2][2]).max() < 0.5, name
        along = np.roll(border, -1, 0) - border
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        turns = np.degrees(np.arccos(np.clip((along * np.roll(along, 1, 0)).sum(1), -1, 1)))
        assert turns.sum() == pytest.approx(360, abs=2), name


def test_levels_are_rows_of_the_full_one(model: HeadModel) -> None:
    rng = np.random.default_rng(1)
    z = rng.standard_normal(60)
    full = model.vertices(z)
    for name, share in (("p95", 0.05), ("p99", 0.01)):
        level = model.levels[name]
        assert len(level.faces) <= share * len(model.levels["full"].faces) + 2
        np.testing.assert_allclose(model.vertices(z, name), full[level.rows], atol=1e-6)
        for landmark, index in level.landmarks.items():
            np.testing.assert_allclose(model.vertices(z, name)[index], full[model.landmarks[landmark]], atol=1e-6)


def test_decimated_levels_stay_on_the_head(model: HeadModel) -> None:
    """Face-region points of the full level lie near the planes of the decimated one."""
    import trimesh

    v, fine = model.vertices(np.zeros(0)), model.levels["full"]
    some = np.random.default_rng(0).choice(np.flatnonzero(fine.face_region), 300, replace=False)
    for name, limit in (("p95", 0.15), ("p99", 1.0)):
        level = model.levels[name]
        mesh = trimesh.Trimesh(model.vertices(np.zeros(0), name), level.faces, process=False)
        _, distance, _ = trimesh.proximity.closest_point_naive(mesh, v[some])
        assert np.median(distance) < limit, (name, np.median(distance))


def test_basis_of_a_subset_agrees_with_finite_differences(model: HeadModel) -> None:
    picked = np.array([0, 7, 52_000, 30_123])
    basis = model.basis("full", 20, picked)
    assert basis.shape == (20, 4, 3)
    zero = model.vertices(np.zeros(20))[picked]
    for m in (0, 3, 19):
        step = model.vertices(np.eye(20)[m])[picked] - zero
        np.testing.assert_allclose(basis[m], step, atol=2e-5)  # float32 of values up to 20 mm
    np.testing.assert_array_equal(model.basis("p95", 8)[:, 5:9], model.basis("p95", 8, np.arange(5, 9)))


def test_coefficients_are_standard_deviations(model: HeadModel) -> None:
    flat = model.modes.reshape(len(model.modes), -1).astype(float)
    np.testing.assert_allclose(np.linalg.norm(flat, axis=1), model.sigma, rtol=1e-3)
    gram = flat @ flat.T / np.outer(model.sigma, model.sigma)
    assert np.abs(gram - np.eye(len(gram))).max() < 2e-3  # rounding to 2^-12 mm on modes of a few mm in all
    np.testing.assert_allclose(model.scores.std(0, ddof=1), 1, rtol=1e-4)
    assert (np.diff(model.sigma) <= 0).all()


def test_a_saved_model_is_the_same_by_name(tmp_path: Path, model: HeadModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_MODELS", str(tmp_path))
    parts, _ = read_parts(model_path("default"))
    save_model(tmp_path / "again.npz", parts)
    assert "again" in list_models()
    again = load_model("again")
    np.testing.assert_array_equal(again.mean, model.mean)
    np.testing.assert_array_equal(again.modes, model.modes)
    np.testing.assert_array_equal(again.levels["p99"].faces, model.levels["p99"].faces)
    assert again.figures == model.figures


def test_unknown_and_damaged_models_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(UnknownModel, match="model import"):
        load_model("nobody")
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(model_path("default").read_bytes()[:100_000])
    with pytest.raises(BadModel, match="damaged"):
        load_model(damaged)
    foreign = tmp_path / "foreign.npz"
    np.savez(foreign, mean=np.zeros((4, 3)))
    with pytest.raises(BadModel, match="import"):
        load_model(foreign)


def test_fewer_modes(model: HeadModel) -> None:
    few = with_modes(model, 5)
    assert few.basis("cage", 5).shape == (5, model.mean.shape[0], 3)
    with pytest.raises(ValueError, match="coefficients"):
        few.vertices(np.zeros(6))


def test_the_default_model_opens_at_eyes_and_mouth(model: HeadModel) -> None:
    """Two lids' borders and one of lips besides the neck's; nothing else is left out."""
    full = model.levels["full"].faces
    opened = opened_faces({name: model.levels[name].faces for name in ("cage", "full")})
    loops, mean = boundary_loops(opened), model.vertices(np.zeros(0))
    assert len(loops) == 4
    for name in ("stomion", "endocanthion_left", "exocanthion_right"):
        near = min(np.linalg.norm(mean[loop] - mean[model.landmarks[name]], axis=1).min() for loop in loops)
        assert near < 8.0
    np.testing.assert_array_equal(opened, full[: len(opened)])
    assert len(boundary_loops(full)) == 1
    closed = {name: full[: len(opened)] for name in ("cage", "full")}
    assert len(opened_faces(closed)) == len(opened)  # what is open is left as it is
