"""Capture folders: what is written is read back; every layout of docs/capture-format.md; every fault named at once."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.captures.capture_folder import capture_root, read_capture, size_fault, write_capture
from rig.formats.captures.features_json import features_from_bytes
from rig.formats.pictures.images import cut_out_alpha, read_image, write_image
from rig.geometry import look_at
from rig.messages.message import Message, texts_of
from rig.recorded_lens import RecordedLens
from rig.rig import Rig
from tests.support.shared_data import shared

RNG = np.random.default_rng(0)
HEIGHT, WIDTH = 48, 64


def small_rig() -> Rig:
    intrinsics = Intrinsics(WIDTH, HEIGHT, 90.0, 90.0, 31.5, 23.5)
    places = ([-300.0, 0.0, 900.0], [0.0, 0.0, 1000.0], [300.0, 0.0, 900.0])
    up = np.array([0.0, 1.0, 0.0])
    return Rig(
        tuple(Camera(n, intrinsics, look_at(np.array(p), np.zeros(3), up)) for n, p in zip("abc", places, strict=True))
    )


def picture() -> np.ndarray:
    return RNG.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def small_capture() -> Capture:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[10:40, 20:50] = True
    return Capture(
        images={name: picture() for name in "abc"},
        backgrounds={"a": (picture(),), "b": (picture(), picture())},
        masks={"c": mask},
        features={"pronasale": {"a": np.array([31.25, 20.5]), "b": np.array([-0.5, 47.5])}},
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_capture(tmp_path / "shot", small_capture(), small_rig())
    return tmp_path / "shot"


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    capture = small_capture()
    write_capture(tmp_path, capture, small_rig())
    again, rig = read_capture(tmp_path)
    assert rig.names == ("a", "b", "c")
    for name in "abc":
        np.testing.assert_array_equal(again.images[name], capture.images[name])
        assert not again.images[name].flags.writeable
    assert {name: len(plates) for name, plates in again.backgrounds.items()} == {"a": 1, "b": 2}
    np.testing.assert_array_equal(again.backgrounds["b"][1], capture.backgrounds["b"][1])
    np.testing.assert_array_equal(again.masks["c"], capture.masks["c"])
    np.testing.assert_array_equal(again.features["pronasale"]["b"], [-0.5, 47.5])
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert set(again.digests) == files
    assert list(again.digests) == sorted(again.digests)


def test_images_are_rgb(tmp_path: Path) -> None:
    red = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    red[..., 0] = 255
    write_image(tmp_path / "red.png", red)
    np.testing.assert_array_equal(read_image(tmp_path / "red.png"), red)
    stored = np.asarray(cv2.imread(str(tmp_path / "red.png")))
    assert stored[0, 0].tolist() == [0, 0, 255]  # OpenCV's order is the other one


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".tif", ".webp"])
def test_other_formats_are_read(folder: Path, suffix: str) -> None:
    grey = np.full((HEIGHT, WIDTH, 3), 117, np.uint8)
    (folder / "images" / "a.png").unlink()
    cv2.imwrite(str(folder / "images" / f"a{suffix}"), grey)
    capture, _ = read_capture(folder)
    assert np.abs(capture.images["a"].astype(int) - 117).max() <= 2


def test_an_exif_turn_is_not_obeyed(folder: Path) -> None:
    """The calibration holds for the sensor's rows and columns."""
    from PIL import Image

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


def test_one_enclosing_folder(folder: Path) -> None:
    (folder.parent / "__MACOSX").mkdir()
    assert capture_root(folder.parent) == folder
    assert set(read_capture(folder.parent)[0].images) == set("abc")


def test_a_colmap_model_in_place_of_cameras_json(folder: Path) -> None:
    from rig.formats.cameras.colmap import write_colmap

    rig = small_rig()
    (folder / "cameras.json").unlink()
    write_colmap(rig, folder / "sparse" / "0")
    capture, again = read_capture(folder)
    assert again.names == rig.names
    # Both files that were read count for the digest, and the points, which were not, do not.
    assert {path for path in capture.digests if path.startswith("sparse")} == {
        "sparse/0/cameras.txt",
        "sparse/0/images.txt",
    }


