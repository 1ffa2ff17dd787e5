"""Hands finished heads to clinics: a patient's axes, two visits compared, and a head laid on the surface of a CT.

Enters: result folders, and meshes of other programs in mm. Leaves: meshes, landmarks, tables and pictures.
"""
