"""Holds head models (the paper's section 3): the mean head, its modes, landmarks, expressions and meshes of several
resolutions."""
