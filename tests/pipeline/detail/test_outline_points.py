"""A sphere before four cameras: what windows err by at its tip, and what its outlines say."""

from functools import cache

import numpy as np
import pytest

from pipeline.contour_fit.rim import make_topology, pack_views
from pipeline.detail.dense_points import SurfacePoints
from pipeline.detail.outline_points import OutlineSearch
from pipeline.detail.refine import deform_to_points
from pipeline.part_labels.codes import Part
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import look_at
from rig.rig import Rig
from tests.support.subdivided_spheres import RADIUS_MM, subdivided_sphere

TRUE_MM, RANGE_MM = 82.0, 1200.0
TIP = np.array([0.0, 0.0, 1.0])  # seen in profile from both sides, from above and from below
TIP_MM, TOO_DEEP_MM = 12.0, 2.5


@cache
def search(hair: float = 0.0) -> OutlineSearch:
    """The outlines of a sphere of ``TRUE_MM``; every pixel shows hair with that probability."""
    eyes = RANGE_MM * np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    intrinsics = Intrinsics(640, 480, 2000.0, 2000.0, 320.0, 240.0, Distortion())
    rig = Rig(tuple(Camera(f"cam{i}", intrinsics, look_at(eye, np.zeros(3), TIP)) for i, eye in enumerate(eyes)))
    column, row = np.meshgrid(np.arange(640) - 320.0, np.arange(480) - 240.0)
    outline_px = 2000.0 * TRUE_MM / np.sqrt(RANGE_MM**2 - TRUE_MM**2)
    distance = (np.hypot(column, row) - outline_px).astype(np.float32)
    vertices, faces, _ = subdivided_sphere()
    views = pack_views(rig, {name: distance for name in rig.names})
    maps = {name: np.full((480, 640), hair, np.float32) for name in rig.names}
    return OutlineSearch(make_topology(faces, np.ones(len(vertices), bool)), views, maps)


def points() -> SurfacePoints:
    """Of the true sphere, but too deep about the tip."""
    rng = np.random.default_rng(1)
    unit = rng.standard_normal((40_000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    near = np.linalg.norm(TRUE_MM * (unit - TIP), axis=1) < TIP_MM
    radius = TRUE_MM - TOO_DEEP_MM * near + rng.normal(0.0, 0.2, len(unit))
    return SurfacePoints(radius[:, None] * unit, unit, np.full(len(unit), 0.6), np.full(len(unit), Part.SKIN, np.uint8))


def off_tip_mm(outlines: OutlineSearch | None) -> float:
    """How far the tip of the deformed sphere stands out of the true one."""
    vertices, faces, nodes = subdivided_sphere()
    found = deform_to_points(
        vertices,
        np.full(len(vertices), 1.5),
        faces,
        nodes,
        points(),
        loose=np.zeros(len(vertices), bool),
        outlines=outlines and outlines.observe,
    )
    return float(np.linalg.norm(found.vertices[(vertices @ TIP).argmax()]) - TRUE_MM)


@pytest.mark.parametrize(("hair", "low", "high"), [(None, -2.8, -2.0), (1.0, -2.8, -2.0), (0.0, -0.4, 0.2)])
def test_outlines_of_skin_hold_a_tip_that_all_windows_put_too_deep(hair: float | None, low: float, high: float) -> None:
    assert low < off_tip_mm(None if hair is None else search(hair)) < high


def test_offsets_lead_from_the_base_to_the_outline() -> None:
    vertices, _, _ = subdivided_sphere()
    now = vertices * (81.0 / RADIUS_MM)
    observed = search().observe(vertices, now, 3.0)
    assert len(observed.offset_mm) > 500
    np.testing.assert_allclose(observed.offset_mm, TRUE_MM - RADIUS_MM, atol=0.05)  # chords of 5 mm sag by 0.04 mm
