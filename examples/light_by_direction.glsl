// Irradiance on a surface with a normal map, from a light map with light by direction (docs/guide.md, "Normal maps").
//
// Any version of GLSL from 1.10 on, ESSL and Vulkan's included: functions without textures, for code that has read these
// in its own way. Half floats: read L0 and L1 from textures of BK_FORMAT_RGBA16F and call irradiance_on. 8 bits: read E
// and L0 from half floats, the three ratios from textures of BK_FORMAT_RGBA8, and call irradiance_on_ratios.

vec3 irradiance_on(vec3 E, vec3 L0, vec3 L1x, vec3 L1y, vec3 L1z, vec3 n, vec3 m) {
    const float PI = 3.14159265;
    float cosine = dot(n, m);
    vec3 tilt = m - cosine * n;
    vec3 side = 4.0 * PI * (tilt.x * L1x + tilt.y * L1y + tilt.z * L1z);
    vec3 in_front = max(cosine * E + side, 0.0);
    vec3 len = sqrt(L1x * L1x + L1y * L1y + L1z * L1z);
    vec3 spread = clamp(2.0 - 2.0 * len / max(L0, 1e-12), 0.0, 1.0);
    vec3 opposite = 8.0 * PI * L0 - 3.0 * E - 1.5 * side / max(length(tilt), 1e-4);
    return in_front + 0.5 * (1.0 - cosine) * spread * max(opposite, 0.0);
}

// The same with L1 / L0 from 8-bit textures, BK_LAYER_RATIO_X to _Z: each 0.5 + 0.5 times the ratio.
vec3 irradiance_on_ratios(vec3 E, vec3 L0, vec3 x, vec3 y, vec3 z, vec3 n, vec3 m) {
    return irradiance_on(E, L0, L0 * (2.0 * x - 1.0), L0 * (2.0 * y - 1.0), L0 * (2.0 * z - 1.0), n, m);
}

// The same with the dominant direction alone, BK_LAYER_DIRECTION in 8 bits, of light whose E is all that is read: one
// more texture than without normal maps instead of four.
vec3 irradiance_on_direction(vec3 E, vec3 direction, vec3 n, vec3 m) {
    const float PI = 3.14159265;
    vec3 d = 2.0 * direction - 1.0;
    vec3 L0 = E / (4.0 * PI * max(dot(d, n), 0.1));
    return irradiance_on(E, L0, d.x * L0, d.y * L0, d.z * L0, n, m);
}
