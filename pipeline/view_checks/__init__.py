"""Decides which views a job may use: pictures exchanged, cameras moved, another rig's poses, no head's size.

Enters: silhouettes and the rig. Leaves: the views that agree, put right where one reading is certain, and warnings.
"""
