// One camera a draw instance: rows of camera_from_world, lens, and the tile of the atlas that is its image.
in vec4 pose_x;
in vec4 pose_y;
in vec4 pose_z;
in vec4 projection;  // fx fy cx cy, pixels
in vec4 lens;        // k1 k2 p1 p2
in vec4 lens_more;   // k3, turning radius, radius past which the lens is continued linearly, near plane (mm)
in vec4 tile;        // left, top, width, height, pixels of the atlas
in vec2 depth_range; // clip-space z = x * depth + y

uniform vec2 atlas_size;

out float gl_ClipDistance[6];

vec3 to_camera(vec3 point) {
    vec4 p = vec4(point, 1.0);
    return vec3(dot(pose_x, p), dot(pose_y, p), dot(pose_z, p));
}

// Clip coordinates with w = depth, so that the hardware clips at the near plane and interpolates in perspective. All
// of it is homogeneous of degree one in the point: past `limit` the lens scales the point by its value there, which
// keeps points outside the image outside, and those behind the camera finite.
vec4 to_clip(vec3 camera) {
    float turning = lens_more.y, limit = lens_more.z, near = lens_more.w;
    vec2 normalised = camera.xy / max(camera.z, near);
    float radius = length(normalised);
    float within = min(1.0, limit / max(radius, 1e-12));
    vec2 c = normalised * within;
    float r2 = dot(c, c);
    float radial = 1.0 + r2 * (lens.x + r2 * (lens.y + r2 * lens_more.x));
    vec2 tangential = vec2(2.0 * lens.z * c.x * c.y + lens.w * (r2 + 2.0 * c.x * c.x),
                           lens.z * (r2 + 2.0 * c.y * c.y) + 2.0 * lens.w * c.x * c.y) / within;
    vec2 distorted = camera.xy * radial + tangential * max(camera.z, near);
    vec2 corner = projection.xy * distorted + (projection.zw + 0.5) * camera.z;  // from the tile's corner, times depth
    gl_ClipDistance[0] = corner.x;
    gl_ClipDistance[1] = tile.z * camera.z - corner.x;
    gl_ClipDistance[2] = corner.y;
    gl_ClipDistance[3] = tile.w * camera.z - corner.y;
    gl_ClipDistance[4] = camera.z - near;
    gl_ClipDistance[5] = (turning - radius) * max(camera.z, near);
    vec2 ndc = 2.0 * (tile.xy * camera.z + corner) / atlas_size - camera.z;
    return vec4(ndc, depth_range.x * camera.z + depth_range.y, camera.z);
}
