"""Pictures of a capture folder: formats, alpha, sizes, pages, numbers, lenses."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from rig.errors import InputError
from rig.formats.captures.capture_folder import read_capture, size_fault, write_capture
from rig.formats.pictures.images import cut_out_alpha, read_image, write_image
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from tests.support.small_captures import HEIGHT, WIDTH, picture, small_capture, small_rig


def test_an_exif_turn_is_not_obeyed(folder: Path) -> None:
    """The calibration holds for the sensor's rows and columns."""
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate by 90 degrees to look at
    (folder / "images" / "a.png").unlink()
    Image.fromarray(picture()).save(folder / "images" / "a.jpg", exif=exif)
    capture, _ = read_capture(folder)
    assert capture.images["a"].shape == (HEIGHT, WIDTH, 3)


def cut_out(path: Path) -> None:
    """The picture with an alpha whose subject is its middle."""
    rgb = cv2.imread(str(path))
    assert rgb is not None
    alpha = np.zeros(rgb.shape[:2], np.uint8)
    alpha[rgb.shape[0] // 4 :, rgb.shape[1] // 4 : -rgb.shape[1] // 4] = 255
    cv2.imwrite(str(path), np.dstack([rgb, alpha]))


def test_the_alpha_of_cut_outs_is_their_mask_where_there_is_no_other(folder: Path) -> None:
    plates = folder / "background"
    pictures = sorted((folder / "images").glob("*.png"))
    for path in pictures:
        cut_out(path)
    with_plates, _ = read_capture(folder)
    assert with_plates.masks.keys() == {"c"}
    shutil.rmtree(plates)
    shutil.rmtree(folder / "masks", ignore_errors=True)
    capture, rig = read_capture(folder)
    assert [remark.code for remark in capture.remarks] == ["masks-of-alpha"]
    assert capture.masks.keys() == set(rig.names)
    assert capture.masks[rig.names[0]][-1].any()
    assert not capture.masks[rig.names[0]][0].any()
    write_image(pictures[0], read_image(pictures[0]))
    assert dict(read_capture(folder)[0].masks) == {}


@pytest.mark.parametrize("shape", ["rounded corners", "noise", "rim", "one of them"])
def test_an_alpha_that_is_no_cut_out_is_no_mask_and_no_fault(folder: Path, shape: str) -> None:
    shutil.rmtree(folder / "background")
    shutil.rmtree(folder / "masks", ignore_errors=True)
    for path in sorted((folder / "images").glob("*.png")):
        rgb = cv2.imread(str(path))
        assert rgb is not None
        alpha = np.full(rgb.shape[:2], 255, np.uint8)
        if shape == "rounded corners":
            alpha[:2, :2] = alpha[-2:, -2:] = 0
        elif shape == "noise":
            alpha[::2, ::3] = 254
        elif shape == "rim":
            alpha[0] = alpha[-1] = alpha[:, 0] = alpha[:, -1] = 0
        cv2.imwrite(str(path), np.dstack([rgb, alpha]))
    if shape == "one of them":
        cut_out(sorted((folder / "images").glob("*.png"))[0])
    capture, rig = read_capture(folder)
    assert dict(capture.masks) == {}
    assert capture.remarks == ()
    assert capture.images.keys() == set(rig.names)


def test_an_alpha_is_not_decoded_where_the_header_says_too_much(tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    cv2.imwrite(str(path), np.zeros((8, 8, 4), np.uint8))
    data = bytearray(path.read_bytes())
    data[16:24] = (60000).to_bytes(4, "big") * 2
    path.write_bytes(data)
    assert cut_out_alpha(path) is None


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        ({"width": HEIGHT, "height": WIDTH}, "exchange the camera's width and height"),  # of cx 31.5, cy 23.5
        ({"width": HEIGHT, "height": WIDTH, "cx": 23.5, "cy": 31.5}, "turned by 90 degrees; turn it back"),
        ({"width": 2 * WIDTH, "height": 2 * HEIGHT}, "use pictures of the calibrated size"),
        ({"width": WIDTH + 9}, f"its camera is {WIDTH + 9} x {HEIGHT}"),
    ],
)
def test_a_picture_of_another_size_is_told_with_its_remedy(change: dict[str, float], remedy: str) -> None:
    fault = size_fault("images/a.png", (WIDTH, HEIGHT), replace(small_rig()["a"].intrinsics, **change))
    assert fault.text.startswith(f"images/a.png is {WIDTH} x {HEIGHT} pixels")
    assert remedy in fault.text


