"""Drawing with OpenGL on EGL: the one room that knows moderngl."""
