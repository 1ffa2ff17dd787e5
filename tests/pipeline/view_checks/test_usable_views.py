"""What is known of the views before a fit: too few, a camera that moved, remarks of the reader."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.scene.scale import times
from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.segmentation.segment import _mask_quality
from pipeline.view_checks.head_size import WrongScale
from pipeline.view_checks.image_assignment import SamePictures
from pipeline.view_checks.usable_views import (
    TooFewViews,
    UsableViews,
    blurred_views,
    plates_brightness,
    replace_by_faults,
    turned_against_plate,
    usable_views,
    view_warnings,
)
from rig.capture import Capture
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.geometry import RigidTransform, rotation_from_vector
from rig.messages.message import compose
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.changed_rigs import reposed
from tests.support.scenes import fan
from tests.support.silhouette_subjects import dressed_head

pytestmark = pytest.mark.gl
Seen = tuple[Rig, dict[str, Silhouette]]


@pytest.fixture(scope="module")
def seen(renderer: Renderer) -> Seen:
    rig = default_layout().scaled(0.5)
    vertices, faces, pose = dressed_head(load_model(), rig, np.random.default_rng(2), 60)
    with renderer.silhouette_set(rig, faces) as drawn:
        masks = drawn.masks(pose.apply(vertices))
    return rig, {name: silhouette_from_mask(mask) for name, mask in masks.items()}


def judged(rig: Rig, silhouettes: dict[str, Silhouette], capture: Capture | None = None) -> UsableViews:
    return usable_views(capture or Capture({}), rig, lambda shot: silhouettes, exchanged="repair")


def test_good_views_all_take_part_and_remarks_of_the_reader_are_passed_on(seen: Seen) -> None:
    rig, silhouettes = seen
    remark = compose("unknown-key", remark="the key x is not read")
    found = judged(rig, silhouettes, Capture({}, remarks=(remark,)))
    assert all(silhouette.quality.usable for silhouette in found.silhouettes.values())
    assert found.warnings == (remark,)


def test_a_camera_that_was_turned_takes_no_part(seen: Seen) -> None:
    rig, silhouettes = seen
    turn = RigidTransform(rotation_from_vector(np.radians([0.0, 0.5, 0.0])), np.zeros(3))
    found = judged(reposed(rig, lambda pose: turn @ pose, "cam03"), silhouettes)
    assert [name for name, silhouette in found.silhouettes.items() if not silhouette.quality.usable] == ["cam03"]
    assert [warning.code for warning in found.warnings] == ["camera-moved"]


def test_two_views_are_too_few_and_each_lost_one_is_named(seen: Seen) -> None:
    rig, silhouettes = seen
    lost = {
        name: s if name in rig.names[:2] else replace(s, quality=replace(s.quality, usable=False))
        for name, s in silhouettes.items()
    }
    with pytest.raises(TooFewViews, match=r"only 2 of 11 .* cam10"):
        judged(rig, lost)


def test_what_is_true_of_many_views_is_said_once(seen: Seen) -> None:
    rig, silhouettes = seen
    weak = [compose("outline-weak", share=0.31 + 0.01 * k) for k in range(len(rig))]
    doubtful = {
        name: replace(s, quality=replace(s.quality, warnings=(weak[k],), usable=k < 2))
        for k, (name, s) in enumerate(silhouettes.items())
    }
    with pytest.raises(TooFewViews) as refused:
        judged(rig, doubtful)
    assert str(refused.value).count("hardly differs from the background") == 1
    assert "the same is true of 8 more (cam03, " in str(refused.value)
    warnings = view_warnings(doubtful)
    assert [warning.code for warning in warnings] == ["view-left-out", "view", "view"]
    doubts = {name: replace(s, quality=replace(s.quality, doubts=(weak[0],))) for name, s in silhouettes.items()}
    (doubt,) = view_warnings(doubts)
    assert doubt.text.startswith("the outline of cam00 is doubtful: 31% of the outline")
    assert "the same is true of 10 more (cam01, " in doubt.text


def test_one_picture_in_all_cameras_is_named_as_such(seen: Seen) -> None:
    rig, silhouettes = seen
    picture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    with pytest.raises(SamePictures, match=r"of 11 cameras have a copy of another camera.*give each camera its own"):
        judged(rig, silhouettes, Capture(dict.fromkeys(rig.names, picture)))


@pytest.mark.parametrize(
    ("kind", "remedy"),
    [("masks", "Correct these masks"), ("backgrounds", "Take new clean plates"), ("nothing", "Supply clean plates")],
)
def test_the_remedy_is_for_what_was_given(seen: Seen, kind: str, remedy: str) -> None:
    rig, silhouettes = seen
    lost = {name: replace(s, quality=replace(s.quality, usable=False)) for name, s in silhouettes.items()}
    captures = {
        "masks": Capture({}, masks={name: s.mask for name, s in silhouettes.items()}),
        "backgrounds": Capture({}, backgrounds={name: (np.zeros((4, 4, 3), np.uint8),) for name in silhouettes}),
        "nothing": Capture({}),
    }
    with pytest.raises(TooFewViews) as refused:
        judged(rig, lost, captures[kind])
    assert remedy in str(refused.value)
    assert kind != "masks" or "or supply masks/" not in str(refused.value)


@pytest.mark.parametrize(
    ("factor", "masked", "words"),
    [(3.3, False, r"about 3\.\d times as large as a head"), (0.4, True, "masks of the whole head with hair and neck")],
    ids=["before a fit", "masks that may hold the face alone come before the unit"],
)
def test_a_rig_in_another_unit_is_refused(seen: Seen, factor: float, masked: bool, words: str) -> None:
    rig, silhouettes = seen
    masks = {name: s.mask for name, s in silhouettes.items()} if masked else {}
    with pytest.raises(WrongScale, match=words):
        judged(times(rig, factor), silhouettes, Capture({}, masks=masks))


def test_only_the_end_opposite_to_the_shoulders_is_a_crown() -> None:
    rows, columns = np.indices((120, 160))
    bust = (np.hypot(columns - 80, rows - 55) < 25) | ((rows > 85) & (np.abs(columns - 80) < 55))
    for turns, side in ((0, "top"), (1, "left"), (2, "bottom"), (3, "right")):
        for cut in (False, True):
            mask = np.roll(bust, -40, axis=0) if cut else bust
            mask[-40:] |= cut & bust[-1]
            quality = _mask_quality(np.ascontiguousarray(np.rot90(mask, turns)))
            assert [warning.text for warning in quality.warnings if "cut off" in warning.text] == (
                [f"the head is cut off at the {side} of the image: move the camera back or "
                 f"{'tilt it up' if side == 'top' else 'turn it'}"] if cut else []
            )  # fmt: skip


HEIGHT, WIDTH = 192, 256
RIG = Rig(tuple(replace(camera, name=name) for name, camera in zip("abcd", fan(WIDTH, HEIGHT), strict=False)))
NAMES = ("a", "b", "c", "d")
ROWS, COLUMNS = np.indices((HEIGHT, WIDTH))
SUBJECT = np.hypot(COLUMNS - 128, ROWS - 96) < 60


def room(seed: int) -> np.ndarray:
    rough = np.random.default_rng(seed).integers(40, 220, (6, 8, 3), dtype=np.uint8)
    return cv2.resize(rough, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def person(seed: int) -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8), (0, 0), 1)


@pytest.fixture(scope="module")
def capture() -> Capture:
    plates = {name: room(k) for k, name in enumerate(NAMES)}
    images = {name: np.where(SUBJECT[..., None], person(k), plates[name]) for k, name in enumerate(NAMES)}
    return Capture(images, {name: (plate,) for name, plate in plates.items()})


@pytest.fixture(scope="module")
def outlines() -> dict[str, Silhouette]:
    return dict.fromkeys(NAMES, silhouette_from_mask(SUBJECT))


def test_nothing_is_said_of_good_pictures(capture: Capture, outlines: dict[str, Silhouette]) -> None:
    assert blurred_views(capture.images, outlines) == {}
    assert [turned_against_plate(capture, name) for name in NAMES] == [None] * 4
    assert replace_by_faults(outlines, capture, NAMES, RIG) == outlines
    unlike = {"a": capture.images["a"], "b": np.zeros_like(capture.images["b"])}
    assert blurred_views(unlike, outlines) == {}, "two views do not tell what is sharp"


@pytest.mark.parametrize("sigma", [3.0, 12.0])
def test_a_blurred_picture_is_named_alone(capture: Capture, outlines: dict[str, Silhouette], sigma: float) -> None:
    blurred = replace(capture, images={**capture.images, "c": cv2.GaussianBlur(capture.images["c"], (0, 0), sigma)})
    weak = replace(outlines["c"].quality, warnings=(compose("outline-weak", share=0.3),))
    doubted = {**outlines, "c": replace(outlines["c"], quality=weak)}
    found = replace_by_faults(doubted, blurred, ["c"], RIG)
    assert [fault.code for fault in found["c"].quality.warnings] == ["detail-missing"]
    assert found["c"].quality.usable
    assert all(found[name] is outlines[name] for name in "abd")


@pytest.mark.parametrize(
    ("turned", "word"),
    [
        (lambda image: image[::-1, ::-1], "turned by 180 degrees"),
        (lambda image: image[:, ::-1], "flipped left to right"),
        (lambda image: image[::-1], "flipped upside down"),
    ],
)
def test_a_turned_picture_is_named_and_left_out(capture: Capture, outlines: dict, turned, word: str) -> None:
    pictures = {**capture.images, "b": np.ascontiguousarray(turned(capture.images["b"]))}
    found = replace_by_faults(outlines, replace(capture, images=pictures), ["b"], RIG)
    assert not found["b"].quality.usable
    (fault,) = found["b"].quality.warnings
    assert word in fault.text


@pytest.mark.parametrize("exposure", [1.0, 1.5, 4.0, 0.25])
def test_clean_plates_of_another_exposure_are_measured(capture: Capture, exposure: float) -> None:
    def exposed(image: np.ndarray) -> np.ndarray:
        light = exposure * linear_from_srgb(image / 255.0)
        return np.rint(255.0 * srgb_from_linear(np.clip(light, 0.0, 1.0))).astype(np.uint8)

    plates = {name: tuple(map(exposed, of)) for name, of in capture.backgrounds.items()}
    found = plates_brightness(replace(capture, backgrounds=plates))
    assert (found is None) == (0.6 < exposure < 1.8)
    assert found is None or found == pytest.approx(exposure, rel=0.1)
