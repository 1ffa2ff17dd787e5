"""Fits the head exactly as the paper does (sections 4.3, 4.4 and 5.1): the downhill simplex minimises the
boundary-weighted XOR of silhouettes, from coarse to fine."""