def damage(path: str, data: bytes) -> Callable[[Path], None]:
    def harm(folder: Path) -> None:
        (folder / path).write_bytes(data)

    return harm


def remove(path: str) -> Callable[[Path], None]:
    return lambda folder: (folder / path).unlink()


def rename(path: str, other: str) -> Callable[[Path], None]:
    def harm(folder: Path) -> None:
        (folder / path).rename(folder / other)

    return harm


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


FEATURES = "eigenhead-features/1"


def points(document: Any) -> Callable[[Path], None]:
    return damage("features.json", json.dumps(document).encode())


def feature(views: Any) -> Callable[[Path], None]:
    return points({"format": "eigenhead-features/1", "points": {"pronasale": views}})


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (remove("images/b.png"), "images/b.png is missing"),
        (remove("background/a.png"), "background/a.png is missing: a clean plate, or masks/a.png, is needed"),
        (
            damage("images/b.png", b"no picture"),
            "images/b.png is damaged or no PNG, JPEG, TIFF, WebP, BMP, PPM, RAW or HEIC picture",
        ),
        (damage("images/b.png", png(picture())[:-40]), "images/b.png is damaged: its pixels cannot be decoded"),
        (damage("images/b.png", png(picture()[:20])), "images/b.png is 64 x 20 pixels, but its camera is 64 x 48"),
        (damage("images/b.jpg", png(picture())), "images/ holds b.jpg, b.png: which one is meant?"),
        (damage("background/b/001.png", b""), "background/b/001.png is damaged"),
        (damage("masks/c.png", png(np.zeros((HEIGHT, WIDTH), np.uint8))), "masks/c.png is empty"),
        (rename("masks/c.png", "masks/c.gif"), "masks/c.gif is not read: of GIF files nothing is"),
        (rename("background/a.png", "background/a.npy"), "background/a.npy is not read: of NumPy files nothing is"),
        (damage("features.json", b"{"), "features.json cannot be read as JSON"),
        (points([]), "features.json is no object"),
        (points({"points": {}}), "features.json: format is None"),
        (feature([1, 2]), "'pronasale' is no object of camera"),
        (feature({"z": [1, 2]}), "names camera 'z', which the rig does not have"),
        (feature({"a": [1]}), "is no pair of finite pixels"),
        (feature({"a": [1, float("nan")]}), "is no pair of finite pixels"),
        (feature({"a": [1, 10**400]}), "is no pair of finite pixels"),
        (feature({"a": [True, 2]}), "is no pair of finite pixels"),
        (feature({"a": [64.0, 2]}), "lies outside the image"),
    ],
)
def test_a_fault_is_named(folder: Path, harm: Callable[[Path], None], words: str) -> None:
    harm(folder)
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert len(caught.value.faults) == 1
    assert words in caught.value.faults[0].text


def test_a_link_that_leads_nowhere_is_no_missing_picture(folder: Path) -> None:
    (folder / "images" / "a.png").unlink()
    (folder / "images" / "a.png").symlink_to("/mnt/away/a.png")
    with pytest.raises(InputError, match=r"images/a\.png is a link to a file that is not there: /mnt/away/a\.png"):
        read_capture(folder)


def test_captures_in_a_folder_are_named(folder: Path) -> None:
    for name in ("monday", "tuesday"):
        write_capture(folder.parent / "week" / name, small_capture(), small_rig())
    with pytest.raises(InputError, match="but monday, tuesday do: give one of these"):
        read_capture(folder.parent / "week")


def test_names_that_are_all_others_are_one_fault(folder: Path) -> None:
    names = read_capture(folder)[1].names
    for number, path in enumerate(sorted((folder / "images").iterdir())):
        path.rename(path.with_name(f"IMG_{number:04}{path.suffix}"))
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    (fault,) = caught.value.faults
    assert fault.text.startswith("no camera has a picture in images/: ")
    assert f"{names[0]} to {names[-1]}" in fault.text
    assert "IMG_0000.png to IMG_" in fault.text


