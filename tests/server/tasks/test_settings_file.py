"""Settings from a file and from options."""

from pathlib import Path

import pytest

from rig.errors import InputError
from server.tasks.settings_file import settings_document


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("deep.json", "[" * 100_000, "the content cannot be read"),
        ("deep.toml", "front = " + "[" * 100_000, "the content cannot be read"),
        ("half.json", "{", "the content cannot be read"),
        ("list.json", "[]", "the file is no table of settings"),
    ],
)
def test_a_file_that_holds_no_settings_is_named(tmp_path: Path, name: str, text: str, fault: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=f"{name}: {fault}"):
        settings_document(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text"),
    [("settings", ' {"front": "cam01"}'), ("settings", 'front = "cam01"'), ("a.conf", '[outputs]\nsurface = "head"')],
)
def test_a_file_without_an_ending_is_told_by_what_it_holds(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert settings_document(tmp_path / name) in ({"front": "cam01"}, {"outputs": {"surface": "head"}})


def test_options_add_to_the_tables_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('front = "cam00"\n[outputs]\nsurface = "head"\n')
    found = settings_document(tmp_path / "a.toml", front="cam01", outputs={"formats": ["ply"]}, detail=None)
    assert found == {"front": "cam01", "outputs": {"surface": "head", "formats": ["ply"]}}
