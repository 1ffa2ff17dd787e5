"""Holds head models (section 3): the mean head, its modes, landmarks, expressions and levels of detail."""
