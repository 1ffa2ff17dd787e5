// refine_kernels.slide: one step of least squares on the depth of every pixel; one invocation a pixel.
#include matching.glsl

layout(std430, binding = 4) readonly buffer Depths { float depths[]; };
layout(std430, binding = 5) readonly buffer Slopes { vec2 slopes[]; };
layout(std430, binding = 6) writeonly buffer Results { vec4 results[]; };  // place mm, information 1 / mm^2, likeness

uniform float most_px;

const float MIN_CORRELATION = 0.3, BEHIND_BEST = 0.35;

// Correlation, and gradient (1 / mm) and information (1 / mm^2) of the depth: matching_kernels.correlate_and_slide.
vec3 correlate_and_slide(int k, Place place) {
    float s_k = 0.0, s_j = 0.0, s_kk = 0.0, s_kj = 0.0, s_jj = 0.0, s_kr = 0.0, s_jr = 0.0;
    for (int i = 0; i < SAMPLES; i++) {
        vec2 between;
        vec4 four = neighbours(k, place, i, between);
        float value = bilinear(four, between);
        float across = mix(four.y - four.x, four.w - four.z, between.y);
        float along = mix(four.z - four.x, four.w - four.y, between.x);
        float slope = place.by_depth.x * across + place.by_depth.y * along;
        float wk = weight[i] * value, wj = weight[i] * slope;
        s_k += wk;
        s_j += wj;
        s_kk += wk * value;
        s_kj += wk * slope;
        s_jj += wj * slope;
        s_kr += wk * window[i];
        s_jr += wj * window[i];
    }
    float theirs = total * ways[k].noise * ways[k].noise;
    float kk = max(s_kk - s_k * s_k / total, 0.0) + theirs;
    float kj = s_kj - s_k * s_j / total;
    float jj = max(s_jj - s_j * s_j / total, 0.0);
    float gain = s_kr / kk;
    float mine = total * noise * noise;
    float variance = (max(energy - gain * s_kr, 0.0) + mine + gain * gain * theirs) / total;
    return vec3(s_kr * inversesqrt((energy + mine) * kk), gain * (s_jr - gain * kj) / variance,
                gain * gain * max(jj - kj * kj / kk, 0.0) / variance);
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, size))) return;
    int p = pixel.y * size.x + pixel.x;
    float z = depths[p];
    results[p] = vec4(z, 0.0, 0.0, 0.0);
    if (z <= 0.0) return;
    load_window(pixel);
    vec3 found[VIEWS];
    float best = 0.0, fastest = 0.0;
    int count = 0;
    for (int k = 0; k < view_count; k++) {
        Place place;
        if (!place_window(k, z, slopes[p], vec2(pixel), place)) continue;
        float beside = distance_there(k, place);
        if (beside > 0.0 || beside < UNSEEN_PX) continue;
        found[count] = correlate_and_slide(k, place);
        best = max(best, found[count].x);
        fastest = max(fastest, dot(place.by_depth, place.by_depth));
        count++;
    }
    vec3 sum = vec3(0.0);
    int spoke = 0;
    for (int k = 0; k < count; k++)
        if (found[k].x > MIN_CORRELATION && found[k].x > best - BEHIND_BEST) {
            sum += found[k];
            spoke++;
        }
    if (spoke == 0 || sum.z <= 0.0) return;
    float most = most_px * inversesqrt(fastest);
    float contrast_share = max(1.0 - total * noise * noise / max(energy, 1e-6), 0.0);
    results[p] = vec4(z + clamp(sum.y / sum.z, -most, most), sum.z * contrast_share, sum.x / float(spoke), 0.0);
}
