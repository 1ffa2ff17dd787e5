#version 330
#include grain.glsl
flat in vec3 grain_place;
flat in vec4 painted;
flat in vec3 received;
out vec4 radiance;

void main() {
    radiance = vec4(grained(grain_place, painted) * received, 1.0);
}
