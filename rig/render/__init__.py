"""Draws images of meshes and runs compute shaders with OpenGL on EGL, through the library moderngl."""
