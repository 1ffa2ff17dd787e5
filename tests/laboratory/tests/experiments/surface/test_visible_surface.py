"""The score of the whole visible surface, where geometry knows it, and beside the tool that judges from outside."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.meshes.ply import write_ply
from rig.mesh import Mesh
from rig.studio.scene.visible import PARTS, VisiblePoints
from tests.laboratory.experiments.surface.visible_surface import read_visible, score_visible
from tests.support.shared_data import shared


def ball(radius: float, subdivisions: int = 5) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces, np.int32))


def seen_sphere(radius: float, part: int, count: int = 60_000) -> VisiblePoints:
    normals = np.random.default_rng(1).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    part_codes = np.full(count, part, np.uint8)
    points, normals = (radius * normals).astype(np.float32), normals.astype(np.float32)
    return VisiblePoints(points, normals, part_codes, np.full(count, 2, np.uint8))


@pytest.mark.parametrize("part", range(3))
def test_sphere_scores_the_difference_of_radii(part: int) -> None:
    """Facets of 1.4 mm on 40 mm sag by 0.01 mm; tangent planes at 1 mm sideways by 0.0125 mm, at 2 mm by 0.05 mm."""
    score = score_visible(seen_sphere(40.0, part), ball(41.5))
    for figures in (score.recall[PARTS[part]], score.recall["all"], score.precision[PARTS[part]]):
        assert figures["median"] == pytest.approx(1.5, abs=0.03)
        assert figures["within_1mm"] == 0.0
        assert figures["within_2mm"] == 1.0
    assert score.closed


def test_surface_that_faces_away_does_not_count() -> None:
    inside_out = ball(40.0)
    score = score_visible(seen_sphere(40.0, 0), Mesh(inside_out.vertices, inside_out.faces[:, ::-1]))
    assert score.recall["all"]["median"] == 50.0
    assert "head" not in score.precision


def test_half_of_the_surface_missing_costs_recall_and_no_precision() -> None:
    whole = ball(40.0)
    right = whole.vertices[whole.faces].mean(axis=1)[:, 0] > 0
    score = score_visible(seen_sphere(40.0, 0), Mesh(whole.vertices, whole.faces[right]))
    assert not score.closed
    assert score.recall["all"]["within_2mm"] == pytest.approx(0.5, abs=0.05)
    assert score.precision["head"]["within_1mm"] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("capture", ["scan-a", "draw-b"])
def test_figures_are_those_of_the_tool_that_judges_from_outside(capture: str, tmp_path: Path) -> None:
    """Both sample the surface at random: shares of the 10,000 points of a small part differ by 0.01 at most, medians by
    0.005 mm, 95th percentiles by 0.001 over their thin tail: 0.05 spread over 20 mm here, so that it is 0.4 mm of 15.
    """
    truth, tool = shared(f"data/captures/{capture}.truth"), shared("tools/score_visible.py")
    made = read_mesh(truth / "head.ply")
    rng = np.random.default_rng(2)
    head = Mesh(made.vertices + rng.normal(0, 0.4, made.vertices.shape), made.faces)
    count = len(head.vertices)
    grey = np.full((count, 3), 128, np.uint8)
    write_ply(tmp_path / "head.ply", head, normals=head.normals(), colours=grey, quality=np.zeros(count),
              views=np.zeros(count, np.uint8))  # fmt: skip
    command = [sys.executable, str(tool), str(truth), str(tmp_path / "head.ply"), "--json"]
    expected = json.loads(subprocess.run(command, capture_output=True, text=True, check=True, timeout=200).stdout)
    score = score_visible(read_visible(truth), head)
    for kind, ours in (("recall", score.recall), ("precision", score.precision)):
        assert set(ours) == set(expected[kind])
        for part, figures in ours.items():
            for key, value in figures.items():
                margin = 0.01 if key.startswith("within") else 0.01 + 0.03 * expected[kind][part][key]
                assert value == pytest.approx(expected[kind][part][key], abs=margin), (kind, part, key)
    assert score.closed == expected["closed"]
