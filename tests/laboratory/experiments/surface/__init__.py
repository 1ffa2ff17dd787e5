"""Measures the whole visible surface: depth, hidden skin, relief, texture, light, templates."""
