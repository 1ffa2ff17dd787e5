"""What docstrings and comments name between double backticks exists: modules, classes, functions, their parameters.

The rule: a path that ends in .py is a file; a dotted name that begins with a room is a module, or a word of that
module's code; any other identifier is a word of some code, strings included (keys and columns of files). Ends of names
(``_px``), letters of formulas and files of data are left alone.
"""

import re
from functools import cache
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("rig", "pipeline", "calibration", "server", "tests", "deploy")
QUOTED = re.compile(r"(?<!`)``([^`\n]+)``")
IDENTIFIER = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*(\(\))?")
PROSE = re.compile(r'"""(?:\\.|[^\\])*?"""|(?:^|(?<=\s))#[ :!].*?$', re.DOTALL | re.MULTILINE)
COMPOSED = {"precision_seen", "reposed_rms_mm", "drift_rms_mm"}  # columns of tables, put together from pieces
LEFT = {
    ("pipeline/faces/matching.py", "landmark_map.LandmarkMap")  # comes with that room's next module
}


@cache
def sources() -> dict[PurePosixPath, str]:
    files = [path for room in ROOMS for path in (ROOT / room).rglob("*.py") if path != Path(__file__)]
    return {PurePosixPath(path.relative_to(ROOT).as_posix()): path.read_text(encoding="utf-8") for path in files}


@cache
def words(path: PurePosixPath) -> frozenset[str]:
    """Words of a file that stand neither in a docstring nor in a comment."""
    return frozenset(re.findall(r"\w+", PROSE.sub("", sources()[path])))


@cache
def words_of_all() -> frozenset[str]:
    """The same of all files, and the names of modules and folders."""
    return frozenset().union(*map(words, sources()), *(path.with_suffix("").parts for path in sources()))


def is_there(name: str) -> bool:
    """Whether what stands between backticks exists; True for what the rule does not speak of."""
    if re.fullmatch(r"[\w./-]+\.py", name):
        return any(path.as_posix() == name or path.as_posix().endswith("/" + name) for path in sources())
    if not IDENTIFIER.fullmatch(name) or name.startswith("_") or len(name) == 1 or name.endswith(".json"):
        return True  # a shell's line, a formula, the end of names, a letter of a formula, a file
    parts = name.removesuffix("()").split(".")
    if len(parts) == 1 or parts[0] not in ROOMS:
        return words_of_all().issuperset(parts)
    module = ROOT
    while parts and (module / parts[0]).is_dir():
        module /= parts.pop(0)
    if not parts:
        return True
    path = PurePosixPath((module / f"{parts[0]}.py").relative_to(ROOT).as_posix())
    return path in sources() and words(path).issuperset(parts[1:])


def test_what_docstrings_and_comments_name_exists() -> None:
    gone = [
        f"{path}:{text.count(chr(10), 0, quoted.start()) + 1}: {quoted[1]}"
        for path, text in sources().items()
        for quoted in QUOTED.finditer(text)
        if quoted[1] not in COMPOSED and not is_there(quoted[1]) and (path.as_posix(), quoted[1]) not in LEFT
    ]
    assert "\n".join(gone) == ""


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("rig.mesh.Mesh", True),
        ("rig.mesh.Mosh", False),
        ("rig.mash", False),
        ("rig.studio.scene", True),
        ("photometric_fit/refine.py", True),
        ("photo/consistency_of_views.py", False),
        ("RigidTransform", True),
        ("RigidTransformation", False),
        ("u = w / 2 + cx", True),
    ],
)
def test_the_rule_finds_what_is_gone(name: str, there: bool) -> None:
    assert is_there(name) is there
