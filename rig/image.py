"""What a picture is between its file and the pixels' owner."""

import numpy as np
from jaxtyping import UInt8

ImageRgb = UInt8[np.ndarray, "h w 3"]
"""A picture as sRGB, row by row from the top; h and w are those of the call's other pictures."""
