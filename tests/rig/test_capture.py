"""Captures as values."""

from rig.capture import Capture, reassign_images


def test_digests_follow_their_files():
    digests = {"images/a.png": "1", "images/b.jpg": "2", "background/a/0.png": "3", "cameras.json": "4"}
    moved = reassign_images(Capture({}, digests=digests), pictures={"a": "b", "b": "a"}, plates={"a": "b", "b": "a"})
    assert moved.digests == {"background/b/0.png": "3", "cameras.json": "4", "images/a.jpg": "2", "images/b.png": "1"}