def test_a_picture_too_large_is_refused_before_it_is_decoded(folder: Path) -> None:
    import struct
    import zlib

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (folder / "images" / "a.png").write_bytes(bomb)
    with pytest.raises(InputError, match=r"images/a\.png: the (picture has 60000 x 60000 pixels|file is damaged)"):
        read_capture(folder)


def test_pictures_and_points_of_a_fisheye_come_undistorted(tmp_path: Path) -> None:
    lens = RecordedLens("kannala-brandt", (-0.8, 0.0, 0.0, 0.0))  # of no real lens: to be seen in 64 pixels
    rig = Rig(tuple(replace(camera, recorded=lens) for camera in small_rig()))
    matrix, wanted = rig["a"].intrinsics.matrix(), np.array([[52.0, 12.0]])
    at = lens.distorted(wanted, matrix)[0]
    assert np.linalg.norm(at - wanted[0]) > 0.5
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    ramp = np.stack([3 * columns, 4 * rows, 0 * rows], axis=2).astype(np.uint8)  # each pixel tells its place
    filed = replace(small_capture(), features={"pronasale": {"a": at, "b": at}})
    write_capture(tmp_path, replace(filed, images=dict.fromkeys("abc", ramp)), rig)
    capture, back = read_capture(tmp_path)
    assert back["a"].recorded == lens
    assert back["a"].intrinsics.distortion.is_zero
    pixels = np.stack([columns, rows], axis=2)[4:-4, 4:-4].reshape(-1, 2).astype(float)
    encoded = capture.images["a"][4:-4, 4:-4, :2].reshape(-1, 2) / (3.0, 4.0)
    np.testing.assert_allclose(
        encoded, lens.distorted(pixels, matrix), atol=0.25
    )  # half a level, and the way of reading
    np.testing.assert_allclose(capture.features["pronasale"]["a"], wanted[0], atol=1e-6)
    assert capture.masks["c"].dtype == bool


@pytest.mark.parametrize("thumbnail", [False, True])
def test_files_of_several_pictures_are_told_and_a_thumbnail_before_them_is_named(folder: Path, thumbnail: bool) -> None:
    whole = Image.fromarray(read_image(folder / "images" / "a.png"))
    pages = [whole.resize((16, 12)), whole] if thumbnail else [whole, whole]
    (folder / "images" / "a.png").unlink()
    pages[0].save(folder / "images" / "a.tif", save_all=True, append_images=pages[1:])
    if thumbnail:
        with pytest.raises(InputError, match=r"16 x 12 pixels.*the file holds 2 pictures, and the first is read"):
            read_capture(folder)
        return
    capture, _ = read_capture(folder)
    assert any("images/a.tif holds several pictures, and the first is read" in r.text for r in capture.remarks)
    np.testing.assert_array_equal(capture.images["a"], np.asarray(whole))


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (HEIGHT, WIDTH, 3)])
def test_pictures_of_floating_point_are_not_damaged(folder: Path, shape: tuple[int, ...]) -> None:
    (folder / "images" / "a.png").unlink()
    (folder / "images" / "a.tif").write_bytes(cv2.imencode(".tif", np.full(shape, 0.5, np.float32))[1].tobytes())
    with pytest.raises(InputError, match=r"a\.tif: the picture holds floating-point numbers: save it in 8 or 16 bits"):
        read_capture(folder)
