"""Probabilities of sizes, against the table of the normal distribution; and tables that are wrong."""

from pathlib import Path

import pytest

from pipeline.applications.clinic.fitting import SizeTable, choose_size, read_size_tables
from rig.errors import InputError

TABLE = """format = "eigenhead-sizes/1"
[[table]]
name = "helmet"
measure = "head_circumference"
allowance = 6.0
sizes = { S = [520, 550], M = [550, 580] }
"""


def test_probabilities_are_those_of_the_normal_table() -> None:
    table = SizeTable("helmet", "head_circumference", {"S": (520.0, 550.0), "M": (550.0, 580.0)}, 6.0)
    found = choose_size(table, 554.0, 10.0)  # 560 with the allowance: M reaches from -1 to +2 deviations
    assert found.best == "M"
    assert found.probabilities["M"] == pytest.approx(0.8186, abs=1e-4)
    assert found.probabilities["S"] == pytest.approx(0.1587, abs=1e-4)  # 4 deviations below, nothing is left
    assert found.none == pytest.approx(0.0228, abs=1e-4)
    sure = choose_size(table, 543.0, 0.0)
    assert (sure.best, sure.none) == ("S", 0.0)
    assert choose_size(table, 700.0, 1.0).none == 1.0


def test_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "sizes.toml"
    path.write_text(TABLE)
    sizes = {"S": (520.0, 550.0), "M": (550.0, 580.0)}
    assert read_size_tables(path, {"head_circumference"}) == [SizeTable("helmet", "head_circumference", sizes, 6.0)]


@pytest.mark.parametrize(("old", "new", "words"), [
    ("eigenhead-sizes/1", "eigenhead-sizes/9", "does not begin with format"),
    ("[[table]]", "[other]", "does not begin with format"),
    ("[520, 550]", "[550, 520]", r"S is not \[lower, upper\]"),
    ("[520, 550]", '["a", 550]', r"S is not \[lower, upper\]"),
    ("[520, 550]", "[520, 560]", "S and M overlap"),
    ('measure = "head_circumference"', "", "measure is missing, wrong or unknown"),
    ("allowance", "alowance", "alowance is missing, wrong or unknown"),
    ("sizes", "size", "sizes is missing, wrong or unknown"),
    ("name =", "name", r"no TOML file of sizes .*: write lines such as format = .*, \[\[table\]\], name = "),
])  # fmt: skip
def test_a_wrong_table_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "sizes.toml"
    path.write_text(TABLE.replace(old, new) if old != "sizes" else TABLE.replace("sizes = {", "size = {"))
    with pytest.raises(InputError, match=words):
        read_size_tables(path, set())
