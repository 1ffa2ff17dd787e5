#version 330
// A rectangle of blocks an instance: left, top, right, bottom.
in vec4 box;
uniform vec2 target_size;

void main() {
    vec2 corner = vec2((gl_VertexID & 1) == 0 ? box.x : box.z, (gl_VertexID & 2) == 0 ? box.y : box.w);
    gl_Position = vec4(2.0 * corner / target_size - 1.0, 0.0, 1.0);
}
