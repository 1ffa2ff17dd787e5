"""Sessions and the operator's commands on the studio's devices, and the judgement of shots on planted frames."""

import dataclasses
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rig.acquisition.commands import COLUMNS, NoCalibration, capture, check, preview, take_board_shots, take_plates
from rig.acquisition.judgement import PlatesRefused
from rig.acquisition.plates import plates_versions, read_plates, write_plates
from rig.acquisition.session import RigSession
from rig.acquisition.shot import REMEDIES, WARNINGS, ShotFailed, Timing, certify
from rig.camera import Camera, Intrinsics
from rig.capture import Capture as CaptureValue
from rig.drivers.base import Frame
from rig.errors import InputError
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.pictures.images import read_image
from rig.formats.rig_toml import RigConfig, read_rig_config, rig_config_from_document
from rig.geometry import RigidTransform
from rig.rig import Rig
from rig.studio.devices.serve import DeviceFault, StudioDevices
from tests.support.textured_studio import NAMES, FlatStudio

THREE = NAMES[:3]


def flat_rig(names: tuple[str, ...] = THREE, width: int = 320, height: int = 240) -> Rig:
    lens = Intrinsics(width, height, 500.0, 500.0, (width - 1) / 2, (height - 1) / 2)
    return Rig(
        tuple(Camera(n, lens, RigidTransform(np.eye(3), np.array([40.0 * i, 0, 900]))) for i, n in enumerate(names))
    )


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StudioDevices]:
    folder = tmp_path_factory.mktemp("studio")
    write_rig(flat_rig(), folder / "cameras.json")
    with StudioDevices(
        folder, THREE, FlatStudio(False), FlatStudio(True), fps=10, takes=3, calibration="cameras.json"
    ) as devices:
        yield devices


@pytest.fixture
def config(studio: StudioDevices) -> RigConfig:
    """The studio with clean plates and a seated subject."""
    studio.clear()
    config = read_rig_config(studio.folder / "rig.toml")
    if not config.plates_folder.exists():
        studio.seat(False)
        take_plates(config)
    studio.seat(True)
    return config


def test_a_hung_camera_holds_up_one_look_and_no_other(studio: StudioDevices, config: RigConfig) -> None:
    """The first look at all of them waits for the hung camera, and the next four together take less."""
    with RigSession(config) as session:
        session.warm_up()
        studio.inject(DeviceFault("hung", "cam01"))
        assert set(session.look(["cam00"])) == {"cam00"}
        began_s = time.monotonic()
        assert set(session.look()) == {"cam00", "cam02"}
        held_s, began_s = time.monotonic() - began_s, time.monotonic()
        for _ in range(3):
            assert set(session.look()) == {"cam00", "cam02"}
        assert session.look(["cam01"]) == {}
        assert time.monotonic() - began_s < held_s
        studio.clear()
        until_s = time.monotonic() + 120
        while set(session.look()) != set(THREE):
            assert time.monotonic() < until_s


def test_capture_writes_a_folder_that_reads_back(config: RigConfig, tmp_path: Path) -> None:
    shot = capture(config, tmp_path / "out")
    read, rig = read_capture(tmp_path / "out")
    assert rig.names == THREE
    for name in THREE:
        assert np.array_equal(read.images[name], shot.images[name])
        assert len(read.backgrounds[name]) == config.shot.plates
    document = json.loads((tmp_path / "out" / "shot.json").read_text())
    assert document["format"] == "eigenhead-shot/1"
    assert document["faults"] == []
    assert all(isinstance(line["skew_ms"], float) for line in document["sync"]["cameras"].values())
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_capture_overwrites_nothing_and_needs_a_calibration_of_its_size(config: RigConfig, tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "file").touch()
    with pytest.raises(InputError, match="is there already"):
        capture(config, tmp_path / "kept")
    with pytest.raises(NoCalibration):
        capture(dataclasses.replace(config, calibration=None), tmp_path / "out")
    write_rig(flat_rig(width=640, height=480), tmp_path / "cameras.json")
    with pytest.raises(ShotFailed, match="size: the picture is 320 x 240, but the camera was calibrated at 640 x 480"):
        capture(dataclasses.replace(config, calibration=str(tmp_path / "cameras.json")), tmp_path / "out")


