"""Finds the subject in the photographs of a capture without clean plates and masks. The subject is the object at which
all cameras are directed.

``decide`` combines volume, colours, occupancy, and a plate guessed from the surroundings.
"""
