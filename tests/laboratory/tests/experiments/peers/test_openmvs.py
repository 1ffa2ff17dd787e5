"""What the peer is given, checked by projecting it again; and its programs, by stand-ins that say what was asked."""

import stat
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pipeline.stereo.crops import Crop, make_crops
from rig.errors import InputError
from rig.mesh import Mesh
from rig.messages.message import texts_of
from tests.laboratory.experiments.peers.openmvs import (
    PROGRAMS,
    PeerFailed,
    programs_in,
    surface_by_openmvs,
    write_input,
)
from tests.support.ellipsoid_depths import Ellipsoid, scene
from tests.support.scenes import ellipsoid, fan


@pytest.fixture(scope="module")
def ball() -> list[Crop]:
    made = scene([Ellipsoid((0, 0, 0), (60, 60, 60))], fan(200, 150))
    images = {name: np.full((*seen.mask.shape, 3), 128, np.uint8) for name, seen in made.silhouettes.items()}
    return make_crops(images, made.silhouettes, made.rig, pixel_mm=0.1, at_world=np.zeros(3))


@pytest.fixture(scope="module")
def hull() -> Mesh:
    unit = ellipsoid(3)
    return Mesh(60.0 * unit.vertices / np.linalg.norm(unit.vertices, axis=1, keepdims=True), unit.faces)


def program(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


def test_the_model_projects_its_points_where_it_says(tmp_path: Path, ball: list[Crop], hull: Mesh) -> None:
    write_input(ball, hull, tmp_path)
    rows = {n: (tmp_path / "sparse" / f"{n}.txt").read_text().splitlines() for n in ("cameras", "images", "points3D")}
    points = {int(line.split()[0]): line.split() for line in rows["points3D"]}
    places = {number: np.array(words[1:4], float) for number, words in points.items()}
    assert len(places) > 300
    lenses = [np.array(line.split()[2:], float) for line in rows["cameras"]]
    seen = {}
    for number, (pose, pixels) in enumerate(zip(rows["images"][::2], rows["images"][1::2], strict=True)):
        words, shown = pose.split(), np.array(pixels.split(), float).reshape(-1, 3)
        w, x, y, z, *translation = (float(word) for word in words[1:8])
        observed = np.stack([places[int(p)] for p in shown[:, 2]])
        camera = Rotation.from_quat((x, y, z, w)).apply(observed) + np.array(translation)
        _, _, fx, fy, cx, cy = lenses[number]
        drawn = np.stack([fx * camera[:, 0] / camera[:, 2] + cx, fy * camera[:, 1] / camera[:, 2] + cy], axis=1)
        assert np.abs(drawn - shown[:, :2]).max() < 0.001
        seen[int(words[0])] = shown[:, 2].astype(int)
        mask = cv2.imread(str(tmp_path / "masks" / words[9].replace(".png", ".mask.png")), cv2.IMREAD_GRAYSCALE)
        photograph = cv2.imread(str(tmp_path / "images" / words[9]))
        assert mask is not None
        assert photograph is not None
        assert mask.shape == photograph.shape[:2]
        column, row = np.floor(shown[:, :2]).astype(int).T  # a pixel's middle is at a half there
        assert (mask[row, column] > 0).mean() > 0.95
    for number, words in points.items():  # tracks name a view's row of the point
        for view, row in zip(*(iter(map(int, words[8:])),) * 2, strict=True):
            assert seen[view][row] == number


def test_programs_run_in_turn_and_the_refined_surface_comes_back(tmp_path: Path, ball: list[Crop], hull: Mesh) -> None:
    bin_folder, folder = tmp_path / "bin", tmp_path / "work"
    bin_folder.mkdir()
    trimesh.Trimesh(hull.vertices, hull.faces, process=False).export(tmp_path / "given.ply")
    for name in PROGRAMS:
        program(bin_folder, name, f'echo "{name} $*" >> said.txt')
    busy = "i=0; while [ $i -lt 20000 ]; do i=$((i+1)); done"
    program(bin_folder, "RefineMesh", f"cp {tmp_path / 'given.ply'} refined.ply; {busy}")
    found, seconds = surface_by_openmvs(ball, hull, programs_in(bin_folder), folder)
    assert found.vertices.shape == hull.vertices.shape
    assert seconds > 0.0
    said = (folder / "said.txt").read_text().splitlines()
    assert [line.split()[0] for line in said] == list(PROGRAMS[:3])
    assert "--mask-path" in said[1]


def test_a_program_that_fails_is_named_with_its_last_words(tmp_path: Path, ball: list[Crop], hull: Mesh) -> None:
    for name in PROGRAMS:
        program(tmp_path, name, "true")
    program(tmp_path, "DensifyPointCloud", "echo error: no points; exit 1")
    with pytest.raises(PeerFailed, match="DensifyPointCloud: ended with 1: error: no points"):
        surface_by_openmvs(ball, hull, programs_in(tmp_path), tmp_path / "work")
    program(tmp_path, "DensifyPointCloud", "true")
    with pytest.raises(PeerFailed, match=r"RefineMesh: left no refined\.ply"):
        surface_by_openmvs(ball, hull, programs_in(tmp_path), tmp_path / "again")


def test_every_missing_program_is_named(tmp_path: Path) -> None:
    program(tmp_path, "RefineMesh", "true")
    with pytest.raises(InputError) as refused:
        programs_in(tmp_path)
    assert texts_of(refused.value.faults) == [f"holds no {name}" for name in PROGRAMS[:3]]
