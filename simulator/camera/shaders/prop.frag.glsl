// One program a material (its name is defined): llvmpipe works out every branch of a shader.
in vec2 world;
in vec3 albedo;
in vec2 across;
in float upward;
in vec2 light_shares;
in vec3 air_light;

void main() {
    vec3 colour = albedo;
#if defined(FACADE) || defined(TILES) || defined(MASONRY) || defined(SNOW)
    vec4 rough = texture(noise, across * 0.07 + albedo.rg * 7.0);
#endif
#if defined(FACADE) || defined(TILES) || defined(CROWD) || defined(BOARD)
    vec2 w = fwidth(across) + 1e-4;
#endif
#ifdef STRIPED   // a marker post's dark band
    colour = mix(albedo, vec3(0.03), step(1.0, across.y) * step(across.y, 1.2));
#endif
#ifdef FACADE    // rows of windows, the lowest 1 m is plinth
    float window = repeated(across.x - 0.9, w.x, 1.2, 2.6) * repeated(across.y - 1.9, w.y, 1.4, 2.9) * step(1.2, across.y);
    colour = mix(albedo * (0.85 + 0.25 * rough.g), vec3(0.045, 0.06, 0.08), window);
#endif
#ifdef CROWD
    vec4 people = texture(noise, across * vec2(0.11, 0.13), -0.5);
    vec4 tint = texture(noise, across * vec2(0.043, 0.05) + 0.21, -0.5);
    colour = mix(vec3(0.10, 0.10, 0.11), vec3(people.r, tint.r, people.g) * 0.75, smoothstep(0.25, 0.55, people.r));
    colour *= 0.6 + 0.4 * repeated(across.y, w.y, 0.6, 0.9);
#endif
#ifdef BOARD     // a pale rim and lines of lettering
    vec2 rim = min(across, 1.0 - across);
    float frame = 1.0 - smoothstep(0.035, 0.05 + w.x, min(rim.x, rim.y * 0.7));
    float text = repeated(across.y - 0.16, w.y, 0.13, 0.3) * step(0.12, rim.x) * step(0.12, rim.y)
        * smoothstep(0.35, 0.5, texture(noise, vec2(across.x * 0.05 + albedo.r, floor(across.y / 0.3) * 0.37)).r);
    vec3 ink = dot(albedo, vec3(0.33)) > 0.3 ? vec3(0.03) : vec3(0.68);
    colour = mix(albedo, ink, max(frame, text));
#endif
#ifdef TILES
    colour = albedo * (0.7 + 0.45 * rough.g) * (0.8 + 0.2 * repeated(across.y, w.y, 0.22, 0.34));
#endif
#ifdef MASONRY   // and concrete
    vec4 stain = texture(noise, across * vec2(0.031, 0.017) + albedo.gb * 5.0);
    colour *= 0.62 + 0.38 * rough.g + 0.34 * stain.b;
#endif
#ifdef EARTH     // what lies round it
    colour = ground(world, texture(noise, world * 0.0083), texture(noise, world * 0.137), 0.5 + 0.5 * abs(upward), 1.0);
#endif
#ifdef LIT
    OUTPUT(display_values(vec3(2.0) * sunlight.w, air_light), OBJECT);
    return;
#endif
#if defined(SNOW) && !defined(FACADE) && !defined(CROWD)
    colour = snowed(colour, smoothstep(0.35, 0.6, upward + 0.1 * (rough.g - 0.5)));
#endif
    OUTPUT(display_values(light_at_eye(colour, light_shares, 1.0), air_light), OBJECT);
}
