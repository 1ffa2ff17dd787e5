"""The simulated studio's pictures: their truth is the truth, faults do what they say, the same seed gives the same."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig.capture import Capture
from rig.errors import InputError
from rig.formats.captures.capture_folder import read_capture
from rig.formats.meshes.mesh_file import read_mesh
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.rig import Rig
from rig.studio.devices.folder import simulate_to_folder
from rig.studio.scene.anatomy import grid_faces
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import Scene, SimulatedCapture, _rolling, _sway, shoot, simulate
from rig.studio.scene.subject import Look, Subject, random_look
from rig.studio.sensor import sensor as sensors
from rig.studio.sensor.faults import KINDS, Fault, fault_from_text
from rig.studio.sensor.preset import PRESET
from rig.studio.sensor.sensor import Sensor, drift, expose, focus, roll_shutter
from tests.support import oracles
from tests.support.layouts import ARRANGEMENTS_DEG, arrangement
from tests.support.small_studio import CLEAN

pytestmark = pytest.mark.gl


def egg_head() -> Subject:
    """An egg with a nose, an open neck, and landmarks where a face has them: enough to dress and light."""
    rings, columns = 54, 72
    polar, around = np.meshgrid(np.linspace(0.01, 2.62, rings), np.arange(columns) * 2 * np.pi / columns, indexing="ij")
    unit = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], axis=-1)
    vertices = (unit * (76, 130, 96)).reshape(-1, 3)
    nose = np.exp(-((vertices - (0, -22, 94)) ** 2 / (150, 250, 900)).sum(axis=1))
    vertices[:, 2] += 22 * nose
    faces = grid_faces(rings, columns)
    points = {"glabella": (0, 36, 92), "pronasale": (0, -22, 116), "subnasale": (0, -34, 94), "stomion": (0, -53, 87),
              "labiale_superius": (0, -46, 88), "labiale_inferius": (0, -62, 84), "gnathion": (0, -90, 68)}  # fmt: skip
    for side, sign in (("right", -1), ("left", 1)):
        points |= {f"exocanthion_{side}": (42 * sign, 14, 79), f"endocanthion_{side}": (17 * sign, 11, 92),
                   f"cheilion_{side}": (22 * sign, -54, 84), f"tragion_{side}": (75 * sign, 0, 0)}  # fmt: skip
    marks = {name: np.array(point, float) for name, point in points.items()}
    return Subject(Mesh(vertices, faces), marks, vertices[:, 2] > 40, "egg")


@pytest.fixture(scope="module")
def rig() -> Rig:
    return default_layout().subset(("cam00", "cam02", "cam03", "cam04", "cam10")).scaled(0.25)


SMALL = replace(PRESET, defocus_px=0.4)


@pytest.fixture(scope="module")
def plain(renderer, rig) -> SimulatedCapture:
    return shot(renderer, rig)


def shot(renderer, rig, preset=SMALL, seed=1, faults=(), **options) -> SimulatedCapture:
    rng = np.random.default_rng(seed)
    return simulate(egg_head(), rig, preset, rng, renderer=renderer, faults=faults, **options)


def test_the_same_seed_gives_the_same_pictures(renderer, rig, plain):
    one, two, other = plain, shot(renderer, rig), shot(renderer, rig, seed=2)
    for name in rig.names:
        assert np.array_equal(one.capture.images[name], two.capture.images[name])
        assert np.array_equal(one.capture.backgrounds[name][1], two.capture.backgrounds[name][1])
    assert one.capture.features.keys() == two.capture.features.keys()
    assert not np.array_equal(one.capture.images["cam00"], other.capture.images["cam00"])


def test_bare_head_fills_exactly_its_silhouette(renderer, rig):
    """Without hair and clothes, coverage is the head's; the oracle draws it again with its own projection."""
    result = shot(renderer, rig, CLEAN)
    for camera in rig.subset(("cam00", "cam03", "cam10")):
        want = np.isfinite(oracles.camera_depth(camera, result.scene.head.vertices, result.scene.head.faces))
        coverage = result.scene.views[camera.name].subject[:, :, 3]
        assert (result.scene.head_masks[camera.name] != want).sum() <= 3
        # A covered centre has more than none of the samples around it, an uncovered one less than all.
        assert (coverage[want] > 0).mean() > 0.999
        assert (coverage[~want] < 1).all()
        assert abs(coverage.sum() - want.sum()) < 0.01 * want.sum()


