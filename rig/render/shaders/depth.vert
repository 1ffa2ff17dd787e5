#version 330
#include camera.glsl
in vec3 position;
out float depth;

void main() {
    vec3 camera = to_camera(position);
    depth = camera.z;
    gl_Position = to_clip(camera);
}
