// Matching of one window between two views: what matching_kernels.py does, in single precision throughout.
// Compiled for SAMPLES of a window and at most VIEWS other views.

struct Way {
    float turn[9];  // from pixels here to pixels there, as Stack.homographies has it
    float shift[3];
    float noise;    // shades
    int start;      // of the view's first pixel
    int width;
    int height;
};

layout(local_size_x = 8, local_size_y = 8) in;
layout(std430, binding = 0) readonly buffer Pairs { uint pairs[]; };
layout(std430, binding = 1) readonly buffer Distances { float distance_px[]; };
layout(std430, binding = 2) readonly buffer Ways { Way ways[]; };
layout(std430, binding = 3) readonly buffer Pattern { vec2 pattern[]; };

uniform int start;        // of the first pixel of the view that is matched
uniform ivec2 size;       // its width and height
uniform int view_count;   // other views
uniform float noise;      // shades
uniform float contrast;   // shades at which a sample counts half
uniform float reach;      // the farthest that a sample lies from a window's middle, px

const float NO_SAY = 2.0, AGAINST = -1.0, BESIDE_PX = 2.0, WINDOW_PX = -1.0, UNSEEN_PX = -1e4, MIN_AREA = 0.05;
const float NEAREST_MM = 1.0, NOT_COMPARED = 1.0, ALONE = 0.15;

float window[SAMPLES], weight[SAMPLES];  // zero-mean shades about the pixel
float total, energy;                     // sums of the weights and of the weighted squares

struct Place {
    vec2 at;       // pixel in the other view
    vec2 by_x;     // its derivatives by the pixel here
    vec2 by_y;
    vec2 by_depth; // px / mm
};

void load_window(ivec2 pixel) {
    float centre = float(pairs[start + pixel.y * size.x + pixel.x] & 0xFFFFu);
    float falloff = 1.0 / (contrast * contrast), mean = 0.0;
    total = 0.0;
    for (int i = 0; i < SAMPLES; i++) {
        ivec2 at = clamp(pixel + ivec2(pattern[i]), ivec2(0), size - 1);
        int place = start + at.y * size.x + at.x;
        float value = float(pairs[place] & 0xFFFFu), off = value - centre;
        window[i] = value;
        weight[i] = distance_px[place] < WINDOW_PX ? 1.0 / (1.0 + off * off * falloff) : 0.0;
        total += weight[i];
        mean += weight[i] * value;
    }
    total = max(total, 1e-6);
    mean /= total;
    energy = 0.0;
    for (int i = 0; i < SAMPLES; i++) {
        window[i] -= mean;
        energy += weight[i] * window[i] * window[i];
    }
}

bool place_window(int k, float z, vec2 slope, vec2 pixel, out Place place) {
    vec3 column_x = vec3(ways[k].turn[0], ways[k].turn[3], ways[k].turn[6]);
    vec3 column_y = vec3(ways[k].turn[1], ways[k].turn[4], ways[k].turn[7]);
    vec3 ray = column_x * pixel.x + column_y * pixel.y + vec3(ways[k].turn[2], ways[k].turn[5], ways[k].turn[8]);
    float depth = z * ray.z + ways[k].shift[2];
    if (depth < NEAREST_MM) return false;
    float per = 1.0 / depth;
    place.at = (z * ray.xy + vec2(ways[k].shift[0], ways[k].shift[1])) * per;
    place.by_x = (slope.x * ray.xy + z * column_x.xy - place.at * (slope.x * ray.z + z * column_x.z)) * per;
    place.by_y = (slope.y * ray.xy + z * column_y.xy - place.at * (slope.y * ray.z + z * column_y.z)) * per;
    place.by_depth = (ray.xy - place.at * ray.z) * per;
    vec2 extent = reach * (abs(place.by_x) + abs(place.by_y));
    if (any(lessThan(place.at - extent, vec2(0.0)))) return false;
    if (any(greaterThan(place.at + extent, vec2(ways[k].width, ways[k].height) - 1.01))) return false;
    return place.by_x.x * place.by_y.y - place.by_y.x * place.by_x.y >= MIN_AREA;
}

float distance_there(int k, Place place) {
    ivec2 nearest = ivec2(place.at + 0.5);
    return distance_px[ways[k].start + nearest.y * ways[k].width + nearest.x];
}

// Four neighbours of a place in another view: top left, top right, bottom left, bottom right; and where between them.
vec4 neighbours(int k, Place place, int sample_number, out vec2 between) {
    vec2 at = place.at + place.by_x * pattern[sample_number].x + place.by_y * pattern[sample_number].y;
    ivec2 corner = ivec2(at);
    between = at - vec2(corner);
    int first = ways[k].start + corner.y * ways[k].width + corner.x;
    uint upper = pairs[first], lower = pairs[first + ways[k].width];
    return vec4(float(upper & 0xFFFFu), float(upper >> 16), float(lower & 0xFFFFu), float(lower >> 16));
}

float bilinear(vec4 four, vec2 between) {
    vec2 rows = mix(four.xz, four.yw, between.x);
    return mix(rows.x, rows.y, between.y);
}

float correlate(int k, Place place) {
    float first = 0.0, second = 0.0, product = 0.0;
    for (int i = 0; i < SAMPLES; i++) {
        vec2 between;
        vec4 four = neighbours(k, place, i, between);
        float value = bilinear(four, between), weighted = weight[i] * value;
        first += weighted;
        second += weighted * value;
        product += weighted * window[i];
    }
    float spread = max(second - first * first / total, 0.0);
    float theirs = total * ways[k].noise * ways[k].noise;
    return product * inversesqrt((energy + total * noise * noise) * (spread + theirs));
}

float match(int k, float z, vec2 slope, vec2 pixel) {
    Place place;
    if (!place_window(k, z, slope, pixel, place)) return NO_SAY;
    float beside = distance_there(k, place);
    if (beside < UNSEEN_PX) return NO_SAY;
    if (beside > BESIDE_PX) return AGAINST;
    return correlate(k, place);
}

// 1 minus the mean of the better half of the likenesses, of two at least: the others may be hidden.
float cost_of(float z, vec2 slope, vec2 pixel) {
    float scores[VIEWS];
    int count = 0;
    for (int k = 0; k < view_count; k++) {
        float score = match(k, z, slope, pixel);
        if (score == AGAINST) return 1.0 - AGAINST;
        if (score >= NO_SAY) continue;
        int j = count;  // insertion sort, falling
        while (j > 0 && scores[j - 1] < score) {
            scores[j] = scores[j - 1];
            j--;
        }
        scores[j] = score;
        count++;
    }
    if (count == 0) return NOT_COMPARED;
    int kept = min(max((count + 1) / 2, 2), count);
    float mean = 0.0;
    for (int i = 0; i < kept; i++) mean += scores[i];
    return 1.0 - mean / float(kept) + (count == 1 ? ALONE : 0.0);
}