def test_pictures_show_the_subject_where_the_truth_says(renderer, rig):
    result = shot(renderer, rig, replace(CLEAN, hair=True, clothes=True))
    for name in rig.names:
        change = np.abs(result.capture.images[name].astype(int) - result.capture.backgrounds[name][0]).max(axis=2)
        coverage = result.scene.views[name].subject[:, :, 3]
        assert (change[coverage == 0] == 0).all()
        assert (change[coverage == 1] > 0).mean() > 0.99


def test_the_head_is_upright_and_not_mirrored(renderer, rig):
    """Seen from the front: crown above chin, the subject's left on the right of the picture."""
    result = shot(renderer, rig, CLEAN, world_from_head=Similarity.identity())
    pixels = {name: rig["cam00"].project(p[None])[0] for name, p in result.scene.landmarks_world.items()}
    assert pixels["glabella"][1] < pixels["gnathion"][1]
    assert pixels["exocanthion_left"][0] > pixels["exocanthion_right"][0]
    plain = result.capture.images["cam00"].astype(int).sum(axis=2)
    mouth, forehead = (np.rint(pixels[name]).astype(int) for name in ("labiale_inferius", "glabella"))
    lips = result.capture.images["cam00"][mouth[1], mouth[0]].astype(int)
    assert lips[0] - lips[1] > 30  # red
    assert plain[forehead[1], forehead[0]] > 200


def test_chin_shades_the_neck(renderer, rig):
    result = shot(renderer, rig, replace(CLEAN, texture=False), world_from_head=Similarity.identity())
    colours, vertices = result.scene.head.colours, result.scene.head.vertices
    assert colours is not None
    brightness = colours.astype(int).sum(axis=1)
    front = np.abs(vertices[:, 0]) < 15
    forehead = brightness[front & (np.abs(vertices[:, 1] - 50) < 8) & (vertices[:, 2] > 0)].mean()
    below = brightness[front & (vertices[:, 1] < -98) & (vertices[:, 2] > 0)].mean()
    assert below < 0.75 * forehead


def test_vertex_colours_are_what_the_cameras_see(renderer):
    """Truth colours against the picture, where the view is frontal: highlights and interpolation are what is left."""
    rig = Rig((default_layout().cameras[0],))
    preset = replace(CLEAN, texture=True)
    result = shot(renderer, rig, preset, world_from_head=Similarity.identity())
    vertices, colours = result.scene.head.vertices, result.scene.head.colours
    normals = result.scene.head.normals()
    used = result.scene.photographed & (normals[:, 2] > 0.9)
    at = np.rint(rig["cam00"].project(vertices[used])).astype(int)
    assert colours is not None
    off = np.abs(result.capture.images["cam00"][at[:, 1], at[:, 0]].astype(float) - colours[used])
    assert used.sum() > 60
    assert np.median(off) < 6


def test_hair_hides_and_is_left_out_of_the_colour_mask(renderer, rig):
    bare, grown = shot(renderer, rig, CLEAN), shot(renderer, rig, replace(CLEAN, hair=True))
    crown = egg_head().mesh.vertices[:, 1] > 105
    assert bare.scene.photographed[crown].mean() > 0.5
    assert grown.scene.photographed[crown].mean() < 0.05
    for name in rig.names:
        assert grown.masks[name].sum() > 1.04 * bare.masks[name].sum()
        assert (grown.masks[name] | ~bare.masks[name]).mean() > 0.999  # hair only adds


def test_features_are_clicked_near_their_landmarks(renderer):
    rig = default_layout().scaled(0.25)
    result = shot(renderer, rig, PRESET)
    errors = []
    for landmark, views in result.capture.features.items():
        assert 2 <= len(views) <= 4
        for name, pixel in views.items():
            errors.append(pixel - rig[name].project(result.scene.landmarks_world[landmark][None])[0])
    errors = np.array(errors)
    assert len(errors) > 30
    # n draws of a standard deviation of 1.5 px: its estimate is good to 1.5 / sqrt(2 n); four times that.
    assert abs(errors.std() - 1.5) < 4 * 1.5 / np.sqrt(2 * errors.size)
    assert {"pronasale", "stomion", "exocanthion_left", "cheilion_right"} <= result.capture.features.keys()


