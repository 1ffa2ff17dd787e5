"""Faults of captures that the door names without a service around it."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.faces.networks import DamagedNetwork
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.cameras.cameras_file import write_rig_file
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.captures.archive import ArchiveLimits, pack_folder
from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.captures.features_json import FEATURES_FORMAT
from rig.formats.pictures.images import read_image, write_image
from rig.messages.message import texts_of
from server.cli.check import checked as checked_by_command
from server.storage.records import CaptureContent
from server.tasks import ingest
from server.tasks.child import WorkerContext
from server.tasks.ingest import check_capture, ingest_archive, ingest_folder
from tests.rig.acquisition.test_session import flat_rig
from tests.support.services import small_capture
from tests.support.textured_studio import NAMES, FlatStudio

PIXELS_MOST = 100_000_000


def checked(folder: Path) -> CaptureContent:
    return check_capture(folder, PIXELS_MOST, lambda stage, share: None)


def test_feature_points_are_part_of_what_an_upload_holds(tmp_path: Path) -> None:
    """A job reads the files that the content names, and no others."""
    folder = small_capture(tmp_path / "capture")
    capture, rig = read_capture(folder)
    places_mm = {"pronasale": (0.0, 0.0, 90.0), "gnathion": (0.0, -60.0, 70.0), "nasion": (20.0, 40.0, 80.0)}
    points = {name: {c.name: c.project(np.array([at]))[0].tolist() for c in rig} for name, at in places_mm.items()}
    (folder / "features.json").write_text(json.dumps({"format": FEATURES_FORMAT, "points": points}))
    assert not capture.features
    kept = hashlib.sha256((folder / "features.json").read_bytes()).hexdigest()
    assert checked(folder).inputs["features.json"] == kept


def test_an_upload_is_judged_as_a_shot_is(tmp_path: Path) -> None:
    """One camera of eleven stands 8.5 px from where its clean plate was taken."""
    empty, seated = FlatStudio(False), FlatStudio(True)
    images = {name: seated(name, 0.0) for name in NAMES}
    images["cam03"] = np.roll(images["cam03"], (8, 3), axis=(1, 0))
    write_capture(tmp_path, Capture(images, {name: (empty(name, 0.0),) for name in NAMES}), flat_rig(NAMES))
    found = checked(tmp_path)
    assert [(fault.code, fault.camera) for fault in found.faults] == [("moved", "cam03")]
    assert "calibrate again" in found.faults[0].remedy.text
    assert found.checks["cam03"].get("background_moved_px") == pytest.approx(8.5, abs=0.3)
    outlined = {name for name, view in found.checks.items() if (view.get("subject") or {}).get("outline")}
    assert outlined >= set(NAMES) - {"cam03"}
    measured = check_capture(tmp_path, PIXELS_MOST, lambda stage, share: None, measured=True)
    assert {(fault.code, fault.camera) for fault in measured.faults} <= {("empty", "cam03")}, "the shot has the others"
    assert all(view.keys() == {"subject"} for view in measured.checks.values())


def test_damaged_networks_keep_no_capture_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged() -> None:
        raise DamagedNetwork(tmp_path, "it is another file")

    monkeypatch.setattr(ingest, "load_networks", damaged)
    folder = small_capture(tmp_path / "capture")
    content = ingest_folder(WorkerContext(), lambda stage, share: None, folder=str(folder), image_pixels=PIXELS_MOST)
    assert content.face is None


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        ("colmap", "sparse/0"),
        ("colmap-text", "."),
        ("caliscope", "camera_array.toml"),
        ("realitycapture", "images"),
        ("nerfstudio", "transforms.json"),
        ("opencv-yaml", "."),
    ],
)
def test_an_upload_keeps_every_file_of_another_programs_cameras(tmp_path: Path, kind: str, place: str) -> None:
    folder = small_capture(tmp_path / "capture")
    rig = read_rig(folder / "cameras.json")
    write_rig_file(rig, folder / place, kind)
    (folder / "cameras.json").unlink()
    _, read = read_capture(kept_of(folder, tmp_path)[1])  # as a job reads it
    assert sorted(read.names) == sorted(rig.names)


def kept_of(folder: Path, tmp_path: Path) -> tuple[CaptureContent, Path]:
    """What an upload of ``folder`` leaves."""
    pack_folder(folder, tmp_path / "capture.tar")
    kept = tmp_path / "kept"
    kept.mkdir()
    archive = {"archive": str(tmp_path / "capture.tar"), "folder": str(kept), "limits": ArchiveLimits()}
    return ingest_archive(WorkerContext(), lambda stage, share: None, **archive, image_pixels=PIXELS_MOST), kept


def test_an_upload_is_kept_under_its_cameras_names(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    (folder / "background").rename(folder / "plates")
    (folder / "background").mkdir()
    (folder / "masks").mkdir()
    mask = np.zeros((24, 24), np.uint8)
    mask[6:20, 6:20] = 255
    for path in sorted((folder / "images").iterdir()):
        write_image(folder / "masks" / f"{path.stem}.png.png", mask)
        write_image(folder / "images" / f"shot.0001.{path.stem}.BMP", read_image(path))
        write_image(folder / "texture_sets" / "cross" / f"shot_{path.stem}.png", read_image(path))
        for number in (1, 2):
            shutil.copy(folder / "plates" / path.name, folder / "background" / f"{path.stem}_{number}.png")
        path.unlink()
    shutil.rmtree(folder / "plates")
    content, kept = kept_of(folder, tmp_path)
    wanted = {"cameras.json"}
    for name in ("cam00", "cam01", "cam02"):
        wanted |= {f"images/{name}.bmp", f"masks/{name}.png", f"texture_sets/cross/{name}.png"}
        wanted |= {f"background/{name}/{name}_{number}.png" for number in (1, 2)}
    assert {*content.inputs} == wanted
    assert {path.relative_to(kept).as_posix() for path in kept.rglob("*") if path.is_file()} == wanted
    capture, _ = read_capture(kept)
    assert {len(plates) for plates in capture.backgrounds.values()} == {2}
    assert set(capture.texture_sets["cross"]) == {"cam00", "cam01", "cam02"}


def test_texture_sets_of_an_upload_are_checked_before_they_are_decoded(tmp_path: Path) -> None:
    """A small file may claim any size, and a set with a fault is no reason to pass over the others."""
    folder = small_capture(tmp_path / "capture")
    for path in sorted((folder / "images").iterdir()):
        write_image(folder / "texture_sets" / "cross" / path.name, read_image(path))
    write_image(folder / "texture_sets" / "cross" / "cam01.png", np.zeros((400, 400, 3), np.uint8))
    write_image(folder / "texture_sets" / "cross" / "cam77.png", np.zeros((24, 24, 3), np.uint8))
    (folder / "texture_sets" / "cross" / "cam02.png").unlink()
    with pytest.raises(InputError) as refusal:
        check_capture(folder, 100_000, lambda stage, share: None)
    said = texts_of(refusal.value.faults)
    assert len(said) == 3
    for word in ("cross/cam01.png is 400 x 400", "cam77.png has no camera", "cross/ lacks the picture of cam02"):
        assert any(word in sentence for sentence in said)


def test_an_upload_with_cameras_switched_off_is_taken_without_their_files(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture", cameras=5)
    write_rig_file(read_rig(folder / "cameras.json"), folder / "cameras.xml", "metashape")
    (folder / "cameras.json").unlink()
    text = (folder / "cameras.xml").read_text()
    (folder / "cameras.xml").write_text(text.replace('label="cam01">', 'label="cam01" enabled="false">'))
    content, kept = kept_of(folder, tmp_path)
    assert [camera.name for camera in content.cameras] == ["cam00", "cam02", "cam03", "cam04"]
    assert not [*kept.rglob("cam01.png")]
    (remark,) = read_capture(kept)[0].remarks
    assert remark.code == "view-left-out"


def test_what_is_missing_everywhere_is_one_fault(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture", cameras=12)
    shutil.rmtree(folder / "images")
    (folder / "images").mkdir()
    with pytest.raises(InputError) as refused:
        checked(folder)
    (fault,) = refused.value.faults
    assert fault.text.startswith("images/cam00.png is missing")
    assert "the same is true of 11 more (" in fault.text


def test_an_upload_is_told_what_check_tells(tmp_path: Path) -> None:
    """Of noise no outline is usable: the photographs are kept, with the words of the command."""
    folder = small_capture(tmp_path / "capture")
    shutil.rmtree(folder / "background")  # beside plates the noise is an empty seat
    shutil.copytree(folder / "images", folder / "depth")
    (folder / "images" / "foo.png").write_bytes((folder / "images" / "cam00.png").read_bytes())
    content, kept = kept_of(folder, tmp_path)
    said = {warning.code: warning.text for warning in content.warnings}
    assert said["pose-doubtful"].partition(": ")[2] in checked_by_command(folder, {}, report=lambda *_: None)["faults"]
    assert {"images/foo.png", "depth/"} <= {w.text.split()[8] for w in content.warnings if w.code == "file-unread"}
    assert not (kept / "images" / "foo.png").exists()
