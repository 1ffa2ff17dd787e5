"""Prepares finished heads for clinics: exports in a patient's axes, compares two visits, and registers a head to the
surface of a CT.

The input is result folders, and meshes of other programs in mm. The output is meshes, landmarks, tables and pictures.
"""