def test_sensor_noise_is_what_the_preset_says():
    sensor = Sensor((1.0, 1.0, 1.0), replace(CLEAN, noise=PRESET.noise))
    light = np.full((200, 300, 3), sensors.MID_GREY, np.float32)
    picture = expose(light, sensor, np.random.default_rng(0)).astype(float) / 255
    # 180,000 draws: the estimate is good to 0.17 %; quantisation adds 1 / (255 sqrt 12) in quadrature (0.3 %), and the
    # curve's bend over the noise another few tenths.
    assert abs(picture.std() / PRESET.noise - 1) < 0.03
    assert abs(picture.mean() - 0.5) < 0.002
    bright = expose(light * 3, sensor, np.random.default_rng(0)).astype(float) / 255
    assert abs(bright.mean() - 0.82) < 0.01


def test_plates_differ_by_noise_and_shots_by_drift(renderer, rig):
    result = shot(renderer, rig, replace(PRESET, defocus_px=0.0))
    ratios = []
    for name in rig.names:
        first, second = (plate.astype(float) for plate in result.capture.backgrounds[name])
        clear = result.scene.views[name].subject[:, :, 3] == 0
        assert abs((first - second)[clear].mean()) < 0.2
        assert 0.7 < (first - second)[clear].std() / (255 * PRESET.noise * np.sqrt(2)) < 1.4
        ratios.append(result.capture.images[name][clear].mean() / (first + second)[clear].mean() * 2 - 1)
    assert 0.002 < np.std(ratios) < 0.03  # 2 % of the light is about 1 % of what is written of it


def test_crossed_filters_take_the_highlights_away_and_nothing_else(renderer, rig):
    """Without noise the two sets differ where the skin shines alone, and by no more than highlights do."""
    rig = rig.subset(("cam00", "cam04"))
    oily = replace(CLEAN, oil=1.0, polarised=True)
    taken = shot(renderer, rig, oily)
    cross, parallel = taken.capture.texture_sets["cross"], taken.capture.texture_sets["parallel"]
    dull = shot(renderer, rig, replace(oily, oil=0.0)).capture.texture_sets["cross"]
    for name in rig.names:
        assert np.array_equal(taken.capture.images[name], parallel[name])
        assert np.array_equal(cross[name], dull[name])
        assert (parallel[name] >= cross[name]).all()
        beside = taken.scene.views[name].subject[:, :, 3] == 0
        assert np.array_equal(parallel[name][beside], cross[name][beside])
    assert (parallel["cam00"].astype(int) - cross["cam00"]).max() > 60


def test_lens_and_gains():
    sensor = Sensor((1.2, 1.0, 0.8), replace(CLEAN, vignetting=0.2, defocus_px=1.5))
    light = focus(np.full((90, 120, 3), 0.2, np.float32), sensor)
    np.testing.assert_allclose(light[45, 60], (0.24, 0.2, 0.16), rtol=1e-2)
    np.testing.assert_allclose(light[0, 0], 0.8 * np.array((0.24, 0.2, 0.16)), rtol=1e-2)
    assert drift((10, 12), 0.0, np.random.default_rng(0)).tolist() == np.ones((10, 12, 1)).tolist()


def test_a_rolling_shutter_leans_an_upright_bar_by_the_motion():
    """The middle of a bar 8 px wide, at every row where the bar was when that row was read."""
    height, width, shift_px = 101, 120, np.array([6.0, 4.0])
    still = np.zeros((height, width, 4), np.float32)
    still[:, 50:58] = 1.0
    seen = roll_shutter(still, shift_px)
    middle = (seen[:, :, 3] * np.arange(width)).sum(axis=1) / seen[:, :, 3].sum(axis=1)
    np.testing.assert_allclose(middle, 53.5 + shift_px[0] * (np.arange(height) / 100 - 0.5), atol=0.02)


