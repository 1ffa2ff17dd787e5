"""Planted changes come out where they are and as large as they are; what is not sure is grey."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.applications.clinic.comparison_files import FILES, compare, write_comparison
from pipeline.applications.verification.write import UNTOLD
from pipeline.evidence.measurements import Measurement
from rig.errors import InputError
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.pictures.images import read_image
from rig.mesh import Mesh
from rig.messages.message import compose
from tests.support.measured_heads import LEVEL, mannequin, model
from tests.support.visits import MOVED, bumped, moved, visit

EARLIER = visit(name="march")


def row_of(name: str) -> int:
    return model().levels[LEVEL].landmarks[name]


def volume_ml(vertices: np.ndarray) -> float:
    """Volume below a surface towards the origin, by the divergence theorem."""
    a, b, c = np.moveaxis(vertices[mannequin().faces], 1, 0)
    return float(np.einsum("fx,fx->f", a, np.cross(b, c)).sum() / 6000.0)


def test_a_moved_head_is_laid_back_and_unchanged() -> None:
    found = compare(EARLIER, moved(visit()))
    np.testing.assert_allclose(found.fit.motion.rotation, MOVED.rotation, atol=1e-8)
    np.testing.assert_allclose(found.fit.motion.translation, MOVED.translation, atol=1e-5)
    assert not found.changed.any()
    assert np.nanmax(np.abs(found.distance_mm)) < 1e-4


@pytest.mark.parametrize("height_mm", [3.0, -2.0])
def test_a_swollen_cheek_is_found_with_its_height_side_and_volume(height_mm: float) -> None:
    swollen = bumped("zygion_left", height_mm)
    found = compare(EARLIER, moved(visit(swollen, name="june")))
    top = row_of("zygion_left")
    assert found.distance_mm[top] == pytest.approx(height_mm, abs=0.12)  # edges of the coarse mesh are 12 mm
    away = np.linalg.norm(mannequin().vertices - mannequin().vertices[top], axis=1)
    assert away[found.changed].max() < 30.0
    assert found.changed[away < 10.0].all()
    truth = volume_ml(swollen) - volume_ml(mannequin().vertices)
    assert found.regions["whole"].volume_ml == pytest.approx(truth, rel=0.15)
    assert np.sign(found.regions["face"].largest_mm) == np.sign(height_mm)
    assert found.regions["mouth"].changed_share == 0.0


def test_an_opened_jaw_does_not_move_the_forehead() -> None:
    """The lower face turns by 6 degrees about the ears: the alignment stays as exact as it was."""
    head = mannequin().vertices
    hinge = head[[row_of("tragion_left"), row_of("tragion_right")]].mean(axis=0)
    low = np.clip((hinge[1] - 20.0 - head[:, 1]) / 20.0, 0.0, 1.0)
    angle = np.radians(6.0) * low
    y, z = head[:, 1] - hinge[1], head[:, 2] - hinge[2]
    turned = np.stack([head[:, 0], hinge[1] + np.cos(angle) * y - np.sin(angle) * z,
                       hinge[2] + np.sin(angle) * y + np.cos(angle) * z], axis=1)  # fmt: skip
    found = compare(EARLIER, moved(visit(turned)))
    np.testing.assert_allclose(found.fit.motion.translation, MOVED.translation, atol=1e-4)
    assert found.changed[row_of("gnathion")]
    assert not found.changed[EARLIER.stable].any()


def smooth_noise(seed: int, std_mm: float) -> np.ndarray:
    """The mannequin with errors along its normals that go together within 15 mm, as those of depth maps do."""
    rng, head = np.random.default_rng(seed), mannequin().vertices
    waves = rng.standard_normal((200, 3)) / 15.0
    field = np.cos(head @ waves.T + rng.uniform(0.0, 2.0 * np.pi, 200)).sum(axis=1) / 10.0
    return head + std_mm * field[:, None] * mannequin().normals()


def test_noise_as_large_as_both_results_state_is_grey() -> None:
    """Independent errors of the stated size in both visits: at most one in twenty is beyond two deviations."""
    first, second = smooth_noise(0, 0.4), smooth_noise(1, 0.4)
    face = EARLIER.measured.regions["face"]
    assert compare(visit(first, std_mm=0.4), moved(visit(second, std_mm=0.4))).changed[face].mean() < 0.05
    assert compare(visit(first, std_mm=0.1), moved(visit(second, std_mm=0.1))).changed[face].mean() > 0.2


def test_a_measurement_changes_for_sure_beyond_two_combined_deviations() -> None:
    wider = replace(
        visit(), measurements={"nose_breadth": Measurement(35.6, 0.5), "face_height": Measurement(1.0, 1.0)}
    )
    lengths = compare(EARLIER, moved(wider)).lengths
    assert lengths["nose_breadth"].std_mm == pytest.approx(np.sqrt(0.5))
    assert lengths["nose_breadth"].is_sure
    assert not lengths["face_height"].is_sure  # the earlier visit states no deviation
    narrower = replace(visit(), measurements={"nose_breadth": Measurement(35.4, 0.5)})
    assert not compare(EARLIER, moved(narrower)).lengths["nose_breadth"].is_sure


def test_another_head_is_refused() -> None:
    wavy = mannequin().vertices + 4.0 * np.sin(mannequin().vertices[:, :1] / 6.0) * mannequin().normals()
    with pytest.raises(InputError, match="are both heads of one person"):
        compare(EARLIER, moved(visit(wavy)))


def test_a_head_that_differs_where_nobody_changes_is_doubted(tmp_path: Path) -> None:
    """Waves of .6 mm everywhere: too small to be refused, and no person's forehead gets them between two visits."""
    wavy = mannequin().vertices + 0.6 * np.sin(mannequin().vertices[:, :1] / 6.0) * mannequin().normals()
    found = compare(EARLIER, moved(visit(wavy)))
    [warning] = found.warnings
    assert warning == compose("maybe-other-person", share=found.regions["stable"].changed_share)
    assert write_comparison(tmp_path, found, "2026-03-01")["warnings"] == [warning.document()]
    assert not compare(EARLIER, moved(visit(bumped("zygion_left", 3.0)))).warnings


