"""What helps to pick points: only what changed is computed, and what contradicts is named."""

import numpy as np
import pytest

from pipeline.alignment.feature_points import locate_features
from pipeline.head_model.landmarks import NAMES
from pipeline.multiview.triangulation import CLICK_NOISE_PX
from rig.messages.message import compose, texts_of
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from server.console import guides


@pytest.fixture(scope="module")
def rig() -> Rig:
    return default_layout()


def picked(rig: Rig) -> dict[str, dict[str, np.ndarray]]:
    """All landmarks, somewhere on a sphere of a head's size, in all cameras."""
    rng = np.random.default_rng(7)
    middle = rig.centre_world()
    points = {name: middle + 90.0 * (d := rng.normal(size=3)) / np.linalg.norm(d) for name in NAMES}
    return {name: {camera.name: camera.project(at[None])[0] for camera in rig} for name, at in points.items()}


def test_a_click_costs_one_point_however_many_there_are(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    points, fresh = picked(rig), guides.Guides(rig)
    assert (len(points), len(rig.names)) == (26, 11)
    fresh.helps(points, {}, ["pronasale"])
    located: list[str] = []
    locate = guides.locate
    monkeypatch.setattr(guides, "locate", lambda rig, name, views: (located.append(name), locate(rig, name, views))[1])
    changed = points | {"pronasale": points["pronasale"] | {"cam03": points["pronasale"]["cam03"] + 0.5}}
    result = fresh.helps(changed, {}, ["pronasale"])
    assert located == ["pronasale"]
    assert result["guides"].keys() == {"pronasale"}
    whole = guides.Guides(rig).helps(changed, {}, list(changed))
    assert result["off_px"] == whole["off_px"]
    assert result["reprojected"] == whole["reprojected"]
    assert result["guides"]["pronasale"] == whole["guides"]["pronasale"]


def test_a_pick_that_contradicts_the_others_is_named_as_a_job_would(rig: Rig) -> None:
    points = {name: views for name, views in picked(rig).items() if name in ("nasion", "pronasale", "stomion")}
    kept_guides = guides.Guides(rig)
    assert kept_guides.helps(points, {}, [])["contradictions"] == {}
    wrong = points | {
        "nasion": points["nasion"] | {"cam04": points["nasion"]["cam04"] + [60.0, -40.0]},
        "stomion": {"cam00": points["stomion"]["cam00"], "cam05": points["stomion"]["cam05"] + [0.0, 90.0]},
    }
    contradictions = kept_guides.helps(wrong, {}, [])["contradictions"]
    assert contradictions["nasion"] == compose("feature-view-contradicts", name="nasion", camera="cam04").document()
    assert contradictions["stomion"] == compose("feature-contradictory", name="stomion").document()
    assert sorted(one["message"] for one in contradictions.values()) == sorted(
        texts_of(locate_features(wrong, rig, noise_px=CLICK_NOISE_PX).remarks)
    )
    assert kept_guides.helps(points, {}, [])["contradictions"] == {}  # put right again
