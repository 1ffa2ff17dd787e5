"""Compares with other programs: soft rasterisers, morphable models, OpenMVS."""
