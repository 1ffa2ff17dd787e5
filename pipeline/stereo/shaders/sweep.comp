// sweep_kernels.sweep_view: the cost of every place between two surfaces; one invocation a pixel.
#include matching.glsl

layout(std430, binding = 4) readonly buffer Near { float near[]; };
layout(std430, binding = 5) readonly buffer Far { float far[]; };
layout(std430, binding = 6) readonly buffer Slopes { vec4 slopes[]; };  // of near by x and y, of far by x and y
layout(std430, binding = 7) readonly buffer Strides { int strides[]; };
layout(std430, binding = 8) writeonly buffer Costs { float costs[]; };

uniform int labels;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, size))) return;
    int p = pixel.y * size.x + pixel.x, first = p * labels;
    if (far[p] <= 0.0) {
        for (int d = 0; d < labels; d++) costs[first + d] = NOT_COMPARED;
        return;
    }
    load_window(pixel);
    int d = 0, before = 0;
    float value_before = 0.0;
    while (true) {
        float share = float(d) / float(labels - 1);
        float z = near[p] + share * (far[p] - near[p]);
        float value = cost_of(z, mix(slopes[p].xy, slopes[p].zw, share), vec2(pixel));
        for (int between = before + 1; between < d; between++)
            costs[first + between] = mix(value_before, value, float(between - before) / float(d - before));
        costs[first + d] = value;
        if (d == labels - 1) break;
        before = d;
        value_before = value;
        d = min(d + strides[p], labels - 1);
    }
}
