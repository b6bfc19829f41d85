// Paint of varied roads; every edge is filtered over the pixel's footprint (ws, wy).

// Share of the footprint that lies in a round dot of 0.1 m, `apart` m from dot to dot, at y = 0.
float dots(float s, float y, float ws, float wy, float apart) {
    float along = (fract(s / apart) - 0.5) * apart;
    // Dots finer than the footprint are a faint line.
    float width = max(max(ws, wy), 0.02);
    float one = clamp((0.05 - length(vec2(along, y))) / width + 0.5, 0.0, 1.0) * min(0.1 / wy, 1.0);
    return mix(one, 0.08 / apart * min(0.1 / wy, 1.0), smoothstep(0.25, 1.0, ws / apart));
}

// Colour (rgb) and coverage (a) of the lines of marking `number` at (s, y).
vec4 paint_of_lines(float s, float y, float ws, float wy, float number) {
    vec4 found = vec4(0.0);
    int first = LINES * int(number);
    for (int k = first; k < first + LINES; k++) {
        vec4 place = line_place[k];
        if (place.y < 0.0) break;
        vec4 paint = line_paint[k];
        float cover = covered(y, wy, place.x - place.y, place.x + place.y);
        cover *= repeated(s, ws, place.z, place.w);
        if (paint.w > 0.0) cover = max(cover, dots(s, y - place.x, ws, wy, paint.w));
        found = mix(found, vec4(paint.rgb, 1.0), cover);
    }
    // Missing for some metres of every so many, at one marking or all of them.
    if (paint_gap.x > 0.0 && (paint_gap.z > 8.5 || abs(paint_gap.z - number) < 0.5))
        found.a *= 1.0 - repeated(s + paint_state.z * paint_gap.y, ws, paint_gap.x, paint_gap.y);
    return found;
}

// Coverage by an arrow that points along the road, its foot at (0, 0); turn: 1 left, -1 right.
float arrow(float along, float aside, float ws, float wy, float turn) {
    float w = max(wy, 1e-3);
    float shaft = covered(aside, w, -0.08, 0.08) * covered(along, ws, 0.0, turn == 0.0 ? 3.2 : 2.2);
    if (turn == 0.0) {
        float half_width = 0.38 * clamp((5.0 - along) / 1.8, 0.0, 1.0);
        return max(shaft, covered(aside, w, -half_width, half_width) * covered(along, ws, 3.2, 5.0));
    }
    float out_m = aside * turn;
    float arm = covered(out_m, w, -0.08, 0.5) * covered(along, ws, 1.9, 2.3);
    float reach = 1.1 * clamp((1.0 - out_m) / 0.5, 0.0, 1.0);
    float head = covered(out_m, w, 0.5, 1.0) * covered(along, ws, 2.1 - reach, 2.1 + reach);
    return max(max(shaft, arm), head);
}

// Arrows in the lanes and crosswalks: coverage, of the first line's white.
float paint_of_signs(float s, float y, float ws, float wy, float in_lane) {
    float cover = 0.0;
    if (paint_signs.x > 0.0) {
        float along = fract(s / paint_signs.x + paint_state.z) * paint_signs.x;
        if (along < 6.0) cover = arrow(along, in_lane, ws, wy, paint_signs.y);
    }
    if (paint_signs.z > 0.0) {
        float along = fract(s / paint_signs.z + 0.5 + paint_state.z) * paint_signs.z;
        // Bars along the road, half a metre wide, from edge to edge.
        float bars = repeated(y + 0.25, wy, 0.5, 1.0);
        cover = max(cover, bars * covered(along, ws, 2.0, 5.0));
    }
    return cover;
}
