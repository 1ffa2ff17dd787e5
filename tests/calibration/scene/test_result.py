"""What a calibration from the scene says of itself."""

import json

import numpy as np
import pytest

from rig.formats.cameras.cameras_json import rig_from_document
from tests.support.textured_wedge import solved


def test_the_document_is_json_and_holds_the_rig() -> None:
    found = solved()
    document = json.loads(json.dumps(found.document(), allow_nan=False))
    rig = rig_from_document(document["rig"])
    for camera in found.rig:
        np.testing.assert_allclose(rig[camera.name].centre_world, camera.centre_world, atol=1e-6)
    assert document["scale"]["source"] == "tag"
    assert document["lenses"] == "one"


def test_the_figures_are_those_of_the_residuals() -> None:
    figures, structure = solved().figures(), solved().structure
    squares = (structure.residuals() ** 2).sum(axis=1)
    assert figures["rms_px"] == pytest.approx(np.sqrt(squares.mean()))
    counts = {name: row["points"] for name, row in figures["cameras"].items()}
    assert sum(counts.values()) == figures["observations"] == len(squares)
    assert 0.3 < figures["used_share"] <= 1.0
