// Fine structure of a surface: two octaves of a repeated noise volume, as a function of place on the subject, so that
// all views agree on it. Brightness varies; the strongest cells of the coarse octave are freckles.
uniform sampler3D noise;      // 64^3 cells of independent values
uniform vec3 coarse_per_mm;   // texture coordinates a mm
uniform vec3 fine_per_mm;
uniform vec4 coarse_weights;
uniform vec4 fine_weights;
uniform float freckles;

vec3 grained(vec3 p, vec4 paint) {
    vec4 coarse = 2.0 * texture(noise, p * coarse_per_mm) - 1.0;
    vec4 fine = 2.0 * texture(noise, p * fine_per_mm) - 1.0;
    float brightness = 1.0 + paint.a * (dot(coarse_weights, coarse) + dot(fine_weights, fine));
    vec3 freckle = mix(vec3(1.0), vec3(0.62, 0.50, 0.45), freckles * smoothstep(0.5, 0.85, coarse.a));
    return max(paint.rgb * brightness, 0.003) * freckle;
}
