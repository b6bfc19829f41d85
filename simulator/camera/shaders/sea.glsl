// The shore: sand above the water's edge, and the sea itself, which is flat. Compiled in with SEA.
#ifdef SEA
vec3 water(vec2 world, vec3 place) {
    vec4 swell = texture(noise, world * 0.021);
    vec4 chop = texture(noise, world * 0.17);
    vec3 normal = normalize(vec3((swell.rg - 0.5) * 0.10 + (chop.gr - 0.5) * 0.16, 1.0));
    vec3 view = normalize(place);
    vec3 up = reflect(view, normal);
    float grazing = 1.0 - clamp(-dot(view, normal), 0.0, 1.0);
    float mirror = 0.03 + 0.45 * grazing * grazing * grazing;
    vec3 sky = mix(horizon.rgb, zenith.rgb, smoothstep(0.0, 0.5, up.z));
    vec3 deep = vec3(0.014, 0.075, 0.115) * (skylight.rgb + 0.4 * sunlight.rgb);
    float glitter = pow(max(dot(up, sun.xyz), 0.0), 120.0);
    return mix(deep, sky, mirror) + sunlight.rgb * glitter;
}

vec3 shore(vec3 colour, float above, float rough) {
    vec3 sand = mix(dry.rgb, vec3(0.46, 0.40, 0.29), 0.7) * (0.8 + 0.4 * rough);
    return mix(sand * mix(0.55, 1.0, smoothstep(0.1, 0.5, above)), colour, smoothstep(1.0, 2.2, above + rough));
}
#endif
