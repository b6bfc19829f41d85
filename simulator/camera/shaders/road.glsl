// Shadow lookup shared by asphalt and verge.
uniform sampler2D shade;

// The shadow mask at a place on the track.
vec4 shade_at(vec2 at) {
    float column = at.x / mask.x;
    float band = floor(column / mask.z);
    float row = clamp(at.y / mask.y + 0.5 * mask.w, 1.0, mask.w - 1.0);
    vec2 texel = vec2(column - band * mask.z + 8.0, row + band * mask.w);
    vec2 size = vec2(textureSize(shade, 0));
    return texture(shade, texel / size, -1.2);
}

// Share of the sun at a place on the track.
float sunshine(vec2 at) {
    return mix(1.0, sun.w, smoothstep(0.30, 0.70, shade_at(at).r));
}

#ifdef VARIED
// Shares of the sun's and the sky's light that bridges and trees leave.
vec2 light_left(vec2 at) {
    vec2 hidden = shade_at(at).rg;
    return vec2(mix(1.0, sun.w, smoothstep(0.30, 0.70, hidden.r)), 1.0 - 0.72 * hidden.g);
}
#endif

// Distance from the centre to the end of the asphalt on the side of y.
float asphalt_end(float y) {
#ifdef VARIED
    return y < 0.0 ? -sides.y : sides.x;
#else
    return lanes.z;
#endif
}

// Share of the footprint [y - wy/2, y + wy/2] that is asphalt.
float on_asphalt(float y, float wy) {
#ifdef VARIED
    return covered(y, wy, sides.y, sides.x);
#else
    return covered(y, wy, -lanes.z, lanes.z);
#endif
}
