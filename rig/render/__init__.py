"""Draws with OpenGL on EGL; no other package uses moderngl."""
