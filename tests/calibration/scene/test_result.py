"""What a calibration from the scene says of itself; its verdict is that of the weakest camera, never good on an assumed
scale."""

import json
from dataclasses import replace

import numpy as np
import pytest

from calibration.scene.result import judge_scene, scene_page
from calibration.scene.scale import ASSUMED, scale_from_head
from rig.formats.cameras.cameras_json import rig_from_document
from rig.messages.message import texts_of, verbatim
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


def test_a_calibration_from_a_scene_is_judged_by_what_it_does_not_know() -> None:
    found = solved()
    sharp = np.full(len(found.rig), 0.3)
    sound = replace(found, uncertainty=replace(found.uncertainty, pose_sigma_px=sharp))
    assert judge_scene(sound).word == "good"
    guessed = judge_scene(
        replace(sound, scale=replace(found.scale, source=ASSUMED[0], provenance=verbatim("an ASSUMPTION")))
    )
    assert (guessed.word, texts_of(guessed.missing)) == ("usable", ["the scale is an ASSUMPTION"])
    apart = judge_scene(replace(sound, left_out={"dark": verbatim("only 3 distinct points in it")}))
    assert (apart.word, texts_of(apart.missing)) == ("usable", ["dark: only 3 distinct points in it"])
    for px, word in ((0.8, "usable"), (1.4, "poor")):
        loose = replace(found.uncertainty, pose_sigma_px=np.where(np.arange(len(sharp)) == 2, px, sharp))
        judged = judge_scene(replace(found, uncertainty=loose))
        assert judged.word == word
        assert judged.missing[0].text.startswith(f"{found.rig.names[2]}: the pose is uncertain by more than")


def test_the_page_names_views_that_did_not_join_and_escapes_them() -> None:
    page = scene_page(replace(solved(), left_out={"<cam9>": verbatim("dark")}))
    assert "6 of 7 views joined" in page
    assert "&lt;cam9&gt;: dark" in page
    assert "<cam9>" not in page
    assert all(name in page for name in solved().rig.names)


def test_an_assumed_scale_stands_out_on_the_page() -> None:
    found = solved()
    assert "class='good'>1 tag of 40 mm (7)" in scene_page(found)
    assumed = replace(found, scale=scale_from_head(found.structure, found.structure.points))
    assert "class='bad'>an ASSUMPTION" in scene_page(assumed)
