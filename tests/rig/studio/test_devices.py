"""The drawn studio served as devices: a scene of the simulated studio through streams, box, driver and session."""

import dataclasses
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rig.acquisition.commands import capture_with, check, take_plates
from rig.acquisition.session import RigSession
from rig.drivers.base import CameraNotFound, driver_for
from rig.formats.captures.capture_folder import read_capture
from rig.formats.meshes.ply import write_ply
from rig.formats.rig_toml import CameraConfig, read_rig_config
from rig.geometry import Similarity
from rig.render.renderer import Renderer
from rig.studio.devices.serve import DeviceFault, StudioDevices, serve_scene
from rig.studio.devices.sources import SceneImages
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import Scene, build_scene
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET
from tests.rig.studio.test_images import egg_head
from tests.support.frames import grab_frame

pytestmark = [pytest.mark.gl, pytest.mark.slow]


@pytest.fixture(scope="module")
def scene(renderer: Renderer) -> Scene:
    rig = default_layout().scaled(0.5)
    upright = Similarity(1.0, np.eye(3), np.zeros(3))
    rng = np.random.default_rng(4)
    bare = Subject(egg_head().mesh)
    return build_scene(bare, rig, PRESET, rng, renderer=renderer, world_from_head=upright)


@pytest.fixture(scope="module")
def studio(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Iterator[StudioDevices]:
    with serve_scene(tmp_path_factory.mktemp("studio"), scene) as devices:
        take_plates(read_rig_config(devices.folder / "rig.toml"))
        devices.seat(True)
        yield devices


def test_a_capture_of_the_drawn_studio_is_complete(studio: StudioDevices, scene: Scene, tmp_path: Path) -> None:
    studio.clear()
    with RigSession(read_rig_config(studio.folder / "rig.toml")) as session:
        session.warm_up()
        shot = capture_with(session, tmp_path / "out")
    assert shot.faults == ()
    read, rig = read_capture(tmp_path / "out")
    assert rig.names == scene.rig.names
    assert all(line.skew_s is not None for line in shot.certificate.cameras)
    for name in rig.names:
        # What differs from the clean plates is the subject, as the scene drew it.
        plate = np.mean([plate.astype(np.float32) for plate in read.backgrounds[name]], axis=0)
        differs = np.abs(read.images[name] - plate).max(axis=2) > 40
        mask = scene.views[name].mask
        assert differs[mask].mean() > 0.5
        assert differs[~mask].mean() < 0.01


def test_the_backdrops_of_the_drawn_studio_can_be_told_apart(studio: StudioDevices) -> None:
    studio.clear()
    studio.inject(DeviceFault("swapped", "cam03"))
    studio.inject(DeviceFault("bumped", "cam07"))
    found = check(read_rig_config(studio.folder / "rig.toml"))
    assert {(fault.code, fault.camera) for fault in found.faults} == {
        ("swapped", "cam03"), ("swapped", "cam04"), ("moved", "cam07"),
    }  # fmt: skip


def test_pictures_of_a_scene_have_noise_of_their_own_and_drifted_light(scene: Scene) -> None:
    source = SceneImages(scene, seated=False)
    one, two = source("cam01", 0.0).astype(np.float32), source("cam01", 1.0).astype(np.float32)
    # 1.5 % of full scale, 3.8, at mid grey; the backdrop is darker and lighter in places
    assert 2.0 < (one - two).std() / np.sqrt(2) < 5.5
    seated = SceneImages(scene, seated=True)("cam01", 0.0).astype(np.float32)
    outside = ~scene.views["cam01"].mask
    assert 0.0 < abs((seated - one)[outside].mean()) < 20.0


def test_simulated_driver_photographs_a_mesh_file(tmp_path: Path) -> None:
    mesh = egg_head().mesh
    nothing = np.zeros(len(mesh.vertices))
    grey, views = np.full((len(nothing), 3), 150, np.uint8), nothing.astype(np.uint8)
    write_ply(tmp_path / "egg.ply", mesh, normals=mesh.normals(), colours=grey, quality=nothing, views=views)
    camera = dataclasses.replace(
        CameraConfig(name="cam05", driver="opencv", identity="egg.ply", trigger="free"), driver="simulated"
    )
    driver = driver_for(camera, tmp_path)
    with closing(driver):
        driver.open(60.0)
        image = grab_frame(driver, 5.0).image
    assert image.shape == (768, 1024, 3)
    nowhere = driver_for(dataclasses.replace(camera, identity="egg.ply#cam77"), tmp_path)
    with pytest.raises(CameraNotFound, match="the studio has cam00"):
        nowhere.open(60.0)
