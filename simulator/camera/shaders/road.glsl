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
