"""Prepares finished heads for clinics: export to a patient's axes, comparison of visits, registration to a CT surface.

The input is result folders, and meshes of other programs in mm. The output is meshes, landmarks, tables and pictures.
"""
