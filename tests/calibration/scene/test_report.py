"""The page of a calibration from the scene."""

from dataclasses import replace

from calibration.scene.result import scene_page
from calibration.scene.scale import scale_from_head
from rig.messages.message import verbatim
from tests.support.textured_wedge import solved


def test_it_names_views_that_did_not_join_and_escapes_them() -> None:
    page = scene_page(replace(solved(), left_out={"<cam9>": verbatim("dark")}))
    assert "6 of 7 views joined" in page
    assert "&lt;cam9&gt;: dark" in page
    assert "<cam9>" not in page
    assert all(name in page for name in solved().rig.names)


def test_an_assumed_scale_stands_out() -> None:
    found = solved()
    assert "class='good'>1 tag of 40 mm (7)" in scene_page(found)
    assumed = replace(found, scale=scale_from_head(found.structure, found.structure.points))
    assert "class='bad'>an ASSUMPTION" in scene_page(assumed)
