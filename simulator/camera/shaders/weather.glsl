// Effects of rain and snow on surfaces. Compiled in only with RAIN or SNOW defined.
#ifdef RAIN
// Reflection of the grey sky in the water film on a road.
vec3 mirrored(vec3 normal, vec3 place, float film, float rough) {
    vec3 view = normalize(place);
    float steep = clamp(-dot(view, normal), 0.0, 1.0);
    float grazing = 1.0 - steep;
    grazing *= grazing;
    float mirror = 0.03 + film * (0.10 * grazing + 0.50 * grazing * grazing);
    vec3 up = reflect(view, normal);
    // Vary the reflected sky sideways, as dark objects on the horizon would.
    float bank = texture(noise, normalize(up.xy) * 0.31 + rough * 0.02, 1.0).b;
    vec3 sky = mix(horizon.rgb, zenith.rgb, smoothstep(0.1, 0.9, up.z)) * (0.70 + 0.75 * bank);
    return sky * mirror;
}
#endif
#ifdef SNOW
vec3 snowed(vec3 albedo, float depth) {
    return mix(albedo, WHITE, clamp(depth, 0.0, 1.0));
}
#endif

// The meadow in the present weather: `level` is how level it lies (z of the normal).
vec3 ground(vec2 world, vec4 broad, vec4 fine, float level, float near) {
    vec3 colour = meadow(broad, fine, level, near);
#ifdef RAIN
    colour *= 0.72;
#endif
#ifdef SNOW
    vec4 tuft = texture(noise, world * 0.21);
    float field = texture(noise, world * 0.0171 + 0.4).g;
    float bare = smoothstep(0.60, 0.92, tuft.g * 0.35 + tuft.r * 0.15 + field * 0.5 + 0.28 * (1.0 - horizon.w)) * near;
    colour = snowed(colour, (0.97 - 0.75 * bare) * smoothstep(0.35, 0.62, level));
    colour *= 0.94 + 0.08 * texture(noise, world * 0.023).g;
#endif
    return colour;
}
