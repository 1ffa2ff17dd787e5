"""The fast tests hold every call to its annotated shapes."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from rig.geometry import RigidTransform


def test_a_wrong_shape_is_refused() -> None:
    with pytest.raises(TypeCheckError, match="rotation"):
        RigidTransform(np.zeros((2, 2)), np.zeros(3))
