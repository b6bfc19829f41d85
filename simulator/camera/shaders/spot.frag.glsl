in vec3 place;
in vec2 car;
uniform vec4 shadow_extent;

float box(vec2 at, vec2 half_size, float soft) {
    vec2 off = abs(at) - half_size;
    float outside = length(max(off, 0.0)) + min(max(off.x, off.y), 0.0);
    return clamp(0.5 - outside / soft, 0.0, 1.0);
}

void main() {
    float blur = 0.06 + 0.002 * dot(place, place) / 20.0;
    float contact = box(car, vec2(2.1, 0.85), 0.9);
    // Sun shadow: the body swept along the ray, in slices of height.
    float thrown = 0.0;
    for (int k = 0; k < 10; ++k) {
        float height = 0.22 + 0.08 * float(k);
        thrown = max(thrown, box(car - shadow_extent.xy * height, vec2(2.15, 0.85), blur));
    }
    thrown = max(thrown, box(car - shadow_extent.xy * 1.15 + vec2(0.4, 0.0), vec2(1.25, 0.7), blur));
    thrown = max(thrown, box(car - shadow_extent.xy * 1.38 + vec2(0.5, 0.0), vec2(0.65, 0.62), blur));
    float sunny = clamp(dot(sunlight.rgb, vec3(0.33)) * sun.z / (dot(sunlight.rgb, vec3(0.33)) * sun.z + dot(skylight.rgb, vec3(0.33))), 0.0, 1.0);
    // The picture holds square roots of light, so what is left is one too.
    float left = sqrt(1.0 - sunny * thrown) * (1.0 - 0.45 * contact);
    pixel = vec4(0.0, 0.0, 0.0, (1.0 - left) * exp2(-skylight.w * length(place)));
}