def test_a_rolling_row_shows_the_subject_where_it_was_then(renderer, rig):
    """A third down the picture, the outline is that of the scene drawn with the subject moved to that moment. Both
    sides of the head together within 0.8 px: half a pixel that coverage in quarters leaves, and a tenth of 1.5 px by
    which nearer parts move more."""
    at = Similarity(1.0, np.eye(3), np.array([3.0, -4.0, 5.0]))
    preset = replace(CLEAN, rolling_ms=100.0, sway_mm_s=200.0)
    direction = np.random.default_rng(5).standard_normal(3)
    sway_mm = 20.0 * direction / np.linalg.norm(direction)
    before = Similarity(1.0, np.eye(3), at.translation - sway_mm / 6)
    still, then = (shot(renderer, rig, CLEAN, world_from_head=pose).scene for pose in (at, before))
    light = {name: view.subject for name, view in still.views.items()}
    seen = _rolling(rig, light, at.translation, _sway(preset, np.random.default_rng(5)))
    for name in rig.names:
        row = round((len(light[name]) - 1) / 3)
        off = np.abs(seen[name][row, :, 3] - then.views[name].subject[row, :, 3]).sum()
        moved = np.abs(light[name][row, :, 3] - then.views[name].subject[row, :, 3]).sum()
        assert off < 0.8
        assert moved > 1.4 * off


def test_a_rolling_shutter_of_the_preset_reaches_the_pictures(renderer, rig):
    still, rolling = (shot(renderer, rig, replace(CLEAN, rolling_ms=ms)).capture.images for ms in (0.0, 30.0))
    assert all((still[name] != rolling[name]).any() for name in rig.names)


def test_layouts_are_eleven_cameras_that_see_the_whole_head():
    head = egg_head().mesh.vertices
    for rig in (default_layout(), *(arrangement(name) for name in ARRANGEMENTS_DEG)):
        assert len(rig) == 11
        assert np.linalg.norm(rig.centre_world()) < 25
        for camera in rig:
            pixels = camera.project(head)
            assert (pixels > 0).all()
            assert (pixels < (camera.intrinsics.width, camera.intrinsics.height)).all()
            assert not camera.intrinsics.distortion.is_zero
    front = default_layout()["cam00"].project(head)
    assert 0.5 < np.ptp(front[:, 1]) / 768 < 0.7
    assert default_layout().front_camera() == "cam00"


def differing(one: Capture, two: Capture) -> set[str]:
    return {name for name in one.images if not np.array_equal(one.images[name], two.images[name])}


def same_shot(scene: Scene, *faults: Fault) -> Capture:
    """The shot that ``shot`` took of this scene, with faults: its random numbers again."""
    return shoot(scene, np.random.default_rng(1).spawn(2)[1], faults)


@pytest.mark.parametrize("kind", ["frozen", "dark", "exposure", "shadow", "chair"])
def test_a_fault_shows_in_its_camera_alone(plain, kind):
    faulty = same_shot(plain.scene, Fault(kind, "cam03"))
    assert differing(faulty, plain.capture) == {"cam03"}
    assert not faulty.masks
    clear = plain.scene.views["cam03"].subject[:, :, 3] == 0
    change = faulty.images["cam03"].astype(int) - plain.capture.images["cam03"]
    plates = zip(faulty.backgrounds["cam03"], plain.capture.backgrounds["cam03"], strict=True)
    assert all(np.array_equal(one, other) for one, other in plates) == (kind != "chair")
    if kind == "frozen":
        assert np.array_equal(faulty.images["cam03"], faulty.backgrounds["cam03"][-1])
    if kind == "dark":
        assert faulty.images["cam03"].mean() < 45
    if kind == "shadow":
        assert change[clear].min() < -20
        assert change[clear].mean() < -0.5


def test_swapped_cables_and_a_wrong_mask(plain):
    faulty = same_shot(plain.scene, Fault("swapped", "cam03"), Fault("wrong-mask", "cam10"))
    assert differing(faulty, plain.capture) == {"cam03", "cam04"}
    assert np.array_equal(faulty.images["cam03"], plain.capture.images["cam04"])
    assert np.array_equal(faulty.backgrounds["cam04"][0], plain.capture.backgrounds["cam03"][0])
    assert set(faulty.masks) == {"cam10"}
    assert (faulty.masks["cam10"] != plain.masks["cam10"]).mean() > 0.1


def test_bumped_and_blurred_cameras(renderer, rig, plain):
    result = shot(renderer, rig, faults=[Fault("bumped", "cam04"), Fault("blurred", "cam10")])
    before, after = plain.capture.images, result.capture.images
    change = {name: np.abs(after[name].astype(int) - before[name]).mean() for name in rig.names}
    assert {name for name in rig.names if change[name] > 0.5} == {"cam04", "cam10"}
    assert all(change[name] < 0.01 for name in ("cam00", "cam02", "cam03"))  # drawn about another origin: rounding
    assert result.rig is rig
    true, known = (
        {name: cameras[name].camera_from_world.rotation for name in ("cam04", "cam10")}
        for cameras in (result.scene.true_rig, rig)
    )
    assert abs(np.degrees(np.arccos((np.trace(true["cam04"] @ known["cam04"].T) - 1) / 2)) - 0.6) < 1e-6
    assert np.array_equal(true["cam10"], known["cam10"])
    assert (result.masks["cam04"] != plain.masks["cam04"]).any()
    assert np.array_equal(result.masks["cam10"], plain.masks["cam10"])


