"""Finds the subject of a capture that has neither clean plates nor masks: what all cameras are directed at, from the
photographs.

``decide`` combines: volume, colours, occupancy, and a plate guessed from the surroundings.
"""
