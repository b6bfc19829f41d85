in vec2 picture;
in vec3 light;
in vec4 air;
uniform sampler2D atlas;
void main() {
    vec4 leaf = texture(atlas, picture, -0.7);
#ifdef CORE
    if (leaf.a < 0.97) discard;
#else
    if (leaf.a < max(0.04, LEAST_ALPHA)) discard;
#endif
#ifdef SNOW
    vec3 bright = leaf.rgb * leaf.rgb;
    float lies = smoothstep(0.30, 0.62, dot(leaf.rgb, vec3(0.4)) + 0.10 * (1.0 - fract(picture.y * 2.0)));
    leaf.rgb = sqrt(mix(bright * 0.8, vec3(0.62), lies * (0.35 + 0.5 * horizon.w)));
#endif
    OUTPUT(vec4(sqrt(leaf.rgb * leaf.rgb * light * air.w + air.rgb), leaf.a), OBJECT);
}
