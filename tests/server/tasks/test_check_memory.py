"""What one check may take: memory, whose end is a sentence, and the pixels of a camera."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.captures.capture_folder import write_capture
from rig.geometry import RigidTransform
from rig.rig import Rig
from server.tasks.child import Child, WorkFailed
from server.tasks.ingest import check_capture, ingest_folder
from tests.support.services import small_capture

SIZE = 3000


def flat_capture(folder: Path) -> Path:
    """Pictures of 9 Mpx that take little room on the disk."""
    k = Intrinsics(SIZE, SIZE, SIZE, SIZE, SIZE / 2, SIZE / 2)
    poses = [RigidTransform(np.eye(3), np.array([40.0 * i, 0.0, 1000.0])) for i in range(3)]
    rig = Rig(tuple(Camera(f"cam{i:02}", k, pose) for i, pose in enumerate(poses)))
    image = np.full((SIZE, SIZE, 3), 90, np.uint8)
    write_capture(folder, Capture({name: image for name in rig.names}, {name: (image,) for name in rig.names}), rig)
    return folder


def test_a_check_beyond_its_memory_fails_with_a_sentence(tmp_path: Path) -> None:
    folder = str(flat_capture(tmp_path / "capture"))
    with closing(Child(memory=500 << 20)) as child, pytest.raises(WorkFailed) as failure:
        child.remote(ingest_folder)(folder=folder, image_pixels=SIZE**2)
    assert failure.value.kind == "out-of-memory"


def test_the_pixels_of_a_camera_are_bounded_together(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    add_plates(folder, 20)
    with pytest.raises(InputError, match="cam00 have 12,096 pixels together"):
        check_capture(folder, 24 * 24, lambda stage, share: None)


def test_every_plate_is_read_though_one_by_one(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    add_plates(folder, 4)
    found = check_capture(folder, 24 * 24, lambda stage, share: None)
    assert sum(name.startswith("background/cam00/") for name in found.inputs) == 4
    (folder / "background" / "cam00" / "3.png").write_bytes(b"\x89PNG, and no more")
    with pytest.raises(InputError, match=r"3\.png"):
        check_capture(folder, 24 * 24, lambda stage, share: None)


def add_plates(folder: Path, count: int) -> None:
    """Gives cam00 ``count`` clean plates in place of its one."""
    (plate,) = (folder / "background").rglob("cam00*.*")
    plate = plate if plate.is_file() else next(plate.iterdir())
    data = plate.read_bytes()
    plate.unlink()
    (folder / "background" / "cam00").mkdir(exist_ok=True)
    for number in range(count):
        (folder / "background" / "cam00" / f"{number}.png").write_bytes(data)
