// Shadow lookup shared by asphalt and verge.
uniform sampler2D shade;

// Share of the sun at a place on the track.
float sunshine(vec2 at) {
    float column = at.x / mask.x;
    float band = floor(column / mask.z);
    float row = clamp(at.y / mask.y + 0.5 * mask.w, 1.0, mask.w - 1.0);
    vec2 texel = vec2(column - band * mask.z + 8.0, row + band * mask.w);
    vec2 size = vec2(textureSize(shade, 0));
    return mix(1.0, sun.w, smoothstep(0.30, 0.70, texture(shade, texel / size, -1.2).r));
}

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
