"""``eigenhead sequence``: seven small frames of a head in the studio that turns and speaks, run through the command."""

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.applications.moments import sequence, sequence_person
from pipeline.applications.moments.footage import open_footage
from pipeline.applications.moments.sequence_files import CACHE, CHUNKS, FILES
from pipeline.applications.moments.sequence_person import find_person
from pipeline.head_model.model import HeadModel
from pipeline.settings import settings_from_document
from rig.errors import EigenheadError, InputError
from rig.formats.meshes.usdz import ROOT, openusd_module
from rig.formats.pictures.images import read_image
from rig.formats.pictures.work_size import work_rig
from rig.geometry import vector_from_rotation
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from server.cli.heads import head_alone
from server.cli.main import app
from server.tasks.moving_subject import FPS, Person, simulate_sequence
from server.tasks.settings_file import settings_document
from tests.support.services import small_capture
from tests.support.small_studio import CLEAN

FRAMES, LOST, PIXELS = 7, 4, 320 * 240
CAMERAS = ["cam00", "cam01", "cam03", "cam04", "cam07"]


@pytest.fixture(scope="module")
def film(model: HeadModel, renderer: Renderer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The film; its frame ``LOST`` has no pictures but one, and its cameras are said to expose 100 ms apart."""
    folder = tmp_path_factory.mktemp("film") / "anna"
    person = Person(model, 0.8 * np.random.default_rng(4).standard_normal(len(model.modes)), 3)
    rig, preset = work_rig(default_layout().subset(CAMERAS), PIXELS), replace(CLEAN, noise=0.005, plates=2)
    simulate_sequence(folder, person, rig, preset, FRAMES, renderer=renderer, report=lambda stage, share: None)
    for name in CAMERAS[1:]:
        (folder / "images" / name / f"{LOST:05}.png").unlink()
    later = {name: {"mean_ms": 25.0 * number - 50.0} for number, name in enumerate(CAMERAS)}
    (folder / "clock.json").write_text(json.dumps({"cameras": later}))
    return folder


def run(film: Path, out: Path, *options: str) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["sequence", str(film), "--out", str(out), "--usd", "--json", *options])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def few() -> Any:
    """Two frames for the identity, and chunks of three frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sequence_person, "KEYS", 2)
        patch.setattr(sequence, "CHUNK", 3)
        yield


