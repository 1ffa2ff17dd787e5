"""The rig behind the service, in this process: what it refuses, and a shot of the studio's streams."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.acquisition.commands import take_plates
from rig.acquisition.session import RigSession
from rig.drivers.base import Driver, driver_for
from rig.errors import InputError
from rig.formats.cameras.cameras_json import read_rig, write_rig
from rig.formats.captures.capture_folder import read_capture
from rig.formats.rig_toml import CameraConfig, read_rig_config
from rig.messages.message import texts_of
from rig.studio.devices.serve import DeviceFault, StudioDevices
from rig.studio.scene.layout import default_layout
from server.errors import Conflict, NotFound, Unavailable
from server.services.rigs import RealRig, SimulatedRig, encode_jpeg, reduced
from server.services.service import open_rig
from server.settings import ServiceSettings
from tests.rig.acquisition.test_session import flat_rig
from tests.support.textured_studio import NAMES, FlatStudio


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StudioDevices]:
    """Eleven streams and a box, with clean plates, and no calibration."""
    folder = tmp_path_factory.mktemp("studio")
    with StudioDevices(folder, NAMES, FlatStudio(False), FlatStudio(True)) as devices:
        take_plates(read_rig_config(folder / "rig.toml"))
        devices.seat(True)
        yield devices


@pytest.fixture
def rig(studio: StudioDevices, tmp_path: Path) -> Iterator[RealRig]:
    opened = RealRig(studio.folder / "rig.toml", tmp_path / "rig" / "cameras.json")
    yield opened
    opened.close()


def test_without_a_calibration_no_head_is_shot_but_the_board_is(rig: RealRig, tmp_path: Path) -> None:
    state = rig.describe()
    assert (state.ready, state.calibration) == (False, None)
    assert {camera.state for camera in state.cameras} == {"closed"}
    with pytest.raises(Unavailable, match="no calibration"):
        rig.capture(tmp_path / "head", seed=None)
    with pytest.raises(InputError, match="seed"):
        rig.capture(tmp_path / "head", seed=1)
    with pytest.raises(NotFound, match="cam99"):
        rig.preview("cam99")
    assert not (tmp_path / "head").exists()
    rig.capture(tmp_path / "board", seed=None, board=True)
    assert {path.stem for path in (tmp_path / "board/files/images").iterdir()} == set(NAMES)
    assert {camera.state for camera in rig.describe().cameras} == {"open"}


def test_a_calibration_in_use_goes_into_the_next_capture(rig: RealRig, studio: StudioDevices, tmp_path: Path) -> None:
    write_rig(flat_rig(NAMES[:-1]), tmp_path / "fewer.json")
    with pytest.raises(Conflict) as refused:
        rig.use(tmp_path / "fewer.json")
    assert texts_of(refused.value.errors) == [f"{NAMES[-1]}: only in one of the two"]
    write_rig(flat_rig(NAMES), tmp_path / "cameras.json")
    rig.use(tmp_path / "cameras.json")
    rig.capture(tmp_path / "shot", seed=None)
    assert (rig.describe().ready, rig.describe().calibration) == (True, "own")
    capture, used = read_capture(tmp_path / "shot" / "files")
    assert used.names == NAMES
    np.testing.assert_allclose(used.centre_world(), flat_rig(NAMES).centre_world(), atol=1e-6)
    assert {len(plates) for plates in capture.backgrounds.values()} == {5}
    studio.inject(DeviceFault("hung", "cam02"))
    try:
        with pytest.raises(Unavailable, match="cam02"):
            rig.capture(tmp_path / "spoilt", seed=None)
    finally:
        studio.clear()
    assert not (tmp_path / "spoilt").exists()


def test_the_simulated_rig_takes_a_calibration_of_its_own_cameras(tmp_path: Path) -> None:
    rig = open_rig(ServiceSettings(data=tmp_path))
    assert isinstance(rig, SimulatedRig)
    assert (rig.describe().ready, rig.describe().calibration) == (True, "studio")
    write_rig(default_layout().subset(("cam00", "cam01", "cam02")), tmp_path / "three.json")
    with pytest.raises(Conflict, match="other cameras"):
        rig.use(tmp_path / "three.json")
    write_rig(default_layout().scaled(0.5), tmp_path / "half.json")
    rig.use(tmp_path / "half.json")
    assert rig.describe().calibration == "own"
    assert read_rig(tmp_path / "rig" / "cameras.json")["cam00"].intrinsics.width == 512
    with pytest.raises(NotFound, match="cam99"):
        rig.preview("cam99")


def test_lamps_are_set_and_kept(studio: StudioDevices, rig: RealRig, tmp_path: Path) -> None:
    def brightness() -> float:
        return float(np.mean(rig.look()["cam00"]))

    assert rig.lights() == (0, 1)
    both = brightness()
    assert rig.set_lights((1,)) == (1,)
    assert brightness() > 0.8 * both, "the studio is lit by any lamp"
    assert studio.box is not None
    assert studio.box.logic.lights == 0b10
    assert rig.set_lights(()) == ()
    assert brightness() < 0.5 * both
    again = RealRig(studio.folder / "rig.toml", tmp_path / "rig" / "cameras.json")
    assert again.lights() == ()
    with pytest.raises(InputError, match="7 is not an output"):
        rig.set_lights((7,))
    rig.set_lights((0, 1))
    assert brightness() > 0.8 * both


def test_settings_reach_the_driver_and_are_kept(
    studio: StudioDevices, rig: RealRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The studio's streams say what network cameras say, that HTTP cannot set them; what any driver is told, is seen
    where drivers are made."""
    configured: dict[str, CameraConfig] = {}

    def noting(camera: CameraConfig, folder: Path) -> Driver:
        configured[camera.name] = camera
        return driver_for(camera, folder)

    monkeypatch.setattr("server.services.rigs.RigSession", lambda config: RigSession(config, noting))
    rig.look()
    assert configured["cam03"].exposure_ms is None
    changed = rig.set_camera("cam03", {"exposure_ms": 8.0, "gain_db": 3.0})
    assert (configured["cam03"].exposure_ms, configured["cam03"].gain_db) == (8.0, 3.0)
    assert configured["cam04"].exposure_ms is None
    assert (changed.exposure_ms, changed.gain_db, changed.white_balance_k) == (8.0, 3.0, None)
    assert [line.text.split()[0] for line in changed.unmet] == ["exposure_ms", "gain_db"]
    again = RealRig(studio.folder / "rig.toml", tmp_path / "rig" / "cameras.json")
    assert again.camera_settings("cam03").exposure_ms == 8.0
    assert rig.set_camera("cam03", {"exposure_ms": None}).exposure_ms is None
    assert (configured["cam03"].exposure_ms, configured["cam03"].gain_db) == (None, 3.0)
    with pytest.raises(InputError, match="exposure_ms: -1"):
        rig.set_camera("cam03", {"exposure_ms": -1.0})
    with pytest.raises(NotFound, match="cam99"):
        rig.set_camera("cam99", {})
    (tmp_path / "rig" / "adjusted.json").write_text("{")
    again = RealRig(studio.folder / "rig.toml", tmp_path / "rig" / "cameras.json")
    assert again.camera_settings("cam03").gain_db is None


def test_the_simulated_studio_has_no_settings(tmp_path: Path) -> None:
    rig = open_rig(ServiceSettings(data=tmp_path))
    assert (rig.lights(), rig.camera_settings("cam00").unmet) == ((), ())
    for change in (lambda: rig.set_lights((0,)), lambda: rig.set_camera("cam00", {"gain_db": 1.0})):
        with pytest.raises(Conflict, match="no settings"):
            change()
    with pytest.raises(NotFound, match="cam99"):
        rig.set_camera("cam99", {})


@pytest.mark.parametrize(
    ("width", "height", "expected"), [(1280, 960, (480, 640)), (320, 240, (240, 320)), (900, 1, (1, 640))]
)
def test_a_preview_is_no_wider_than_a_page_needs(width: int, height: int, expected: tuple[int, int]) -> None:
    image = np.full((height, width, 3), (200, 30, 10), np.uint8)
    assert reduced(image, 640).shape[:2] == expected
    shown = cv2.imdecode(np.frombuffer(encode_jpeg(image), np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape[:2] == expected
    assert np.abs(shown[:, :, ::-1].astype(int) - (200, 30, 10)).max() < 8  # red stays red
