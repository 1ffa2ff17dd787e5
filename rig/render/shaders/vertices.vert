#version 330
// One point of the target a vertex, row by row: what the surface is worth there.
in vec3 place;
in vec4 paint;
in vec3 irradiance;
uniform vec2 target_size;
flat out vec3 grain_place;
flat out vec4 painted;
flat out vec3 received;

void main() {
    grain_place = place;
    painted = paint;
    received = irradiance;
    int row = gl_VertexID / int(target_size.x);
    vec2 at = vec2(gl_VertexID - row * int(target_size.x), row) + 0.5;
    gl_Position = vec4(2.0 * at / target_size - 1.0, 0.0, 1.0);
    gl_PointSize = 1.0;
}
