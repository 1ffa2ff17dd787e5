"""Fits the head exactly as the paper does (sections 4.3, 4.4 and 5.1): downhill simplex on the boundary-weighted XOR,
coarse to fine."""
