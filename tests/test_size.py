"""The project stays as small as it is: no total passes its ceiling in ceilings.toml."""

import tomllib
from pathlib import Path

from tests.tools.counts import count_all, list_single_importers

CEILINGS = Path(__file__).with_name("ceilings.toml")


def test_no_total_passes_its_ceiling() -> None:
    ceilings = tomllib.loads(CEILINGS.read_text(encoding="utf-8"))
    totals = count_all()
    over = {name: f"{totals[name]} > {ceiling}" for name, ceiling in ceilings.items() if totals[name] > ceiling}
    assert over == {}, "less code, not a higher ceiling: `python -m tests.tools.counts --list` shows where it is"


def test_a_module_that_one_neighbour_imports_counts(tmp_path: Path) -> None:
    """Nor does a package, nor a module that another folder imports."""
    files = {
        "rig/__init__.py": "",
        "rig/a.py": "from rig.b import x\nfrom rig import c\n",
        "rig/b.py": "",
        "rig/c.py": "",
        "rig/d.py": "from rig import c\n",
        "server/e.py": "import rig.d\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert list_single_importers(tmp_path) == ["rig.b"]
