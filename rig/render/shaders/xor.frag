#version 330
// The sum of w |S - Sm| over one block of 8 x 8 pixels. `signed_weight` is -w inside the input silhouette S and w
// outside. Blocks that the model leaves empty, or fills, are looked up: only its outline costs 64 weights.
uniform sampler2D model;
uniform sampler2D signed_weight;
uniform sampler2D block_sums;  // sum of w inside S, sum of w outside S
out float cost;

void main() {
    ivec2 block = ivec2(gl_FragCoord.xy);
    ivec2 first = block * 8;
    float covered = 0.0;
    for (int j = 0; j < 8; j++)
        for (int i = 0; i < 8; i++) covered += texelFetch(model, first + ivec2(i, j), 0).r;
    if (covered == 0.0) {
        cost = texelFetch(block_sums, block, 0).r;
    } else if (covered == 64.0) {
        cost = texelFetch(block_sums, block, 0).g;
    } else {
        cost = 0.0;
        for (int j = 0; j < 8; j++) {
            float row = 0.0;
            for (int i = 0; i < 8; i++) {
                ivec2 at = first + ivec2(i, j);
                float w = texelFetch(signed_weight, at, 0).r;
                row += (w < 0.0) != (texelFetch(model, at, 0).r > 0.5) ? abs(w) : 0.0;
            }
            cost += row;
        }
    }
}
