"""What readers of other programs' files say: once for one cause, whole quotation marks, all cameras together."""

import pytest

from rig.errors import InputError
from rig.formats.cameras.foreign import Reading, shown
from rig.formats.cameras.foreign_keys import ForeignKey
from rig.messages.message import compose, say_once, some_of, texts_of

TABLE = {
    "shutter": ForeignKey("refused", "calibrate without it", (0,)),
    "mask": ForeignKey("told", "masks lie in masks/"),
}


@pytest.mark.parametrize("text", ["a" * 99, "it's " * 20])
def test_a_long_value_keeps_its_quotation_marks(text: str) -> None:
    assert shown(text)[0] == shown(text)[-1]
    assert len(shown(text)) <= 42


def test_faults_that_differ_in_what_was_measured_alone_are_one_and_others_are_all_said() -> None:
    faults = ["images/cam00.png is black", "images/cam01.png is black", "images/cam02.png is 7 wide"]
    assert texts_of(say_once(faults, ["cam00", "cam01", "cam02"])) == faults
    assert texts_of(say_once(["a", "b", "c"], [])) == ["a", "b", "c"]
    names = [f"cam{i:02}" for i in range(4)]
    (sentence,) = texts_of(say_once([f"{n}: {27.5 + 0.1 * i:g} px is absurd" for i, n in enumerate(names)], names))
    assert sentence == "cam00: 27.5 px is absurd; the same is true of 3 more (cam01, cam02, cam03)"
    sizes = [f"{n} is {600 + i} x 400 pixels" for i, n in enumerate(names)]
    assert texts_of(say_once(sizes, names)) == sizes


def test_many_files_with_one_fault_are_one_sentence() -> None:
    names = [f"cam{i:02}" for i in range(11)]
    (sentence,) = texts_of(say_once([f"images/{name}.png is missing" for name in names], names))
    assert sentence == (
        "images/cam00.png is missing; the same is true of 10 more (cam01, cam02, cam03, cam04 and 6 more)"
    )
    plates = [f"background/{name}/{i:03}.png is 3 x 4 pixels" for name in names for i in range(2)]
    (sentence,) = texts_of(say_once(plates, names))
    assert "the same is true of 21 more (" in sentence
    assert say_once(["cam1 is a", "cam11 is a", "cam111 is a"], ["cam1", "cam11"])[0].text.startswith("cam1 is a")


def test_what_cameras_have_alike_is_said_once() -> None:
    reading = Reading("rig.json")
    for name in ("a", "b", "c"):
        reading.judge(TABLE, {"shutter": [0, 0.1], "mask": "m.png", "other": 1}, name)
    with pytest.raises(InputError) as refused:
        reading.finish([])
    assert tuple(texts_of(refused.value.faults)) == (
        "3 cameras (a, b, c): shutter is [0, 0.1]: calibrate without it",
        "there are 0 cameras; expected 3 to 64",
    )


def test_cameras_that_take_no_part_are_named_where_too_few_are_left() -> None:
    reading = Reading("rig.xml")
    for name in ("a", "b"):
        reading.leave_out(name, compose("left-not-aligned"))
    with pytest.raises(InputError, match=r"a, b not aligned in rig\.xml, so left out"):
        reading.finish([])


def test_a_list_names_a_few() -> None:
    assert some_of(["a", "b"]) == ["a", "b"]
    assert str(some_of(list("abcdef"))) == "a, b, c, d and 2 more"
