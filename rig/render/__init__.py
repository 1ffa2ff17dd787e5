"""Drawing meshes into calibrated, distorted views with OpenGL on EGL; the only place that knows of OpenGL."""
