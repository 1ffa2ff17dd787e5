// refine_kernels.propagate: pixels of one colour of the chequerboard try the planes of their neighbours of the other
// colour; one invocation a pixel. What is read of others is never written in the same run.
#include matching.glsl

layout(std430, binding = 4) buffer Fresh { uint fresh[]; };
layout(std430, binding = 5) buffer Depths { float depths[]; };
layout(std430, binding = 6) buffer Slopes { vec2 slopes[]; };
layout(std430, binding = 7) buffer Costs { float costs[]; };
layout(std430, binding = 8) readonly buffer Steps { int steps[]; };

uniform int parity;
uniform int step_count;
uniform float same_mm;

const ivec2 SIDES[4] = ivec2[4](ivec2(1, 0), ivec2(-1, 0), ivec2(0, 1), ivec2(0, -1));

bool is_inside(ivec2 pixel) {
    return all(greaterThanEqual(pixel, ivec2(0))) && all(lessThan(pixel, size));
}

bool is_beside_fresh(ivec2 pixel) {
    for (int s = 0; s < step_count; s++)
        for (int side = 0; side < 4; side++) {
            ivec2 there = pixel + steps[s] * SIDES[side];
            if (is_inside(there) && fresh[there.y * size.x + there.x] != 0u) return true;
        }
    return false;
}

void main() {
    int row = int(gl_GlobalInvocationID.y);
    ivec2 pixel = ivec2(2 * int(gl_GlobalInvocationID.x) + (row + parity) % 2, row);
    if (!is_inside(pixel)) return;
    int p = pixel.y * size.x + pixel.x;
    float best = costs[p], best_z = depths[p];
    vec2 best_slope = slopes[p];
    bool known = best >= 0.0;
    if (best_z <= 0.0 || (known && !is_beside_fresh(pixel))) return;
    load_window(pixel);
    for (int candidate = known ? 1 : 0; candidate <= 4 * step_count; candidate++) {  // the first is the pixel's own
        ivec2 offset = ivec2(0);
        if (candidate > 0) offset = steps[(candidate - 1) / 4] * SIDES[(candidate - 1) % 4];
        ivec2 there = pixel + offset;
        if (!is_inside(there)) continue;
        int q = there.y * size.x + there.x;
        vec2 slope = candidate > 0 ? slopes[q] : best_slope, change = abs(slope - best_slope);
        float z = candidate > 0 ? depths[q] - dot(vec2(offset), slope) : best_z;
        if (candidate > 0) {
            if (depths[q] <= 0.0 || (known && fresh[q] == 0u)) continue;
            if (abs(z - best_z) < same_mm && change.x + change.y < same_mm) continue;
        }
        float value = cost_of(z, slope, vec2(pixel));  // called once: a driver writes it out wherever it stands
        if (candidate > 0 && value >= best) continue;
        best = value;
        best_z = z;
        best_slope = slope;
        if (candidate > 0) fresh[p] = 1u;
    }
    costs[p] = best;
    depths[p] = best_z;
    slopes[p] = best_slope;
}