def test_a_plate_and_a_folder_of_plates_go_together(folder: Path) -> None:
    """A picture with a colour chart is put beside the plate that is there already."""
    name = read_capture(folder)[1].names[0]
    single = next(path for path in (folder / "background").iterdir() if path.stem == name)
    (folder / "background" / name).mkdir()
    write_image(folder / "background" / name / "chart.png", 255 - read_image(single))
    plates = read_capture(folder)[0].backgrounds[name]
    assert len(plates) == 2
    np.testing.assert_array_equal(plates[0], 255 - plates[1])


def test_names_may_differ_in_case_and_a_camera_may_be_called_as_its_picture(folder: Path) -> None:
    (folder / "images" / "a.png").rename(folder / "images" / "A.PNG")
    (folder / "background" / "a.png").rename(folder / "background" / "A.png")
    (folder / "masks" / "c.png").rename(folder / "masks" / "C.png")
    document = json.loads((folder / "cameras.json").read_text())
    document["cameras"][1]["name"] = "b.png"
    (folder / "cameras.json").write_text(json.dumps(document))
    (folder / "background" / "b").rename(folder / "background" / "b.png")
    (folder / "features.json").unlink()
    capture, rig = read_capture(folder)
    assert set(capture.images) == set(rig.names) == {"a", "b.png", "c"}
    assert set(capture.backgrounds) == {"a", "b.png"}
    assert set(capture.masks) == {"c"}


def test_two_spellings_of_one_name_are_no_guess(folder: Path) -> None:
    document = json.loads((folder / "cameras.json").read_text())
    document["cameras"][1]["name"] = "A"  # beside "a"
    (folder / "cameras.json").write_text(json.dumps(document))
    (folder / "features.json").unlink()
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert any("images/A.png is missing" in fault.text for fault in caught.value.faults)


@pytest.mark.parametrize(
    ("called", "meant"), [("backgrounds", "background"), ("Images", "images"), ("mask", "masks"), ("image", "images")]
)
def test_a_folder_that_nobody_would_read_is_named(folder: Path, called: str, meant: str) -> None:
    (folder / meant).rename(folder / called)
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert texts_of(caught.value.faults) == [f"{called}/ is not read: call it {meant}/"]


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        ({"width": HEIGHT, "height": WIDTH}, "exchange the camera's width and height"),  # of cx 31.5, cy 23.5
        ({"width": HEIGHT, "height": WIDTH, "cx": 23.5, "cy": 31.5}, "it was turned by 90 degrees; turn it back"),
        ({"width": 2 * WIDTH, "height": 2 * HEIGHT}, "give it in the size that was calibrated"),
        ({"width": WIDTH + 9}, f"its camera is {WIDTH + 9} x {HEIGHT}"),
    ],
)
def test_a_picture_of_another_size_is_told_with_its_remedy(change: dict[str, float], remedy: str) -> None:
    fault = size_fault("images/a.png", (WIDTH, HEIGHT), replace(small_rig()["a"].intrinsics, **change))
    assert fault.text.startswith(f"images/a.png is {WIDTH} x {HEIGHT} pixels")
    assert remedy in fault.text


def test_all_faults_are_named_at_once(folder: Path) -> None:
    (folder / "images" / "a.png").unlink()
    (folder / "images" / "b.png").write_bytes(b"")
    (folder / "features.json").write_text("[]")
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert len(caught.value.faults) == 3


def test_a_rig_s_faults_come_with_its_file_s_name(folder: Path) -> None:
    (folder / "cameras.json").write_text("{}")
    with pytest.raises(InputError, match=r"capture: cameras\.json: "):
        read_capture(folder)
    (folder / "cameras.json").unlink()
    with pytest.raises(InputError, match=r"holds no cameras\.json"):
        read_capture(folder)
    with pytest.raises(InputError, match="is no folder"):
        read_capture(folder / "absent")


def test_a_picture_too_large_is_refused_before_it_is_decoded(folder: Path) -> None:
    import struct
    import zlib

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (folder / "images" / "a.png").write_bytes(bomb)
    with pytest.raises(InputError, match=r"images/a\.png is (60000 x 60000 pixels|damaged)"):
        read_capture(folder)


def test_too_many_points_are_refused() -> None:
    faults: list[Message] = []
    document = {"format": "eigenhead-features/1", "points": {f"p{i}": {} for i in range(201)}}
    assert features_from_bytes(json.dumps(document).encode(), small_rig(), faults) == {}
    assert "201 points, at most 200" in faults[0].text


