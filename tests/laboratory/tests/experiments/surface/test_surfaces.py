"""Peers that a machine lacks are named as left out, and one that fails says why."""

from pathlib import Path

import numpy as np
import pytest

from rig.capture import Capture
from rig.errors import InputError
from rig.mesh import Mesh
from rig.rig import Rig
from rig.studio.scene.visible import VisiblePoints
from tests.laboratory.experiments.paper.detail import Known
from tests.laboratory.experiments.peers.openmvs import PeerFailed
from tests.laboratory.experiments.surface.surfaces import as_markdown, figures, peer_row
from tests.laboratory.runner import run
from tests.laboratory.table import EXPERIMENTS
from tests.support.scenes import ellipsoid


def planted() -> Known:
    """A ball that its cameras see from all around."""
    ball = ellipsoid(5)
    count = len(ball.vertices)
    seen = VisiblePoints(
        ball.vertices.astype(np.float32), ball.normals().astype(np.float32), np.zeros(count, np.uint8),
        np.full(count, 2, np.uint8),
    )  # fmt: skip
    return Known("ball", Capture({}), Rig(()), ball, ball.vertices[:, 2] > 0.0, seen)


def test_a_surface_is_scored_against_all_that_is_seen_and_the_face() -> None:
    known = planted()
    outwards = Mesh(known.mesh.vertices + 1.5 * known.mesh.normals(), known.mesh.faces)
    row = peer_row(known, lambda: (outwards, 7.0))
    assert row["recall_all_within_2mm"] == row["closed"] == 1.0
    assert row["recall_all_median"] == pytest.approx(1.5, abs=0.05)
    assert row["face_mean_mm"] == pytest.approx(1.5, abs=0.05)
    assert row["cpu_s"] == 7.0


def test_a_peer_without_a_surface_says_why() -> None:
    def nothing() -> tuple[Mesh, float]:
        raise PeerFailed("DensifyPointCloud", "ended with 1: 0 points")

    row = peer_row(planted(), nothing)
    assert row == {"left_out": "DensifyPointCloud: ended with 1: 0 points"}


def test_what_is_left_out_stands_below_the_table_and_has_no_figure() -> None:
    rows = [
        {"name": "one", "peer": "hull", "recall_all_within_2mm": 0.5, "cpu_s": 1.0},
        {"name": "one", "peer": "openmvs", "left_out": "name the folder"},
    ]
    text = as_markdown(rows)
    assert "| one | hull | 0.5 |" in text
    assert text.endswith("one, openmvs: left out (name the folder).\n")
    assert figures(rows) == {"one_hull_recall_all_within_2mm": 0.5, "one_hull_cpu_s": 1.0}


def test_a_folder_without_the_programs_is_refused_before_anything_is_computed(tmp_path: Path) -> None:
    (tmp_path / "captures" / "one.truth").mkdir(parents=True)
    with pytest.raises(InputError, match="DensifyPointCloud"):
        run("surfaces", EXPERIMENTS["surfaces"], ["--shared", str(tmp_path), "--openmvs", str(tmp_path)])