def test_the_files_hold_what_was_found(tmp_path: Path) -> None:
    found = compare(EARLIER, moved(visit(bumped("zygion_left", 3.0), name="june")))
    document = write_comparison(tmp_path, found, "2026-03-01")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILES)
    assert json.loads((tmp_path / "compare.json").read_text()) == json.loads(json.dumps(document))
    rows = {row["region"]: row for row in csv.DictReader((tmp_path / "regions.csv").open())}
    assert float(rows["face"]["volume_ml"]) == pytest.approx(found.regions["face"].volume_ml, abs=1e-4)
    rows = {row["measurement"]: row for row in csv.DictReader((tmp_path / "measurements.csv").open())}
    assert (rows["nose_breadth"]["sure"], rows["face_height"]["std_mm"]) == ("false", "")
    coloured = read_mesh(tmp_path / "difference.ply").colours
    assert coloured is not None
    colours = np.asarray(coloured)
    grey = (colours == UNTOLD).all(axis=1)
    np.testing.assert_array_equal(~grey, found.changed)
    top = colours[row_of("zygion_left")].astype(int)
    assert top[0] > top[2]  # red: the later head lies outside
    assert read_image(tmp_path / "difference.png").std() > 10
    pdf = (tmp_path / "comparison.pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert pdf.count(b"/Type /Page\n") == 2
    again = tmp_path / "again"
    write_comparison(again, found, "2026-03-01")
    assert {name: (again / name).read_bytes() == (tmp_path / name).read_bytes() for name in FILES} == dict.fromkeys(
        FILES, True
    )


def test_a_later_head_of_another_mesh_is_compared_by_its_surface() -> None:
    """The same surface with its vertices shuffled, as another model would give it."""
    order = np.random.default_rng(1).permutation(len(mannequin().vertices))
    later = moved(visit(bumped("zygion_left", 3.0)))
    mesh = later.measured.mesh_world
    place = np.argsort(order)
    shuffled = Mesh(mesh.vertices[order], place[mesh.faces].astype(np.int32))
    stated = later.measured.stated_mm[order]
    found = compare(EARLIER, replace(later, measured=replace(later.measured, mesh_world=shuffled, stated_mm=stated)))
    assert found.distance_mm[row_of("zygion_left")] == pytest.approx(3.0, abs=0.12)
