"""Triangulation: planted points, with noise as derived; what determines no point is said; contradicting views;
parallax."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import chi2

from pipeline.alignment.feature_points import locate_features
from pipeline.multiview.triangulation import USUAL, NoPoint, depth_factor, parallax, triangulate, triangulate_many
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import look_at
from rig.rig import Rig
from tests.support.oracles import project

UP = np.array([0.0, 1.0, 0.0])
LENS = Distortion(-0.12, 0.05, 1e-3, -8e-4, 0.01)


def camera(name: str, centre: list[float], lens: Distortion = LENS) -> Camera:
    intrinsics = Intrinsics(1024, 768, 1500.0, 1480.0, 520.0, 377.0, lens)
    return Camera(name, intrinsics, look_at(np.array(centre), np.zeros(3), UP))


RIG = Rig(
    (
        camera("left", [-500.0, 50.0, 1000.0]),
        camera("front", [0.0, 0.0, 1100.0]),
        camera("right", [600.0, -80.0, 950.0]),
        camera("above", [100.0, 600.0, 900.0]),
    )
)


def seen(point: np.ndarray, names: tuple[str, ...] = RIG.names) -> dict[str, np.ndarray]:
    """Pixels by the oracle's own formulas."""
    pixels = {}
    for name in names:
        k, pose = RIG[name].intrinsics, RIG[name].camera_from_world
        pixel, _ = project(
            point[None], pose.rotation, pose.translation, k.fx, k.fy, k.cx, k.cy, *k.distortion.opencv().tolist()
        )
        pixels[name] = pixel[0]
    return pixels


coordinates = st.floats(-120.0, 120.0)


@settings(max_examples=40)
@given(x=coordinates, y=coordinates, z=coordinates, views=st.sampled_from([2, 3, 4]))
def test_exact_pixels_give_the_point_back(x: float, y: float, z: float, views: int) -> None:
    truth = np.array([x, y, z])
    found = triangulate(seen(truth, RIG.names[:views]), RIG, noise_px=1.0)
    # 1e-9 of the distance is where the iteration stops
    np.testing.assert_allclose(found.position_world, truth, atol=1e-5)
    assert max(np.abs(r).max() for r in found.residuals_px.values()) < 1e-6


def test_the_minimum_is_the_one_of_scipy() -> None:
    rng = np.random.default_rng(3)
    pixels = {name: pixel + rng.normal(0, 5.0, 2) for name, pixel in seen(np.array([20.0, -60.0, 90.0])).items()}

    def residuals(point: np.ndarray) -> np.ndarray:
        return np.concatenate([RIG[name].project(point[None])[0] - pixel for name, pixel in pixels.items()])

    oracle = least_squares(residuals, np.zeros(3), method="lm", xtol=1e-14, ftol=1e-14)
    found = triangulate(pixels, RIG, noise_px=5.0)
    np.testing.assert_allclose(found.position_world, oracle.x, atol=1e-4)
    assert found.misfit(1.0) == pytest.approx(2 * oracle.cost, rel=1e-9)


def test_the_covariance_is_that_of_many_draws() -> None:
    rng = np.random.default_rng(0)
    truth, noise, draws = np.array([-30.0, 40.0, 80.0]), 1.5, 200
    exact = seen(truth, ("left", "front"))
    found = [
        triangulate({k: v + rng.normal(0, noise, 2) for k, v in exact.items()}, RIG, noise_px=noise)
        for _ in range(draws)
    ]
    errors = np.stack([point.position_world - truth for point in found])
    # If the covariance is right the sum of squared Mahalanobis distances is chi-square with 3 * draws degrees.
    total = sum(e @ np.linalg.solve(p.covariance, e) for e, p in zip(errors, found, strict=True))
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 3 * draws)
    assert low < total < high


def test_what_determines_no_point_is_said() -> None:
    pixels = seen(np.zeros(3))
    with pytest.raises(NoPoint, match="1 view"):
        triangulate({"left": pixels["left"]}, RIG, noise_px=1.0)
    twins = Rig((camera("a", [0.0, 0.0, 1000.0]), camera("b", [0.0, 0.0, 1000.0])))
    with pytest.raises(NoPoint, match="parallel"):
        triangulate({"a": np.array([500.0, 300.0]), "b": np.array([500.0, 300.0])}, twins, noise_px=1.0)
    eyes = Rig((camera("a", [-100.0, 0.0, 1000.0]), camera("b", [100.0, 0.0, 1000.0])))
    with pytest.raises(NoPoint, match="behind"):
        triangulate({"a": np.array([100.0, 384.0]), "b": np.array([940.0, 384.0])}, eyes, noise_px=1.0)


