"""`eigenhead check`: every fault of a capture at once, and what outlines say, without a fit."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from rig.capture import Capture, reassign_images
from rig.errors import EigenheadError, InputError, WrongVariable
from rig.formats.cameras.cameras_file import write_rig_file
from rig.formats.captures.archive import pack_folder
from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.pictures.images import read_image, write_image
from rig.messages.message import texts_of
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from server.cli.check import checked, lines
from server.cli.reconstruct_local import reconstruct_locally
from server.tasks.settings_file import settings_document
from tests.server.cli.test_main import run
from tests.server.http.test_hostile import SPOILT
from tests.server.tasks.test_ingest import kept_of
from tests.support.services import small_capture
from tests.support.silhouette_subjects import dressed_head

Shot = tuple[Capture, Rig]


def found_in(capture: Path, **settings: object) -> dict[str, Any]:
    return checked(capture, settings, report=lambda stage, share: None)


@pytest.fixture(scope="module")
def masked(renderer: Renderer) -> Shot:
    """A bare head's masks at half size, and pictures that differ: noise."""
    rig, rng = default_layout().scaled(0.5), np.random.default_rng(2)
    vertices, faces, pose = dressed_head(load_model(), rig, rng, 60, bare=True)
    with renderer.silhouette_set(rig, faces) as drawn:
        masks = {name: mask > 0 for name, mask in drawn.masks(pose.apply(vertices)).items()}
    pictures = {name: rng.integers(0, 256, (*mask.shape, 3), dtype=np.uint8) for name, mask in masks.items()}
    return Capture(pictures, {}, masks), rig


