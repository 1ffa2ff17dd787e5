#version 330
#include camera.glsl
in vec3 position;
in vec3 normal;
in vec3 colour;
uniform vec3 light_direction;  // towards the light; zero: along the line of sight
uniform float ambient;
centroid out vec3 shade;

void main() {
    vec3 camera = to_camera(position);
    vec3 seen = vec3(dot(pose_x.xyz, normal), dot(pose_y.xyz, normal), dot(pose_z.xyz, normal));
    vec3 towards = light_direction == vec3(0.0) ? -normalize(camera)
        : vec3(dot(pose_x.xyz, light_direction), dot(pose_y.xyz, light_direction), dot(pose_z.xyz, light_direction));
    shade = colour * (ambient + (1.0 - ambient) * max(dot(seen, towards), 0.0));
    gl_Position = to_clip(camera);
}
