#version 330
#include camera.glsl
in vec3 position;
in vec3 normal;
in vec3 place;
in vec4 paint;       // albedo, strength of the grain
in vec3 irradiance;
in float oil;
centroid out vec3 shaded_normal;
centroid out vec3 to_eye;
centroid out vec3 grain_place;
centroid out vec4 painted;
centroid out vec3 received;
centroid out float oily;

void main() {
    vec3 camera = to_camera(position);
    // Back into the world's axes: the rows of the rotation are its inverse's columns.
    to_eye = -(pose_x.xyz * camera.x + pose_y.xyz * camera.y + pose_z.xyz * camera.z);
    shaded_normal = normal;
    grain_place = place;
    painted = paint;
    received = irradiance;
    oily = oil;
    gl_Position = to_clip(camera);
}
