"""Limits are settings, and a limit that cannot be judged is neither passed nor missed."""

import pytest

from pipeline.applications.verification.judgement import Limits, checks
from rig.errors import InputError
from rig.typed_tables import read_table


def test_limits_are_read_and_wrong_ones_named() -> None:
    assert read_table(Limits, {"face_rms_mm": 1}, "limits") == Limits(face_rms_mm=1.0)
    with pytest.raises(InputError) as error:
        read_table(Limits, {"face_rms": 1.0, "least_covered": "much"}, "limits.toml")
    assert "limits.toml: unknown key 'face_rms'; did you mean 'face_rms_mm'?" in str(error.value)
    assert "least_covered is 'much', expected a finite number" in str(error.value)


def test_the_most_and_the_least() -> None:
    values = dict.fromkeys(Limits.__slots__, None) | {"face_rms_mm": 0.5, "least_covered": 0.5, "distance_mm": 3.0}
    passed = {check.name: check.passed for check in checks(Limits(face_rms_mm=0.4, distance_mm=3.0), values)}
    assert (passed["face_rms_mm"], passed["least_covered"], passed["distance_mm"]) == (False, False, True)
    assert passed["repeatability_mm"] is None
    assert checks(Limits(face_rms_mm=0.5), values)[0].passed
