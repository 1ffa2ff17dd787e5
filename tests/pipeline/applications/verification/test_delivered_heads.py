"""Heads come back from result folders as they were before their expression and place, and make a model."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.applications.verification.delivered_heads import build_from_results, find_results, read_delivered
from pipeline.applications.verification.measured import read_report
from pipeline.head_model.model import load_model
from rig.errors import InputError
from rig.formats.meshes.ply import write_ply
from rig.geometry import rotation_from_vector
from rig.mesh import Mesh

SMILE = {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.4}


def coefficients(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(40)


def deliver(folder: Path, seed: int, warnings: tuple[str, ...] = (), model: str = "makehuman-138") -> None:
    """Writes the result of a head that smiles, somewhere in the world."""
    head = load_model()
    vertices = head.posed_vertices(coefficients(seed), SMILE)
    rotation, shift = rotation_from_vector(np.array([0.3, -0.8, 0.1])), np.array([200.0, -30.0, seed])
    mesh = Mesh(vertices @ rotation.T + shift, head.levels["full"].faces)
    count = len(vertices)
    folder.mkdir(parents=True)
    write_ply(
        folder / "head.ply",
        mesh,
        normals=mesh.normals(),
        colours=np.full((count, 3), 99, np.uint8),
        quality=np.full(count, 0.1, np.float32),
        views=np.ones(count, np.uint8),
    )
    report = {
        "model": {"name": model, "sha256": head.sha256},
        "landmarks": {},
        "world_from_head": {"scale": 1.0, "rotation": rotation.tolist(), "translation": shift.tolist()},
        "warnings": [{"code": code} for code in warnings],
        "expression": [{"name": name, "weight": weight} for name, weight in SMILE.items()],
        "inputs": {"images/cam00.png": f"{seed}", "cameras.json": "c"},
    }
    (folder / "report.json").write_text(json.dumps(report))


def test_heads_come_back_without_smile_and_place(tmp_path: Path) -> None:
    head = load_model()
    deliver(tmp_path / "shots" / "anna", 1)
    deliver(tmp_path / "shots" / "ben", 2, warnings=("pose-doubtful", "eyes-closed"))
    delivered, skipped = read_delivered(tmp_path, find_results(tmp_path), head)
    assert delivered.names == ("shots/anna",)
    assert {name: fault.text for name, fault in skipped.items()} == {"shots/ben": "warns pose-doubtful"}
    surface = head.levels["full"].operator @ delivered.cages[0]
    off = np.linalg.norm(surface - head.vertices(coefficients(1)), axis=1)
    assert np.median(off) < 0.02
    np.testing.assert_allclose(delivered.deviation_mm, 0.1, rtol=1e-6)


def test_a_model_of_results_knows_them_better_and_is_used_like_the_old_one(tmp_path: Path) -> None:
    for seed, place in enumerate(("results/s0", "results/s1", "elsewhere")):
        deliver(tmp_path / place, seed)
    for link, place in (("s2", "elsewhere"), ("z", "elsewhere"), ("loop", "results")):
        (tmp_path / "results" / link).symlink_to(tmp_path / place)
    built = build_from_results(tmp_path / "results", tmp_path / "ours.npz", name="ours")
    model, old = load_model(tmp_path / "ours.npz"), load_model()
    assert (model.name, dict(model.subjects)["total"], built.used) == ("ours", 3, ("s0", "s1", "s2"))
    assert model.expressions.names == old.expressions.names
    np.testing.assert_array_equal(model.levels["full"].faces, old.levels["full"].faces)
    assert set(model.figures) == {"held_out_mm", "held_out_before_mm", "modes_used"}


def test_what_makes_no_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no result"):
        find_results(tmp_path)
    deliver(tmp_path / "a", 1)
    deliver(tmp_path / "b", 2, warnings=("pose-doubtful",))
    with pytest.raises(InputError, match=r"1 results can be used, but 3 are needed.*b: warns pose-doubtful"):
        build_from_results(tmp_path, tmp_path / "out.npz", name="out")
    deliver(tmp_path / "again", 1)
    with pytest.raises(InputError, match=r"1 results can.*again: .*same photographs as a,"):
        build_from_results(tmp_path, tmp_path / "out.npz", name="out")
    with pytest.raises(InputError, match=r"results of 3 captures \(a, again, b\)"):
        read_report(tmp_path)
    shutil.rmtree(tmp_path / "again")
    deliver(tmp_path / "c", 3)
    (tmp_path / "c" / "head.ply").write_bytes(b"ply\n")
    with pytest.raises(InputError, match=r"c/?.*head\.ply"):
        build_from_results(tmp_path, tmp_path / "out.npz", name="out")
    document = json.loads((tmp_path / "a" / "report.json").read_text())
    (tmp_path / "a" / "report.json").write_text(json.dumps(document | {"model": {"name": "ict", "sha256": "0" * 64}}))
    with pytest.raises(InputError, match=r"versions \(ict \[a\], makehuman-138 \[b, c\]\)"):
        build_from_results(tmp_path, tmp_path / "out.npz", name="out")
    assert not (tmp_path / "out.npz").exists()
