// Asphalt and the paint on it from (s, y); every edge is filtered over the pixel's footprint.
in vec2 track;
in vec2 world;
in vec2 light_shares;
in vec3 air_light;
in vec3 plain_verge;
#if defined(RAIN) || defined(VARIED)
in vec3 place;
in vec3 normal;
#endif
void main() {
    float s = track.x, y = track.y;
    float ws = fwidth(s) + 1e-5, wy = fwidth(y) + 1e-5;
    vec4 fine = texture(noise, world * 0.31);
    vec4 broad = texture(noise, track * vec2(0.0113, 0.041));
    float away = abs(y);

    // Asphalt: grain, stains, long patches, two tyre tracks a lane, cracks.
    float lane_left = lanes.x * 0.5 * lanes.y;
    float in_lane = mod(lane_left - y, lanes.y) - 0.5 * lanes.y;
    float track_off = abs(abs(in_lane) - 0.8);
#ifdef VARIED
    vec3 colour = surface_at(s, y, ws, wy, fine, broad, track_off, (lane_left - y) / lanes.y);
#else
    float worn = asphalt.w;
    float tone = 0.86 + 0.34 * (fine.r - 0.5) + (0.25 + 0.5 * worn) * (broad.g - 0.5) + 0.2 * (fine.g - 0.5);
    tone *= 1.0 - 0.14 * exp2(-8.0 * track_off * track_off) * step(away, lane_left);
    // Thin, sparse cracks from two noise layers of different scale: no tile visibly repeats.
    float crack = smoothstep(0.90, 0.97, max(fine.a, broad.a - 0.02)) * smoothstep(0.50, 0.75, broad.b);
    tone *= 1.0 - 0.45 * soil.w * crack;
    vec3 colour = asphalt.rgb * max(tone, 0.2);
    float repair = smoothstep(0.66, 0.67 + 0.02 * ws, broad.b + 0.03 * fine.g) * worn;
    colour *= 1.0 - 0.28 * repair;
#endif

    // Paint: coverage by the nearest line, reduced by wear.
    float number = clamp(floor((lane_left - y) / lanes.y + 0.5), 0.0, lanes.x);
#ifdef VARIED
    vec4 drawn = paint_of_lines(s, y, ws, wy, number);
    if (paint_signs.x + paint_signs.z > 0.0)
        drawn = mix(drawn, vec4(sign_colour.rgb, 1.0), paint_of_signs(s, y, ws, wy, in_lane) * step(away, lane_left));
    float paint = drawn.a, wear = paint_state.x, missing = paint_state.y;
    vec3 paint_colour = drawn.rgb;
#else
    float line_y = lane_left - number * lanes.y;
    float paint = covered(y, wy, line_y - left_line.w, line_y + left_line.w);
    bool divider = number > 0.5 && number < lanes.x - 0.5;
    if (divider) paint *= repeated(s, ws, dashes.x, dashes.y);
    float wear = line.w, missing = dashes.z;
    vec3 paint_colour = number < 0.5 ? left_line.rgb : line.rgb;
#endif
    float grit = fine.g * 0.55 + broad.g * 0.45;
    float left_over = 1.0 - wear * (0.35 + 0.65 * smoothstep(0.40, 0.62, grit));
    // No paint on the most repaired patches.
    float gap = smoothstep(1.0 - missing - 0.03, 1.0 - missing + 0.03, broad.b);
    gap *= step(0.001, missing);
    float visible = left_over * (1.0 - 0.92 * gap);
    paint *= visible;
    colour = mix(colour, paint_colour * (0.88 + 0.24 * fine.r), paint);

#ifdef RAIN
    // Water darkens the porous asphalt more than the paint on it, and stands in tracks and hollows.
    colour *= mix(0.58, 0.92, paint) + 0.25 * (1.0 - horizon.w);
    float film = horizon.w * (0.45 + 0.55 * smoothstep(0.45, 0.75, broad.g * 0.6 + broad.b * 0.4 + 0.25 * exp2(-10.0 * track_off * track_off)));
#endif
#ifdef SNOW
    // Wheels keep two tracks a lane clear; between them lies slush, deeper towards the side.
    float rut = smoothstep(0.16, 0.50, track_off + 0.30 * (broad.g - 0.5) + 0.10 * (fine.g - 0.5));
    float side_m = max(away - lane_left + 0.3, 0.0);
    float depth = 0.55 * fine.g + 0.45 * broad.b + 0.8 * horizon.w - 0.62 + 0.5 * smoothstep(0.0, 1.1, side_m);
    depth = smoothstep(0.0, 0.38, depth) * mix(rut, 1.0, smoothstep(0.2, 0.9, side_m));
    depth = max(depth, 0.10 * rut * horizon.w);
    depth *= 1.0 - 0.45 * paint;
    vec3 slush = mix(vec3(0.27, 0.275, 0.29), WHITE, smoothstep(0.45, 1.0, depth));
    colour = mix(colour * mix(0.78, 0.95, paint), slush * (0.9 + 0.2 * fine.r), min(depth * 1.15, 1.0));
#endif

#ifdef LABELS
    // The class at the pixel's centre: classes cannot be blended.
#ifdef VARIED
    // The length of the footprint is above the spacing of float32 at the end of a long lap.
    bool painted = paint_of_lines(s, y, 0.02, 1e-4, number).a > 0.5 && visible > 0.5;
#else
    bool painted = abs(y - line_y) < left_line.w && visible > 0.5;
    if (divider && fract(s / dashes.y) * dashes.y > dashes.x) painted = false;
#endif
    OUTPUT(pixel, painted ? MARKING : ROAD);
#else
#ifdef VARIED
    float inside = on_asphalt(y + sign(y) * surface_wear.w * (fine.g + broad.g - 1.0), wy);
#ifdef PUDDLES
    float water = puddle_at(fine, broad) * inside;
    colour *= 1.0 - 0.5 * water;
#endif
#else
    float inside = on_asphalt(y, wy);
#endif
    colour = mix(plain_verge, colour, inside);
#if defined(VARIED) && !defined(NIGHT)
    vec2 shares = light_shares * light_left(track);
#define SUNNY 1.0
#else
    vec2 shares = light_shares;
#define SUNNY sunshine(track)
#endif
#ifdef RAIN
    vec3 ripple = vec3((fine.rg - 0.5) * 0.05, 0.0);
#ifdef NIGHT
    vec3 light = light_by_night(colour * (1.0 + 1.3 * paint), track, place, normal, light_shares.y);
#else
    vec3 light = light_at_eye(colour, shares, 1.0);
#endif
    pixel = display_values(light + mirrored(normalize(normal + ripple), place, film * inside, fine.g) * shares.y, air_light);
#elif defined(NIGHT)
    pixel = display_values(light_by_night(colour * (1.0 + 1.3 * paint), track, place, normal, light_shares.y), air_light);
#elif defined(SNOW)
    pixel = display_values(light_at_eye(colour, shares, 1.0), air_light);
#else
    vec3 light = light_at_eye(colour, shares, SUNNY);
#ifdef PUDDLES
    light += mirrored_sky(place) * water * shares.y;
#endif
    pixel = display_values(light, air_light);
#endif
#endif
}
