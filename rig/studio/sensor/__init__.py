"""Turns the light of a scene into pictures: lens and sensor noise, deliberate faults, presets."""
