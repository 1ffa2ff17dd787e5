"""Prepares finished heads for clinics: a patient's axes, two visits compared, a head registered to the surface of a CT.

In: result folders, and meshes of other programs in mm. Out: meshes, landmarks, tables and pictures.
"""
