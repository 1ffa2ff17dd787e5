import numpy as np
import pytest

from pipeline.geometry.raster import depth_map
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.multiview.visual_hull import NoHull, hull_extent, visual_hull
from pipeline.segmentation.segment import judge_agreement
from rig.formats.captures.capture_folder import read_capture
from rig.formats.pictures.images import read_image
from rig.mesh import boundary_edges
from rig.rig import Rig
from tests.support.photographs import trace
from tests.support.scenes import SEMI_AXES, ellipsoid, fan
from tests.support.shared_data import shared


@pytest.fixture(scope="module")
def rig() -> Rig:
    return fan(640, 480, (-150, -110, -75, -40, 0, 40, 75, 110, 150))


@pytest.fixture(scope="module")
def traced(rig: Rig) -> dict[str, Silhouette]:
    return {camera.name: silhouette_from_mask(trace(camera, 0.0)[1]) for camera in rig}


def test_the_hull_holds_the_body_and_casts_its_silhouettes(rig: Rig, traced: dict[str, Silhouette]) -> None:
    silhouettes = traced
    hull = visual_hull(silhouettes, rig)
    assert len(boundary_edges(hull.faces)) == 0
    # Nothing of the ellipsoid lies outside the hull: in every direction the hull reaches at least as far, less half a
    # pixel of the masks (0.5 mm) and what a net of 3 mm cuts off a sharp edge.
    directions = ellipsoid(2).vertices / np.linalg.norm(ellipsoid(2).vertices, axis=1, keepdims=True)
    reach = (hull.vertices @ directions.T).max(axis=0)
    support = np.linalg.norm(directions * SEMI_AXES, axis=1)
    assert (reach > support - 1.5).all()
    assert np.median(reach - support) < 6.0
    for camera in rig:
        drawn = np.isfinite(depth_map(camera, hull.vertices, hull.faces)[0])
        mask = silhouettes[camera.name].mask
        assert np.count_nonzero(drawn & mask) / np.count_nonzero(drawn | mask) > 0.985


def test_the_extent_is_about_the_body(rig: Rig, traced: dict[str, Silhouette]) -> None:
    centre, edge = hull_extent(traced, rig)
    assert np.linalg.norm(centre) < 5.0
    assert 2 * SEMI_AXES.max() < edge < 3 * SEMI_AXES.max()


def test_views_that_are_not_usable_carve_nothing(rig: Rig, traced: dict[str, Silhouette]) -> None:
    silhouettes = traced
    empty = silhouette_from_mask(np.zeros((480, 640), bool))
    spoilt = silhouettes | {"cam04": Silhouette(empty.mask, np.full((480, 640), 500, np.float32))}
    kept = {name: s for name, s in silhouettes.items() if name != "cam04"}
    np.testing.assert_array_equal(visual_hull(spoilt, rig).vertices, visual_hull(kept, rig).vertices)


def test_silhouettes_without_a_common_body_are_refused(rig: Rig) -> None:
    masks = {}
    for i, name in enumerate(rig.names):
        mask = np.zeros((480, 640), bool)
        mask[20:60, 20 + 65 * i : 60 + 65 * i] = True
        masks[name] = silhouette_from_mask(np.roll(mask, 200 * (i % 2), axis=0))
    with pytest.raises(NoHull, match=r"cameras\.json"):
        visual_hull(masks, rig)


def test_the_hull_of_a_real_head_is_near_it() -> None:
    _, rig = read_capture(shared("data/captures/scan-a"))
    folder = shared("data/captures/scan-a.truth/head_silhouettes")
    silhouettes = {n: silhouette_from_mask(read_image(folder / f"{n}.png")[:, :, 0] > 0) for n in rig.names}
    hull = visual_hull(silhouettes, rig)
    for camera in rig:
        drawn = np.isfinite(depth_map(camera, hull.vertices, hull.faces)[0])
        mask = silhouettes[camera.name].mask
        # The bottom rows are cut: there the hull ends where half of the cameras still look.
        upper = slice(0, 500)
        assert np.count_nonzero(drawn[upper] & mask[upper]) / np.count_nonzero(drawn[upper] | mask[upper]) > 0.97


def test_good_views_agree_and_planted_faults_are_told(rig: Rig, traced: dict[str, Silhouette]) -> None:
    silhouettes = traced
    for name, silhouette in judge_agreement(silhouettes, rig).items():
        assert silhouette.quality.usable, name
        assert silhouette.quality.warnings == ()
    more, less = silhouettes["cam02"].mask.copy(), silhouettes["cam06"].mask.copy()
    more[100:300, 500:600] = True
    less[:200] = False
    judged = judge_agreement(
        silhouettes | {"cam02": silhouette_from_mask(more), "cam06": silhouette_from_mask(less)}, rig
    )
    assert "other cameras see nothing" in judged["cam02"].quality.warnings[0].text
    assert "lacks" in judged["cam06"].quality.warnings[0].text
    assert not judged["cam06"].quality.usable
    fine = [judged[name] for name in rig.names if name not in ("cam02", "cam06")]
    assert all(silhouette.quality.usable for silhouette in fine)
