// Asphalt, verge and paint from (s, y); every edge is filtered over the pixel's footprint.
in vec3 place;
in vec2 track;
in vec2 world;
in vec3 normal;
in float kerb;
out vec4 pixel;
uniform sampler2D shade;

// Share of the footprint [x - w/2, x + w/2] that lies in [low, high].
float covered(float x, float w, float low, float high) {
    return clamp((min(x + 0.5 * w, high) - max(x - 0.5 * w, low)) / w, 0.0, 1.0);
}

// The same for a pattern of period p that is 1 from 0 to a.
float repeated(float x, float w, float a, float p) {
    float low = (x - 0.5 * w) / p, high = (x + 0.5 * w) / p;
    float filled = floor(high) - floor(low);
    float share = a / p;
    return ((filled * share) + min(fract(high), share) - min(fract(low), share)) * p / w;
}

float sunshine(vec2 at) {
    float column = at.x / mask.x;
    float band = floor(column / mask.z);
    vec2 texel = vec2(column - band * mask.z + 8.0, (at.y / mask.y + 64.0) + band * 128.0);
    vec2 size = vec2(textureSize(shade, 0));
    if (abs(at.y) > 62.0 * mask.y) return 1.0;
    return 1.0 - smoothstep(0.30, 0.70, texture(shade, texel / size, -1.2).r);
}

void main() {
    float s = track.x, y = track.y;
    vec2 sx = vec2(dFdx(s), dFdy(s)), yx = vec2(dFdx(y), dFdy(y));
    float ws = abs(sx.x) + abs(sx.y) + 1e-5;
    float wy = abs(yx.x) + abs(yx.y) + 1e-5;
    vec4 fine = texture(noise, world * 0.31);
    vec4 broad = texture(noise, track * vec2(0.0113, 0.041));
    float away = abs(y);

    // Asphalt: grain, stains, long patches, two tyre tracks a lane, cracks.
    float lane_left = lanes.x * 0.5 * lanes.y;
    float in_lane = mod(lane_left - y, lanes.y) - 0.5 * lanes.y;
    float track_off = abs(abs(in_lane) - 0.8);
    float worn = asphalt.w;
    float tone = 0.86 + 0.34 * (fine.r - 0.5) + (0.25 + 0.5 * worn) * (broad.g - 0.5) + 0.2 * (fine.g - 0.5);
    tone *= 1.0 - 0.14 * exp2(-8.0 * track_off * track_off) * step(away, lane_left);
    // Cracks from two layers of ridges of unlike scale, so that no tile repeats; thin, and few.
    float crack = smoothstep(0.90, 0.97, max(fine.a, broad.a - 0.02)) * smoothstep(0.50, 0.75, broad.b);
    tone *= 1.0 - 0.45 * soil.w * crack;
    vec3 colour = asphalt.rgb * max(tone, 0.2);
    float repair = smoothstep(0.66, 0.67 + 0.02 * ws, broad.b + 0.03 * fine.g) * worn;
    colour *= 1.0 - 0.28 * repair;

    // Paint: the nearest of the lines, its coverage, and what wear has left of it.
    float number = clamp(floor((lane_left - y) / lanes.y + 0.5), 0.0, lanes.x);
    float line_y = lane_left - number * lanes.y;
    float paint = covered(y, wy, line_y - left_line.w, line_y + left_line.w);
    bool divider = number > 0.5 && number < lanes.x - 0.5;
    if (divider) paint *= repeated(s, ws, dashes.x, dashes.y);
    float grit = fine.g * 0.55 + broad.g * 0.45;
    float left_over = 1.0 - line.w * (0.35 + 0.65 * smoothstep(0.40, 0.62, grit));
    float gap = smoothstep(1.0 - dashes.z - 0.03, 1.0 - dashes.z + 0.03, texture(noise, vec2(s * 0.0061, number * 0.23)).g);
    paint *= left_over * (1.0 - 0.92 * gap * step(0.001, dashes.z));
    vec3 paint_colour = number < 0.5 ? left_line.rgb : line.rgb;
    colour = mix(colour, paint_colour * (0.88 + 0.24 * fine.r), paint);

    // Beyond the asphalt: kerb, verge, meadow.
    float paved = covered(y, wy, -lanes.z, lanes.z);
    if (paved < 1.0) {
        float near = exp2(-0.0002 * dot(place, place));
        vec3 facing = normalize(normal);
        vec3 green = meadow(world, vec3(0.0, 0.0, 1.0), near);
        vec3 stones = verge.rgb * (0.6 + 0.5 * fine.r + 0.3 * broad.g);
        float ragged = lanes.w + 0.5 * (fine.g - 0.5);
        vec3 side = mix(green, mix(stones, green, verge.w), covered(y, wy + 0.25, -ragged, ragged));
        float on_kerb = kerb * covered(away, wy, lanes.z, lanes.z + 0.9);
        vec3 block = mix(vec3(0.62, 0.60, 0.57), vec3(0.50, 0.035, 0.03), repeated(s, ws, 1.0, 2.0));
        side = mix(side, block * (0.8 + 0.3 * fine.r), on_kerb);
        colour = mix(side, colour, paved);
    }
    pixel = finish(lit(colour, normalize(normal), mix(sun.w, 1.0, sunshine(track))), place);
}