def test_the_shared_capture_is_read() -> None:
    capture, rig = read_capture(shared("data/captures/scan-a"))
    assert len(rig) == len(capture.images) == 11
    assert not any(camera.intrinsics.distortion.is_zero for camera in rig)
    assert len(capture.features) == 7


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


def all_points(views: Callable[[str, list[float]], tuple[str, Any]]) -> Callable[[Path], None]:
    """Rewrites every point of three landmarks in three cameras."""
    pixels = {"a": [20.0, 30.0], "b": [40.0, 25.0], "c": [50.0, 20.0]}
    names = ("pronasale", "subnasale", "gnathion")
    return points({"format": FEATURES, "points": {name: dict(views(*of) for of in pixels.items()) for name in names}})


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (all_points(lambda name, at: (name, [at[0] / 64, at[1] / 48])), "the points are shares of the picture's size"),
        (all_points(lambda name, at: (name, [4 * at[0], 4 * at[1]])), "9 of 9 points lie outside their pictures"),
        (all_points(lambda name, at: (name, [at[1], at[0]])), "the points agree once rows and columns are exchanged"),
        (all_points(lambda name, at: (name, [*at, 0.9])), "is no pair of finite pixels; the same is true of 8 more"),
        (all_points(lambda name, at: (name, None)), "is no pair of finite pixels; the same is true of 8 more"),
        (all_points(lambda name, at: (f"x{name}", at)), "which the rig does not have; the same is true of 8 more"),
        (
            points({"format": FEATURES, "points": {c: {"pronasale": [9, 9], "gnathion": [8, 8]} for c in "abc"}}),
            "the points are listed by camera",
        ),
    ],
)  # fmt: skip
def test_a_fault_of_all_points_is_one_sentence(folder: Path, harm: Callable[[Path], None], words: str) -> None:
    harm(folder)
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert len(caught.value.faults) == 1
    assert words in caught.value.faults[0].text


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("transforms_train.json", b"{}", r"transforms_train\.json: .* join their frames in one transforms\.json"),
        ("cameras.sfm", b"{}", "Meshroom"),
        ("bundle.out", b"# Bundle file v0.3", "Bundler"),
        ("cameras_sphere.npz", b"PK", "NeuS"),
        ("a.yml", b"%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n", "OpenCV's calibration of one camera"),
        ("inner.zip", b"PK\3\4", r"holds an archive \(inner\.zip\)"),
    ],
)
def test_cameras_that_are_not_read_and_archives_are_named(folder: Path, name: str, data: bytes, words: str) -> None:
    (folder / "cameras.json").unlink()
    (folder / name).write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_capture(folder)


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
    assert "images/a.tif holds several pictures, and the first is read" in [r.text for r in capture.remarks]
    np.testing.assert_array_equal(capture.images["a"], np.asarray(whole))


@pytest.mark.parametrize("locked", ["a.png", "cameras.json"])
def test_what_may_not_be_read_is_neither_damaged_nor_wrong(
    folder: Path, monkeypatch: pytest.MonkeyPatch, locked: str
) -> None:
    read_bytes = Path.read_bytes

    def refused(path: Path) -> bytes:
        if path.name == locked and path.parent.name != "background":
            raise PermissionError(13, "Permission denied")
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", refused)
    with pytest.raises(InputError, match=r"cannot be read \(Permission denied\)"):
        read_capture(folder)


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (HEIGHT, WIDTH, 3)])
def test_pictures_of_floating_point_are_not_damaged(folder: Path, shape: tuple[int, ...]) -> None:
    (folder / "images" / "a.png").unlink()
    (folder / "images" / "a.tif").write_bytes(cv2.imencode(".tif", np.full(shape, 0.5, np.float32))[1].tobytes())
    with pytest.raises(InputError, match=r"images/a\.tif holds floating-point numbers: save it in 8 or 16 bits"):
        read_capture(folder)


def test_folders_around_a_capture_may_be_many(folder: Path) -> None:
    deep = folder.parent / "a" / "b" / "2025-01-01" / "take 2" / "scan"
    deep.mkdir(parents=True)
    folder.rename(deep / "capture")
    assert capture_root(folder.parent / "a") == deep / "capture"
