"""The rig behind ``POST /v1/captures``: the simulated studio, or real cameras that a rig.toml names.

A calibration that was put to use lies in ``<data>/rig/cameras.json``. Every later capture gets a copy of it. Until
there is one, captures get the rig's own: the studio's layout, or the file that rig.toml names.
"""
