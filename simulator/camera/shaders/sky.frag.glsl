in vec3 ray;
void main() {
    vec3 direction = normalize(ray);
    float up = direction.z;
    float height = max(up, 0.0);
    vec3 colour = mix(horizon.rgb, zenith.rgb, 1.0 - exp2(-6.0 * height));
    // Towards the horizon the air thickens to haze, so that land and sky meet without a line.
    colour = mix(colour, haze.rgb, exp2(-28.0 * height * (0.00025 / (skylight.w + 0.00006))));
    float toward = max(dot(direction, sun.xyz), 0.0);
    if (zenith.w > 0.0 && up > 0.015) {
        vec2 place = direction.xy / (up + 0.09);
        vec4 puff = texture(noise, place * 0.035 + 0.37);
        vec4 shred = texture(noise, place * 0.19);
        float density = puff.g * 0.72 + shred.g * 0.28;
        float edge = 0.80 - 0.62 * zenith.w;
        float cover = smoothstep(edge, edge + 0.16, density) * smoothstep(0.015, 0.09, up);
        vec3 white = skylight.rgb * 0.75 + sunlight.rgb * 0.33;
        vec3 grey = skylight.rgb * 0.55 + sunlight.rgb * 0.08;
#if defined(RAIN) || defined(SNOW)
        // Low cloud: a grey ceiling without an edge, a little darker here and there.
        white = colour * 1.08;
        grey = colour * 0.80;
#endif
        colour = mix(colour, mix(white, grey, smoothstep(edge + 0.05, edge + 0.4, density)), cover * 0.9);
    }
    float glow = toward * toward;
    glow *= glow;
    glow *= glow;
    colour += sunlight.rgb * (0.10 * glow + 0.35 * pow(toward, 220.0) + 6.0 * smoothstep(0.99985, 0.99996, toward)) * (1.0 - zenith.w * 0.8);
    pixel = vec4(sqrt(colour * sunlight.w), 1.0);
}