def test_a_view_that_contradicts_the_others_is_left_out() -> None:
    truth = np.array([10.0, 20.0, 90.0])
    pixels = seen(truth)
    pixels["right"] = pixels["right"] + (40.0, 25.0)
    located = locate_features({"pronasale": pixels}, RIG, noise_px=1.5)
    np.testing.assert_allclose(located.points["pronasale"].position_world, truth, atol=1e-5)
    assert "right" not in located.points["pronasale"].residuals_px
    assert len(located.remarks) == 1
    assert "pronasale in right" in located.remarks[0].text


def test_two_views_that_contradict_each_other_lose_the_point() -> None:
    pixels = seen(np.array([10.0, 20.0, 90.0]), ("left", "front"))
    pixels["front"] = pixels["front"] + (0.0, 60.0)  # off the epipolar line
    located = locate_features({"pronasale": pixels, "gnathion": {"left": pixels["left"]}}, RIG, noise_px=1.5)
    assert not located.points
    assert [remark.text.split()[1] for remark in located.remarks] == ["pronasale", "gnathion"]


def many(count: int, noise_px: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points, and their pixels in every view with noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-120.0, 120.0, (count, 3))
    pixels = np.stack([np.stack(list(seen(point).values())) for point in points], axis=1)
    return points, pixels + rng.normal(0.0, noise_px, pixels.shape)


def test_views_count_by_their_noise() -> None:
    """A view of infinite noise says nothing, whatever it shows; one of large noise hardly anything."""
    points, pixels = many(30, 0.0)
    pixels[1] += (40.0, -25.0)
    noise = np.ones(pixels.shape[:2])
    noise[1] = np.inf
    left_out = triangulate_many(pixels, RIG.cameras, noise)
    np.testing.assert_allclose(left_out.positions_world, points, atol=1e-5)
    noise[1] = 1e3
    hardly = triangulate_many(pixels, RIG.cameras, noise)
    assert 0.0 < np.linalg.norm(hardly.positions_world - points, axis=1).max() < 1e-3


def test_what_determines_no_point_among_many_is_said() -> None:
    _, pixels = many(5, 0.0)
    noise = np.ones(pixels.shape[:2])
    noise[1:, 3] = np.inf  # one view of the fourth point
    with pytest.raises(NoPoint, match="parallel"):
        triangulate_many(pixels, RIG.cameras, noise)
    behind = pixels.copy()
    behind[0], behind[2] = (-4000.0, 377.0), (5000.0, 377.0)  # outside the lens model, or rays that meet behind
    with pytest.raises(NoPoint):
        triangulate_many(behind, RIG.cameras, np.ones(pixels.shape[:2]))


VIEW, VALUE = np.array([[0, 1]]), np.ones((1, 2))


def of_two(angle_deg: float, normal: tuple[float, float, float]) -> float:
    """The parallax of two cameras at 500 mm, ``angle_deg`` apart, that look at the origin."""
    half = np.radians(angle_deg) / 2.0
    centres = 500.0 * np.array([[np.sin(half), 0.0, np.cos(half)], [-np.sin(half), 0.0, np.cos(half)]])
    return float(parallax(np.zeros((1, 3)), np.array([normal]), centres, VIEW, VALUE)[0])


@pytest.mark.parametrize("angle_deg", [5.0, 25.0, 60.0])
def test_two_cameras_shift_by_twice_the_sine_of_half_their_angle(angle_deg: float) -> None:
    """Half of the draws take one camera twice."""
    for normal in ((0.0, 0.0, 1.0), (0.0, 0.6, 0.8)):  # also a surface that is turned about the base line
        assert of_two(angle_deg, normal) == pytest.approx(np.sqrt(0.5) * 2.0 * np.sin(np.radians(angle_deg) / 2.0))


def test_a_view_that_compares_nothing_has_no_parallax() -> None:
    centres = np.array([[100.0, 0.0, 500.0], [0.0, 0.0, 500.0]])
    alone = parallax(
        np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), centres, np.array([[0, -1]]), np.array([[1.0, 0.0]])
    )
    np.testing.assert_allclose(alone, 0.0)


def test_depth_is_less_sure_by_the_ratio_of_the_parallaxes() -> None:
    np.testing.assert_allclose(depth_factor(np.array([USUAL, USUAL / 3.0, 2.0 * USUAL])), [1.0, 3.0, 1.0])