def test_camouflage_takes_the_contrast(renderer, rig, plain):
    def contrast(result: SimulatedCapture) -> float:
        """Median difference between subject, without the face, and plate."""
        name = "cam10"
        mask = result.masks[name] & ~result.scene.head_masks[name]
        change = result.capture.images[name].astype(int) - result.capture.backgrounds[name][0]
        return float(np.median(np.abs(change[mask]).max(axis=1)))

    assert contrast(shot(renderer, rig, faults=[Fault("camouflage")])) < 0.7 * contrast(plain)


def test_whole_rig_faults(rig, plain):
    off, brighter = same_shot(plain.scene, Fault("lights-off")), same_shot(plain.scene, fault_from_text("exposure=0.2"))
    for name in rig.names:
        assert off.images[name].mean() < 0.4 * plain.capture.images[name].mean()
        ratio = brighter.images[name].mean() / plain.capture.images[name].mean()
        assert 1.05 < ratio < 1.12  # 1.2 of the light is 1.08 of what the sRGB curve writes


def test_faults_are_read_from_texts(renderer, rig):
    assert all(len(text) > 20 and Fault(kind).strength > 0 for kind, text in KINDS.items())
    assert fault_from_text("dark:cam03=0.1") == Fault("dark", "cam03", 0.1)
    assert fault_from_text("frozen") == Fault("frozen")
    with pytest.raises(InputError, match="is not one of"):
        fault_from_text("gremlins")
    with pytest.raises(InputError, match="no number"):
        fault_from_text("dark=very")
    with pytest.raises(InputError, match="cam77"):
        shot(renderer, rig, faults=[Fault("dark", "cam77")])


def test_folder_is_a_contract_capture_with_its_truth(renderer, rig, tmp_path: Path):
    result = shot(renderer, rig, replace(SMALL, plates=1))
    truth = simulate_to_folder(tmp_path / "shot", result, seed=1)
    capture, read_rig = read_capture(tmp_path / "shot")
    assert read_rig.names == rig.names
    for name in rig.names:
        assert np.array_equal(capture.images[name], result.capture.images[name])
        assert np.array_equal(capture.backgrounds[name][0], result.capture.backgrounds[name][0])
    assert capture.features.keys() == result.capture.features.keys()
    mesh = read_mesh(truth / "head.ply")
    np.testing.assert_allclose(mesh.vertices, result.scene.head.vertices, atol=1e-3)
    assert np.load(truth / "face_mask.npy").shape == (len(mesh.vertices),)
    assert np.load(truth / "colour_mask.npy").sum() > 100
    assert {p.name for p in truth.iterdir()} == {
        "head.ply", "face_mask.npy", "colour_mask.npy", "silhouettes", "head_silhouettes", "coverage", "cameras.json",
        "meta.json", "visible.npz", "parts",
    }  # fmt: skip


def test_a_head_without_landmarks_can_sit_too(renderer, rig):
    subject = Subject(egg_head().mesh)
    look = random_look(np.random.default_rng(4))
    result = simulate(subject, rig, SMALL, np.random.default_rng(3), renderer=renderer, look=look)
    assert not result.capture.features
    assert all(result.masks[name].sum() > result.scene.head_masks[name].sum() for name in rig.names)


def test_plain_look_has_no_texture(renderer, rig):
    look = Look((0.4, 0.3, 0.2), (0.1, 0.1, 0.1), None, texture=False)
    result = simulate(egg_head(), rig, CLEAN, np.random.default_rng(3), renderer=renderer, look=look)
    colours = result.scene.head.colours
    assert colours is not None
    linear = (colours / 255.0) ** 2.2
    lit = colours.min(axis=1) > 60
    ratio = linear[lit, 0] / linear[lit, 1]
    assert ratio.std() / ratio.mean() < 0.06  # only the lamps' colours are left
