#version 330
#include grain.glsl
centroid in vec3 shaded_normal;
centroid in vec3 to_eye;
centroid in vec3 grain_place;
centroid in vec4 painted;
centroid in vec3 received;
uniform vec3 lamps[2];         // unit directions towards the lamps
uniform vec3 lamp_colours[2];
uniform float gloss;
out vec4 radiance;

void main() {
    vec3 n = normalize(shaded_normal), eye = normalize(to_eye);
    float lit = clamp(2.0 * received.g, 0.0, 1.0);  // no glint in the shade
    vec3 glint = vec3(0.0);
    for (int i = 0; i < 2; i++)
        glint += lamp_colours[i] * pow(max(dot(n, normalize(lamps[i] + eye)), 0.0), 20.0);
    radiance = vec4(grained(grain_place, painted) * received + gloss * lit * glint, 1.0);
}