@pytest.fixture(scope="module")
def done(film: Path, few: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("track")
    return out, run(film, out)


def test_every_frame_has_the_heads_pose(done: tuple[Path, dict[str, Any]], film: Path, model: HeadModel) -> None:
    out, document = done
    assert document == json.loads((out / "report.json").read_text())
    assert document["failed"] == [f"{LOST:05}"]
    said = ["sequence-frames-failed", "sequence-pictures-missing", "sequence-skewed"]
    assert [each["code"] for each in document["warnings"]] == said
    assert document["pictures_missing"] == dict.fromkeys(CAMERAS[1:], 1)
    with np.load(out / "sequence.npz") as found, np.load(film.with_name("anna.truth") / "truth.npz") as truth:
        assert found["frames"].tolist() == [f"{k:05}" for k in range(FRAMES)]
        assert np.flatnonzero(found["failed"]).tolist() == [LOST]
        np.testing.assert_allclose(found["times_s"], np.arange(FRAMES) / FPS, atol=1e-6)
        turned = [a @ b.T for a, b in zip(found["rotations"], truth["rotations"], strict=True)]
        apart = np.degrees([vector_from_rotation(each @ turned[0].T) for each in turned])
        turn = np.degrees(vector_from_rotation(truth["rotations"][-1] @ truth["rotations"][0].T))
        jaw = [list(each["expressions"]).index("jawOpen") for each in (found, truth)]
        weights = found["weights"][:, jaw[0]], truth["weights"][:, jaw[1]]
        marks = truth["vertices"][:, list(model.landmarks.values())]
        moved_mm = 0.1 * FPS * np.linalg.norm(np.gradient(marks, axis=0), axis=2).mean(axis=1)
        assert found["skew_mm"].mean() == pytest.approx(moved_mm.mean(), rel=0.25)
        spread = found["pose_deviations"]
        assert (spread[LOST] > np.minimum(spread[LOST - 1], spread[LOST + 1])).all()
    assert np.linalg.norm(turn) > 2.0  # else the test shows nothing
    assert np.linalg.norm(apart, axis=1).max() < 0.5  # a pixel on the face is 0.9 degrees
    assert np.ptp(weights[1]) > 0.1
    assert np.corrcoef(*weights)[0, 1] > 0.8


def test_the_head_is_animated(done: tuple[Path, dict[str, Any]]) -> None:
    data = (done[0] / "sequence.glb").read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    (animation,) = document["animations"]
    paths = {each["target"]["path"]: animation["samplers"][each["sampler"]] for each in animation["channels"]}
    targets = document["meshes"][0]["extras"]["targetNames"]
    assert "jawOpen" in targets
    counts = {path: document["accessors"][sampler["output"]]["count"] for path, sampler in paths.items()}
    assert counts == {"rotation": FRAMES, "translation": FRAMES, "weights": FRAMES * len(targets)}
    assert document["buffers"][0]["byteLength"] == len(data) - 28 - length
    reel = cv2.VideoCapture(str(done[0] / "preview.mp4"))
    assert int(reel.get(cv2.CAP_PROP_FRAME_COUNT)) == FRAMES
    reel.release()


def test_the_point_cache_moves_as_the_weights_and_poses_do(done: tuple[Path, dict[str, Any]]) -> None:
    UsdGeom = openusd_module("UsdGeom")
    stage = openusd_module("Usd").Stage.Open(str(done[0] / CACHE))
    head = UsdGeom.Mesh(stage.GetPrimAtPath(f"{ROOT}/head"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, FRAMES - 1.0)
    assert stage.GetTimeCodesPerSecond() == pytest.approx(FPS)
    with np.load(done[0] / "sequence.npz") as course, np.load(done[0] / "person.npz") as person:
        for k in (0, FRAMES - 1):
            still = person["neutral"] + np.einsum("e,evx->vx", course["weights"][k], person["shapes"])
            world_mm = still @ course["rotations"][k].T + course["translations"][k]
            expected = (world_mm - course["translations"][0]) @ course["rotations"][0] / 1000.0
            found = np.array(head.GetPointsAttr().Get(float(k)))
            np.testing.assert_allclose(found, expected, atol=1e-6)
            normals = np.array(head.GetNormalsAttr().Get(float(k)))
            assert (normals * (found - found.mean(axis=0))).sum(axis=1).mean() > 0.02  # outwards, m
            np.testing.assert_allclose(head.GetExtentAttr().Get(float(k)), [found.min(axis=0), found.max(axis=0)])


def test_a_run_that_was_cut_short_and_shared_goes_on_to_the_same_bytes(
    done: tuple[Path, dict[str, Any]], film: Path, tmp_path: Path
) -> None:
    out = tmp_path / "again"
    shutil.copytree(done[0] / CHUNKS, out / CHUNKS)
    for path in sorted((out / CHUNKS).glob("0*.npz"))[1:]:
        path.unlink()
    (out / CHUNKS / ".0000003.npz.x.part").write_bytes(b"half of it")
    kept = {path.name: path.stat().st_mtime_ns for path in (out / CHUNKS).glob("*.npz")}
    assert len(kept) == 2
    assert run(film, out, "--shard", "2/2") == {"shard": "2/2"}  # the last chunk, without the one before
    assert not (out / "report.json").exists()
    assert len(list((out / CHUNKS).glob("0*.npz"))) == 2
    run(film, out, "--shard", "1/2")
    assert {name: (out / CHUNKS / name).stat().st_mtime_ns for name in kept} == kept  # they were not made anew
    for name in (*FILES, CACHE):
        assert (out / name).read_bytes() == (done[0] / name).read_bytes(), name


def test_a_frame_without_a_head_does_not_hide_the_person(
    film: Path, model: HeadModel, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    footage = open_footage(film)
    chosen = settings_from_document(head_alone(settings_document(None, detail="photo")))
    for keys in ((LOST,), (LOST, 2)):
        monkeypatch.setattr(sequence_person, "best_frames", lambda footage, keys=keys: keys)
        if len(keys) == 1:
            with pytest.raises(EigenheadError, match=f"{LOST:05}"):
                find_person(footage, model, chosen, renderer, lambda share: None)
        else:
            assert find_person(footage, model, chosen, renderer, lambda share: None).keys == (2,)


def write_video(film: Path, path: Path, rate: float) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, (320, 240))
    for k in range(LOST):
        writer.write(np.ascontiguousarray(read_image(film / "images" / path.stem / f"{k:05}.png")[:, :, ::-1]))
    writer.release()


def test_videos_are_read_from_any_frame(film: Path, tmp_path: Path) -> None:
    shutil.copy(film / "cameras.json", tmp_path / "cameras.json")
    (tmp_path / "videos").mkdir()
    for name in CAMERAS:
        write_video(film, tmp_path / "videos" / f"{name}.avi", 30.0)
    footage = open_footage(tmp_path)
    np.testing.assert_allclose(footage.times_s, np.arange(LOST) / 30.0)
    whole, later = list(footage.read()), list(footage.read(2))
    assert len(whole) == LOST
    for name in CAMERAS:
        assert np.array_equal(whole[2][name], later[0][name])
    with footage.capture(3) as (capture, rig):
        assert np.array_equal(capture.images["cam00"], whole[3]["cam00"])
        assert rig.names == tuple(CAMERAS)
    write_video(film, tmp_path / "videos" / "cam03.avi", 60.0)
    with pytest.raises(InputError, match=r"30\.00 .*cam03 .*60\.00"):
        open_footage(tmp_path)


def test_what_is_wrong_with_a_folder_is_said(film: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cameras"):
        open_footage(tmp_path)
    shutil.copy(film / "cameras.json", tmp_path / "cameras.json")
    shutil.copytree(film / "images" / "cam00", tmp_path / "images" / "cam00")
    with pytest.raises(InputError, match="cam07"):
        open_footage(tmp_path)
    for name in CAMERAS[1:]:
        shutil.copytree(film / "images" / name, tmp_path / "images" / name)
    for name, text in (("times.csv", "frame,time_s\n00000,0.0\n"), ("clock.json", '{"cameras": {}}')):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=name.replace(".", r"\.")):
            open_footage(tmp_path)
        (tmp_path / name).unlink()
    for name in CAMERAS:
        (tmp_path / "images" / name / "00002.png").unlink(missing_ok=True)
    times = open_footage(tmp_path).times_s  # a recorder dropped that frame
    np.testing.assert_allclose(times, np.array([0, 1, 3, 4, 5, 6]) / FPS)
    for path in (tmp_path / "images").glob("*/*"):
        path.rename(path.with_stem(f"{path.parent.name}-{path.stem}"))
    with pytest.raises(InputError, match="under one name"):
        open_footage(tmp_path)


def test_the_studio_films_a_subject_over_an_earlier_capture(tmp_path: Path, model: HeadModel) -> None:
    out = small_capture(tmp_path / "film")
    words = ["simulate", str(out), "--sequence", "2", "--seed", "3", "--json"]
    assert CliRunner().invoke(app, words).exit_code == 1  # it is there already
    result = CliRunner().invoke(app, [*words, "--overwrite"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == {"sequence": str(out), "truth": str(tmp_path / "film.truth")}
    footage = open_footage(out)
    assert footage.frames == ("00000", "00001")
    assert len(footage.rig) == len(list((out / "background").iterdir())) == 11
    assert {image.shape for image in next(footage.read()).values()} == {(480, 640, 3)}
    with np.load(tmp_path / "film.truth" / "truth.npz") as truth:
        moved = np.linalg.norm(truth["vertices"][1] - truth["vertices"][0], axis=1)
        face = truth["face"]
    assert face.shape == moved.shape == (model.levels["full"].count,)
    assert 0.1 < moved[face].mean() < 5.0  # talk, at 25 frames a second
