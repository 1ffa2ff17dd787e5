"""Registers surfaces to each other: by rigid motions and similarities, with or without the coefficients of a shape
or by a search from many starts (``rigid``), and by smooth non-rigid drawing (``nonrigid``). Lengths are mm.

Every caller says what meets what, with which weight, and when a result is refused.
"""
