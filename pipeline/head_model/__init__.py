"""Holds head models (the paper's section 3): mean head, modes, landmarks, expressions and meshes."""
