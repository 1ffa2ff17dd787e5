"""``eigenhead calibrate --from scene``: what it writes and says, what it refuses, and which options go together."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.formats.cameras.cameras_file import FOLDER_FORMATS, FORMATS, write_rig_file
from rig.formats.cameras.cameras_json import read_rig, write_rig
from server.cli.answers import CannotWrite
from server.cli.main import app
from tests.server.cli.test_main import run
from tests.support.textured_wedge import wedge_rig, write_photographs


@pytest.mark.slow
def test_photographs_become_cameras_and_a_page(tmp_path: Path) -> None:
    photos = write_photographs(tmp_path / "photos", wedge_rig().subset(["cam00", "cam01", "cam02"]))
    out = tmp_path / "new" / "cameras.json"
    done = run("calibrate", str(photos), "--from", "scene", "--out", str(out), "--json")
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert set(printed["figures"]["cameras"]) == {"cam00", "cam01", "cam02"}
    assert {"rms_px", "used_share"} <= set(printed["figures"])
    assert printed["scale"]["assumed"]
    assert "ASSUMPTION" in done.stderr
    assert all(camera.covariance is not None for camera in read_rig(out))
    assert "3 of 3 views joined" in out.with_suffix(".html").read_text()


def test_faults_of_scale_json_end_it_before_the_work(tmp_path: Path) -> None:
    for name in "abc":
        (tmp_path / f"{name}.png").write_bytes(b"")
    (tmp_path / "scale.json").write_text(json.dumps({"cameras": ["a", "d"], "distance_mm": -1}))
    scale = str(tmp_path / "scale.json")
    done = run("calibrate", str(tmp_path), "--from", "scene", "--scale", scale, "--out", str(tmp_path / "cameras.json"))
    assert done.returncode == 1
    assert "distance_mm is -1" in done.stderr
    assert "cameras names 'd'" in done.stderr
    assert not (tmp_path / "cameras.json").exists()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ((), "--board"),
        (("--from", "sky"), "'sky' is none of board, scene"),
        (("--from", "scene", "--lenses", "two"), "'two' is none of one, each"),
        (("--from", "scene", "--board", "{file}"), "is for a board"),
        (("--scale", "{file}"), "is for --from scene"),
    ],
)
def test_options_that_do_not_go_together_are_wrong_usage(tmp_path: Path, options: tuple[str, ...], text: str) -> None:
    (tmp_path / "file").write_text("")
    arguments = [option.format(file=tmp_path / "file") for option in options]
    done = run("calibrate", str(tmp_path), "--out", str(tmp_path / "cameras.json"), *arguments)
    assert done.returncode == 2
    assert text in done.stderr


@pytest.mark.parametrize(
    ("kind", "out", "text"),
    [
        ("eigenhead", "file/cameras.json", "cannot be written"),
        ("eigenhead", "folder", "it is a folder"),
        ("colmap", "file", "it is a file, and a folder is written"),
        ("colmap", "file/sparse", "cannot be written"),
    ],
)
def test_a_place_where_no_cameras_can_be_written_is_named(tmp_path: Path, kind: str, out: str, text: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    write_rig(wedge_rig(), tmp_path / "cameras.json")
    done = CliRunner().invoke(
        app, ["convert", str(tmp_path / "cameras.json"), "--to", kind, "--out", str(tmp_path / out)]
    )
    assert isinstance(done.exception, CannotWrite)
    assert str(done.exception).startswith(f"{tmp_path / out} ")
    assert text in str(done.exception)


def test_cameras_that_take_no_part_are_told_where_a_file_is_converted(tmp_path: Path) -> None:
    write_rig_file(wedge_rig(), tmp_path / "rig.xml", "metashape")
    text = (tmp_path / "rig.xml").read_text()
    name = wedge_rig().names[0]
    (tmp_path / "rig.xml").write_text(text.replace(f'label="{name}">', f'label="{name}" enabled="false">'))
    done = CliRunner().invoke(app, ["convert", str(tmp_path / "rig.xml"), "--out", str(tmp_path / "out.json")])
    assert done.exit_code == 0, done.output
    assert f'view-left-out: {name} switched off (enabled="false") in rig.xml' in done.stderr
    assert f"{len(wedge_rig()) - 1} cameras" in done.stdout


def test_formats_of_several_files_are_told_from_those_of_one(tmp_path: Path) -> None:
    for kind in FORMATS:
        write_rig_file(wedge_rig(), tmp_path / kind, kind)
        assert (tmp_path / kind).is_dir() == (kind in FOLDER_FORMATS), kind


def test_a_board_is_written_as_pdf_alone(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["board", "--out", str(tmp_path / "b.xyz")])
    assert done.exit_code == 2
    assert "'.xyz' is nothing that a board is written as; give a .pdf" in " ".join(
        done.stderr.replace("│", " ").split()
    )
    assert list(tmp_path.iterdir()) == []
