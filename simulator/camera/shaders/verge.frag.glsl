// Beside the asphalt: kerb, verge and the first metres of the meadow.
in vec2 track;
in vec2 world;
in vec2 kerb_tufts;
in vec2 light_shares;
in vec3 air_light;
in vec3 plain_asphalt;
#if defined(RAIN) || defined(VARIED)
in vec3 place;
in vec3 normal;
#endif
void main() {
    float s = track.x, y = track.y;
    float ws = fwidth(s) + 1e-5, wy = fwidth(y) + 1e-5;
    vec4 fine = texture(noise, world * 0.137);
    vec4 broad = texture(noise, world * 0.0083);
    float away = abs(y);
    vec3 green = ground(world, broad, fine, 1.0, kerb_tufts.y);
    vec3 stones = verge.rgb * (0.6 + 0.5 * fine.r + 0.3 * broad.g);
    float ragged = lanes.w + 0.5 * (fine.g - 0.5);
    vec3 side = mix(green, mix(stones, green, verge.w), covered(y, wy + 0.25, -ragged, ragged));
#ifdef VARIED
    side = mix(side, edge_albedo(s, ws, away, fine), beside_asphalt(away, wy, y));
#endif
    float on_kerb = kerb_tufts.x * covered(away, wy, asphalt_end(y), asphalt_end(y) + 0.9);
    vec3 block = mix(vec3(0.62, 0.60, 0.57), vec3(0.50, 0.035, 0.03), repeated(s, ws, 1.0, 2.0));
    side = mix(side, block * (0.8 + 0.3 * fine.r), on_kerb);
#ifdef SNOW
    side = snowed(side, 0.55 + 0.5 * horizon.w - 0.5 * fine.g + 0.3 * smoothstep(0.3, 1.5, away - asphalt_end(y)) - 0.5 * on_kerb);
#endif
    side = mix(side, plain_asphalt, on_asphalt(y, wy));
#if defined(VARIED) && !defined(NIGHT)
    vec2 shares = light_shares * light_left(track);
#define SUNNY 1.0
#else
    vec2 shares = light_shares;
#define SUNNY sunshine(track)
#endif
#ifdef NIGHT
    OUTPUT(display_values(light_by_night(side, track, place, normal, light_shares.y), air_light), GROUND);
#elif defined(RAIN) || defined(SNOW)
    OUTPUT(display_values(light_at_eye(side, shares, 1.0), air_light), GROUND);
#else
    OUTPUT(display_values(light_at_eye(side, shares, SUNNY), air_light), GROUND);
#endif
}
