// Paint of varied roads at (s, y): rgb its colour, a its coverage of the footprint (ws, wy).
// `number`: the nearest marking; `whole`: 1 where none of the paint is worn.
vec4 paint_at(float s, float y, float ws, float wy, float number) {
    vec4 found = vec4(0.0);
    for (int k = 0; k < LINES; k++) {
        int at = LINES * int(number) + k;
        vec4 place = line_place[at], paint = line_paint[at];
        float cover = covered(y, wy, place.x - place.y, place.x + place.y);
        cover *= repeated(s, ws, place.z, place.w) * step(0.0, place.y);
        found = mix(found, vec4(paint.rgb, 1.0), cover);
    }
    return found;
}