def test_a_failed_shot_names_all_and_writes_nothing(studio: StudioDevices, config: RigConfig, tmp_path: Path) -> None:
    studio.inject(DeviceFault("dark", "cam00"))
    studio.inject(DeviceFault("hung", "cam02"))
    with pytest.raises(ShotFailed, match=r"cam02: missing.*cam00: dark"):
        capture(config, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_check_has_a_row_for_every_camera(studio: StudioDevices, config: RigConfig) -> None:
    studio.inject(DeviceFault("bumped", "cam01"))
    found = check(config)
    assert found.healthy
    assert [row[0] for row in found.rows] == list(THREE)
    rows = {row[0]: dict(zip(COLUMNS, row, strict=True)) for row in found.rows}
    assert rows["cam00"]["found"] == "yes"
    assert rows["cam00"]["resolution"] == "320 x 240"
    # ten a second, of which a slow machine loses most
    assert 0 < float(rows["cam00"]["fps"]) < 15
    assert rows["cam00"]["sync"].endswith(" ms")
    assert rows["cam00"]["remark"] == "ok"
    assert rows["cam01"]["remark"].startswith("moved: the background lies")


def test_check_of_a_rig_that_is_not_there(tmp_path: Path) -> None:
    config = rig_config_from_document(
        {
            "format": "eigenhead-rig/1",
            "trigger": {"port": str(tmp_path / "no-box")},
            "shot": {"timeout_s": 0.3, "open_timeout_s": 1.0},
            "cameras": [{"name": "a", "driver": "opencv", "identity": "http://127.0.0.1:9/a.mjpeg", "channel": 0}],
        },
        tmp_path,
    )
    found = check(config)
    assert not found.healthy
    assert {fault.code for fault in found.faults} == {"trigger", "missing"}
    assert dict(zip(COLUMNS, found.rows[0], strict=True))["found"] == "no"


def test_preview_is_a_contact_sheet(studio: StudioDevices, config: RigConfig, tmp_path: Path) -> None:
    studio.inject(DeviceFault("dark", "cam02"))
    faults = preview(config, tmp_path / "sheet.jpg")
    assert {(fault.code, fault.camera) for fault in faults} == {("dark", "cam02")}
    sheet = read_image(tmp_path / "sheet.jpg")
    assert sheet.shape == (2 * 264, 2 * 320, 3)
    assert sheet[100:140, 100:220].mean() > 60  # cam00's tile
    assert sheet[364:404, 100:220].mean() < 10  # the dark camera's


def test_plates_of_a_dark_studio_are_refused_and_the_old_ones_stay(studio: StudioDevices, config: RigConfig) -> None:
    before = {path: path.read_bytes() for path in config.plates_folder.rglob("*.*")}
    studio.inject(DeviceFault("lights-off"))
    with pytest.raises(ShotFailed, match="lights-off"):
        take_plates(config)
    assert {path: path.read_bytes() for path in config.plates_folder.rglob("*.*")} == before


def test_plates_keep_their_noise(config: RigConfig) -> None:
    plates = read_plates(config.plates_folder, THREE)
    assert plates.taken is not None
    # noise of 2.0 and rounding, less what JPEG at quality 95 takes (measured: a tenth)
    for name in THREE:
        assert plates.noise[name] == pytest.approx(2.0, rel=0.15)


def test_somebody_in_the_plates_is_noticed(studio: StudioDevices, config: RigConfig, tmp_path: Path) -> None:
    changed = dataclasses.replace(config, plates=str(tmp_path / "plates"))
    with RigSession(changed) as session:
        session.warm_up()
        empty, seated = FlatStudio(False)("cam00", 0), FlatStudio(True)("cam00", 0)
        faults = session._plate_faults({"cam00": [empty, seated, empty], "cam01": [empty] * 2, "cam02": [empty] * 3})
    assert {(fault.code, fault.camera) for fault in faults} == {
        ("disturbed", "cam00"), ("missing", "cam01"), ("frozen", "cam02"),
    }  # fmt: skip


def test_who_holds_still_replaces_no_good_plates(studio: StudioDevices, config: RigConfig, tmp_path: Path) -> None:
    """They are kept as a version, for whoever knows that the studio itself changed."""
    shutil.copytree(config.plates_folder, tmp_path / "plates")
    changed = dataclasses.replace(config, plates=str(tmp_path / "plates"))
    before = {path: path.read_bytes() for path in changed.plates_folder.rglob("*.*")}
    studio.seat(True)
    with pytest.raises(PlatesRefused, match="occupied") as refused:
        take_plates(changed)
    assert {path: path.read_bytes() for path in changed.plates_folder.rglob("*.*")} == before
    newest = plates_versions(changed.plates_folder)[0]
    assert (newest.id, newest.in_use) == (refused.value.version, False)
    assert newest.refused


def test_plates_folder_of_a_capture_is_read(tmp_path: Path) -> None:
    image = FlatStudio(False)("cam00", 0)
    write_plates(tmp_path / "several", {"cam00": (image, image)})
    write_capture(tmp_path / "capture", CaptureValue({"cam00": image}, {"cam00": (image,)}), flat_rig(("cam00",)))
    for folder, count in ((tmp_path / "several", 2), (tmp_path / "capture" / "background", 1)):
        plates = read_plates(folder, ("cam00", "cam01"))
        assert len(plates.files["cam00"]) == count
        assert np.array_equal(plates.first["cam00"], image)
        assert "cam01" not in plates
    (tmp_path / "several" / "plates.json").write_text("[]")
    with pytest.raises(InputError, match="take new clean plates"):
        read_plates(tmp_path / "several", ("cam00",))


def test_a_recorded_capture_goes_through_the_session(config: RigConfig, tmp_path: Path) -> None:
    capture(config, tmp_path / "recorded")
    replayed = rig_config_from_document(
        {
            "format": "eigenhead-rig/1",
            "calibration": "recorded/cameras.json",
            "plates": "recorded/background",
            "cameras": [
                {"name": name, "driver": "replay", "identity": "recorded", "trigger": "free"} for name in THREE
            ],
        },
        tmp_path,
    )
    shot = capture(replayed, tmp_path / "again")
    assert [fault for fault in shot.faults if fault.is_error] == []
    first, _ = read_capture(tmp_path / "recorded")
    again, _ = read_capture(tmp_path / "again")
    assert all(np.array_equal(first.images[name], again.images[name]) for name in THREE)


def certificate_of(lags_s: list[float | None], period_s: float | None = 0.2):
    pixel = np.zeros((1, 1, 3), np.uint8)
    frames = {f"c{i}": None if lag is None else Frame(pixel, 10.0 + lag, i) for i, lag in enumerate(lags_s)}
    timings = {name: Timing(10.0, period_s) for name in frames}
    return certify(frames, timings, trigger_s=10.0, trigger_utc="", uncertainty_s=0.001, skew_most_s=0.02)


@pytest.mark.parametrize(
    ("lags_s", "expected"),
    [
        ([0.001, 0.002, 0.019], set()),
        ([0.001, 0.002, 0.05], {("late", "c2")}),
        ([0.001, 0.002, 0.2], {("dropped", "c2")}),
        ([0.1, 0.11, 0.105], {("late-trigger", None)}),
        ([0.1, 0.11, 0.105, 0.31], {("late-trigger", None), ("dropped", "c3")}),
        ([0.001, 0.002, None], set()),
    ],
)
def test_certificate_names_what_came_late(lags_s: list[float | None], expected: set[tuple[str, str | None]]) -> None:
    certificate, faults = certificate_of(lags_s)
    assert {(fault.code, fault.camera) for fault in faults} == expected
    for line, lag_s in zip(certificate.cameras, lags_s, strict=True):
        assert (line.status == "missing") == (lag_s is None)
        assert line.skew_s == (None if lag_s is None else pytest.approx(lag_s))
    known = [lag_s for lag_s in lags_s if lag_s is not None]
    assert certificate.spread_s == pytest.approx(max(known) - min(known))


def test_free_recorded_and_unsteady_cameras_are_late_at_most() -> None:
    pixel = np.zeros((1, 1, 3), np.uint8)
    frames: dict[str, Frame | None] = {name: Frame(pixel, 10.1, 1) for name in ("a", "b", "c", "d")}
    timings = {name: Timing(10.0, 0.1, triggered=False, recorded=name == "d") for name in frames}
    certificate, faults = certify(frames, timings, trigger_s=10.0, trigger_utc="", uncertainty_s=0.0, skew_most_s=0.05)
    assert {(fault.code, fault.camera) for fault in faults} == {("late", "a"), ("late", "b"), ("late", "c")}
    assert [line.status for line in certificate.cameras] == ["late", "late", "late", "recorded"]
    _, faults = certificate_of([0.001, 0.002, 0.5], period_s=None)
    assert [(fault.code, fault.camera) for fault in faults] == [("late", "c2")]


def test_every_warning_is_a_fault_that_is_explained() -> None:
    assert set(REMEDIES) > WARNINGS


def test_board_shots_need_no_calibration_nor_plates(studio: StudioDevices, config: RigConfig, tmp_path: Path) -> None:
    bare = dataclasses.replace(config, calibration=None, plates=str(tmp_path / "none"))
    studio.inject(DeviceFault("hung", "cam02"))
    taken = list(take_board_shots(bare, tmp_path / "board", 1, pause_s=0.0))
    studio.clear()
    taken += list(take_board_shots(bare, tmp_path / "board", 1, pause_s=0.0))
    assert [(name, cameras) for name, cameras, _ in taken] == [("shot000", THREE[:2]), ("shot001", THREE)]
    assert [[(f.code, f.camera) for f in faults] for _, _, faults in taken] == [[("missing", "cam02")], []]
    found = sorted(path.relative_to(tmp_path / "board").as_posix() for path in (tmp_path / "board").rglob("*.png"))
    assert found == ["cam00/shot000.png", "cam00/shot001.png", "cam01/shot000.png", "cam01/shot001.png",
                     "cam02/shot001.png"]  # fmt: skip


def test_board_shots_stop_where_nothing_fires(studio: StudioDevices, config: RigConfig, tmp_path: Path) -> None:
    studio.inject(DeviceFault("unplugged"))
    with pytest.raises(ShotFailed, match="trigger"):
        list(take_board_shots(config, tmp_path / "board", 3, pause_s=0.0))
    assert not (tmp_path / "board").exists()
