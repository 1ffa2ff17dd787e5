#version 330
#include camera.glsl
in vec3 position;

void main() {
    gl_Position = to_clip(to_camera(position));
}