def test_every_fault_is_told_at_once_and_is_status_2(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    for case in ("every camera at one place", "features of a third eye"):
        SPOILT[case][0](folder)
    (folder / "images" / "cam01.png").rename(folder / "images" / "foo.png")
    pack_folder(folder, tmp_path / "capture.tar")
    for capture in (folder, tmp_path / "capture.tar"):
        done = run("check", str(capture), "--json")
        assert (done.returncode, done.stderr) == (2, "")
        printed = json.loads(done.stdout)
        for word in ("at one place", "'third_eye'", "images/cam01.png is missing", "images/foo.png has no camera"):
            assert len([fault for fault in printed["faults"] if word in fault]) == 1
        assert printed["warnings"] == []  # of the picture that may be the missing one nothing is said twice
    done = run("check", str(folder))
    assert done.returncode == 2
    assert "cannot be reconstructed" in done.stdout.splitlines()[0]


@pytest.mark.gl
def test_a_good_capture_is_nothing_to_speak_of(masked: Shot, tmp_path: Path) -> None:
    write_capture(tmp_path / "good", *masked)
    done = run("check", str(tmp_path / "good"), "--json")
    assert done.returncode == 0
    printed = json.loads(done.stdout)
    assert (printed["faults"], printed["warnings"]) == ([], [])
    assert printed["cameras"] == list(masked[1].names)


@pytest.mark.gl
@pytest.mark.parametrize("name", ["cam03", "cam00", "cam09"])
@pytest.mark.parametrize(
    ("turn", "word"),
    [
        (lambda of: of[::-1, ::-1], "turned by 180 degrees"),
        (lambda of: of[:, ::-1], "flipped left to right"),
        (lambda of: of[::-1], "flipped upside down"),
    ],
)
def test_a_camera_whose_pictures_are_turned_is_named(
    masked: Shot, name: str, turn: Callable[[np.ndarray], np.ndarray], word: str, tmp_path: Path
) -> None:
    capture, rig = masked
    images, masks = ({**of, name: np.ascontiguousarray(turn(of[name]))} for of in (capture.images, capture.masks))
    write_capture(tmp_path / "shot", replace(capture, images=images, masks=masks), rig)
    said = [warning["message"] for warning in found_in(tmp_path / "shot")["warnings"] if name in warning["message"]]
    assert any(word in message for message in said), said


@pytest.mark.gl
def test_outlines_name_exchanged_pictures_as_a_warning_or_as_a_fault(masked: Shot, tmp_path: Path) -> None:
    capture, rig = masked
    write_capture(tmp_path / "shot", reassign_images(capture, pictures={"cam02": "cam07", "cam07": "cam02"}), rig)
    found = found_in(tmp_path / "shot")
    assert not found["faults"]
    assert [w for w in found["warnings"] if w["code"] == "cameras-exchanged" and "cam02 and cam07" in w["message"]]
    refused = found_in(tmp_path / "shot", exchanged_pictures="refuse")
    assert [fault for fault in refused["faults"] if "cam02 and cam07" in fault]


@pytest.mark.gl
def test_mirrored_pictures_are_refused_by_an_upload_in_the_same_words(masked: Shot, tmp_path: Path) -> None:
    capture, rig = masked
    kinds = capture.images, capture.masks
    images, masks = ({name: np.ascontiguousarray(p[:, ::-1]) for name, p in of.items()} for of in kinds)
    write_capture(tmp_path / "shot", replace(capture, images=images, masks=masks), rig)
    with pytest.raises(InputError) as refusal:
        kept_of(tmp_path / "shot", tmp_path)
    assert texts_of(refusal.value.faults) == found_in(tmp_path / "shot")["faults"] != []


HARMS = {
    "is damaged and cannot be decoded: send it again": lambda path: path.write_bytes(path.read_bytes()[:-60]),
    "is damaged or no PNG": lambda path: path.write_bytes(b"no picture"),
    "is black all over": lambda path: write_image(path, 0 * read_image(path)),
    "but its camera is": lambda path: write_image(path, read_image(path)[4:]),
    "is missing": Path.unlink,
    "is empty": lambda path: write_image(path.parents[1] / "masks" / path.name, 0 * read_image(path)),
}


@pytest.mark.gl
@pytest.mark.parametrize("words", HARMS)
def test_one_bad_picture_costs_a_view_and_is_named(masked: Shot, words: str, tmp_path: Path) -> None:
    """By check, upload and job alike; with ``--strict`` it costs the capture."""
    folder = tmp_path / "shot"
    write_capture(folder, *masked)
    HARMS[words](folder / "images" / "cam03.png")
    found = found_in(folder)
    (sentence,) = [warning["message"] for warning in found["warnings"] if warning["code"] == "picture-lost"]
    assert re.match(r"(images|masks)/cam03\.png:? ", sentence)
    assert words in sentence
    assert sentence.endswith("; correct that, or continue without cam03, which is left out")
    assert (found["faults"], len(found["cameras"])) == ([], len(masked[1]) - 1)
    content, kept = kept_of(folder, tmp_path)
    assert [warning["message"] for warning in found["warnings"]] == texts_of(content.warnings)
    for root in (folder, kept):  # as eigenhead reconstruct, a batch and the service's job read it
        capture, rig = read_capture(root)
        assert set(capture.images) == set(capture.masks) == set(rig.names) == set(masked[1].names) - {"cam03"}
        assert [remark.text for remark in capture.remarks if remark.code == "picture-lost"] == [sentence]
    strict = settings_document(None, strict=True)
    (fault,) = found_in(folder, **strict)["faults"]
    assert sentence in fault
    with pytest.raises(EigenheadError, match=re.escape(sentence)):
        reconstruct_locally(folder, tmp_path / "out", model=None, settings=strict, report=lambda stage, share: None)


def test_a_capture_of_too_few_good_pictures_is_refused(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "shot", cameras=6)
    for name in ("cam01", "cam04"):
        HARMS["is black all over"](folder / "images" / f"{name}.png")
    *faults, rest = found_in(folder)["faults"]
    assert [fault[:47] for fault in faults] == [f"images/cam0{n}.png: the picture is black all over" for n in (1, 4)]
    assert rest.startswith("4 of 6 cameras can be used, and 5 are needed: correct these faults, or remove cameras")


@pytest.mark.gl
def test_a_key_that_nobody_reads_is_a_warning(masked: Shot, tmp_path: Path) -> None:
    write_capture(tmp_path / "shot", *masked)
    path = tmp_path / "shot" / "cameras.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"units": "m"}))
    found = found_in(tmp_path / "shot")
    assert [warning["code"] for warning in found["warnings"]] == ["unknown-key"]
    assert "has no effect: cameras.json: the key 'units' is not read" in " ".join(lines(found))


@pytest.mark.gl
def test_unread_cameras_are_warnings_and_a_scale_is_read(masked: Shot, tmp_path: Path) -> None:
    capture, rig = masked
    folder = tmp_path / "shot"
    write_capture(folder, capture, rig)
    write_rig_file(rig, folder / "transforms.json", "nerfstudio")
    write_rig_file(rig, folder / "sparse" / "0", "colmap")
    (folder / "scale.json").write_text('{"cameras": ["cam00", "cam01"], "distance_mm": 714.557}')
    (folder / "images" / "cam00.xmp").write_text(
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"></x:xmpmeta>'
    )  # a raw developer's
    warnings = [(w["code"], re.split("(?<! no effect): ", w["message"])[0]) for w in found_in(folder)["warnings"]]
    names = ("sparse/0/cameras.bin", "transforms.json")
    unread = [("file-unread", f"a part of the folder has no effect: {name} is not read") for name in names]
    assert sorted(warnings) == sorted([*unread, ("cameras-scaled", "the cameras were scaled by 0.94")])
    (folder / "calibration.json").write_text("{}")  # which says that the scale was read, and found these cameras
    assert len(found_in(folder)["warnings"]) == 2


@pytest.mark.gl
def test_a_chart_that_no_plate_shows_is_a_warning_where_one_is_wanted(masked: Shot, tmp_path: Path) -> None:
    write_capture(tmp_path / "shot", *masked)
    assert not found_in(tmp_path / "shot")["warnings"]
    assert [w["code"] for w in found_in(tmp_path / "shot", texture={"chart": True})["warnings"]] == ["no-chart"]


def photographs(folder: Path) -> Path:
    """Those of a small capture, without its cameras."""
    (small_capture(folder) / "cameras.json").unlink()
    return folder


def test_damaged_photographs_without_cameras_are_all_named(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "photos")
    assert not found_in(folder)["faults"]
    (folder / "images" / "cam00.png").write_bytes(b"")
    HARMS["is damaged and cannot be decoded: send it again"](folder / "images" / "cam02.png")
    faults = found_in(folder)["faults"]
    assert [fault.split()[0] for fault in faults] == ["images/cam00.png:", "images/cam02.png:"]


def test_pictures_that_are_no_capture_say_what_to_do_with_them(tmp_path: Path) -> None:
    (photographs(tmp_path / "boards") / "board.toml").touch()
    assert "use eigenhead calibrate" in found_in(tmp_path / "boards")["faults"][0]
    assert "part of the capture anna" in found_in(small_capture(tmp_path / "anna") / "images")["faults"][0]


@pytest.mark.parametrize("kind", [small_capture, photographs])
def test_a_front_camera_that_nobody_knows_is_a_fault(kind: Callable[[Path], Path], tmp_path: Path) -> None:
    (fault,) = found_in(kind(tmp_path / "capture"), front="nosuch")["faults"]
    assert "'nosuch' is none of the capture's (cam00, cam01, cam02)" in fault


@pytest.mark.gl
def test_a_wrong_variable_is_no_capture_fault(masked: Shot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_capture(tmp_path / "shot", *masked)
    monkeypatch.setenv("EIGENHEAD_THREADS", "-4")
    with pytest.raises(WrongVariable, match="EIGENHEAD_THREADS: the variable is '-4'"):
        found_in(tmp_path / "shot")
