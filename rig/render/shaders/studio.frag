#version 330
#include grain.glsl
centroid in vec3 shaded_normal;
centroid in vec3 to_eye;
centroid in vec3 grain_place;
centroid in vec4 painted;
centroid in vec3 received;
centroid in float oily;
uniform vec3 lamps[2];         // unit directions towards the lamps
uniform vec3 lamp_colours[2];
uniform float gloss;
out vec4 radiance;

// Two lobes of an oily surface: Blinn-Phong exponents of roughness 0.3 and 0.5 (2 / r^4 - 2), normalised, by Schlick's
// Fresnel factor of skin (0.028 at right angles); pores, which tilt the surface by a few degrees, break them up.
const vec2 LOBES = vec2(245.0, 30.0);
const vec2 SHARES = vec2(0.55, 0.45);
const float TILT = 0.10;

vec3 shine(vec3 n, vec3 eye) {
    vec3 bump = 2.0 * texture(noise, grain_place * fine_per_mm).rgb - 1.0;
    vec3 tilted = normalize(n + TILT * (bump - n * dot(bump, n)));
    vec3 sum = vec3(0.0);
    for (int i = 0; i < 2; i++) {
        vec3 middle = normalize(lamps[i] + eye);
        float along = max(dot(tilted, middle), 0.0), facing = max(dot(n, lamps[i]), 0.0);
        float fresnel = 0.028 + 0.972 * pow(1.0 - max(dot(middle, eye), 0.0), 5.0);
        vec2 lobes = SHARES * (LOBES + 8.0) / 8.0 * vec2(pow(along, LOBES.x), pow(along, LOBES.y));
        sum += lamp_colours[i] * fresnel * facing * (lobes.x + lobes.y);
    }
    return sum;
}

void main() {
    vec3 n = normalize(shaded_normal), eye = normalize(to_eye);
    float lit = clamp(2.0 * received.g, 0.0, 1.0);  // no glint in the shade
    vec3 glint = vec3(0.0);
    for (int i = 0; i < 2; i++)
        glint += lamp_colours[i] * pow(max(dot(n, normalize(lamps[i] + eye)), 0.0), 20.0);
    radiance = vec4(grained(grain_place, painted) * received + gloss * lit * glint, 1.0);
    if (oily > 0.0) radiance.rgb += oily * lit * shine(n, eye);
}
