"""What the experiment says of shots whose scatter and common error are planted, and that lamps do move."""

from dataclasses import replace

import numpy as np
import pytest

from rig.mesh import Mesh
from rig.studio.scene.lights import LAMPS, dome, lamp_directions
from tests.laboratory.experiments.surface.repeat import Shot, judged, moved
from tests.support.measured_heads import LEVEL, mannequin, model

SHOTS = 12


def test_scatter_common_error_and_what_was_stated_are_told_apart() -> None:
    """Each shot is 0.2 mm off along the normals by itself; all are 0.5 mm off together at the tip of the nose."""
    coarse = replace(model(), levels={"full": model().levels[LEVEL]})
    level, rng = coarse.levels["full"], np.random.default_rng(3)
    head, normals = mannequin().vertices, mannequin().normals()
    away = np.linalg.norm(head - head[level.landmarks["pronasale"]], axis=1)
    wrong = head + (0.5 * np.exp(-((away / 15.0) ** 2)))[:, None] * normals
    seen, stated = np.ones(len(head), bool), np.full(len(head), 0.2)
    truth = Mesh(head, mannequin().faces)
    shots = [
        Shot(
            wrong + 0.2 * rng.standard_normal((len(head), 1)) * normals,
            stated,
            truth,
            seen,
            frozenset({"camera-moved"} if i == 0 else ()),
        )
        for i in range(SHOTS)
    ]
    row = judged(coarse, shots)
    # Eleven degrees of freedom at each of some 900 vertices of the face: known to 1 %, less what the motions take.
    assert row["normal_rms_mm"] == pytest.approx(0.2, rel=0.03)
    assert row["scatter_over_stated"] == pytest.approx(1.0, rel=0.03)
    # Of the scatter the mean keeps 0.2 / sqrt(12) = 0.06 mm; the nose adds 0.5 mm over a few percent of the face.
    assert 0.06 < row["repeated_mm"] < 0.15
    assert (row["shots"], row["warned"], row["camera_moved"]) == (SHOTS, 1, 1)


def test_lamps_are_carried_and_dimmed_and_keep_their_colour() -> None:
    lamps = moved(np.random.default_rng(1))
    angles = np.degrees(np.arccos((lamp_directions(lamps) * lamp_directions()).sum(axis=1)))
    assert ((angles > 0.5) & (angles < 40)).all()
    for lamp, was in zip(lamps, LAMPS, strict=True):
        ratio = np.array(lamp.colour) / np.array(was.colour)
        assert np.ptp(ratio) < 1e-9
        assert 0.6 < ratio[0] < 1.6
    assert np.abs(dome(lamps)[1] - dome()[1]).max() > 0.01
