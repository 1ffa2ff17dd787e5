"""Points of the face on both sides: what the finder shows is what the shipped table says."""

from pipeline.faces.networks import load_networks
from pipeline.faces.points import point_table
from tests.laboratory.model_packs.landmark_map import measured_mirror_images


def test_mirror_images_are_measured_the_same() -> None:
    assert (measured_mirror_images(load_networks()) == point_table().mirror_images).all()
