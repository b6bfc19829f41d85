in vec3 at;
in vec2 road;
in vec3 facing;
in float kerbed;
out vec2 track;
out vec2 world;
out vec2 kerb_tufts;    // share of the kerb, visibility of tufts
out vec2 light_shares;
out vec3 air_light;
// What asphalt and verge take each other's colour for in the pixels that both cover.
out vec3 plain_asphalt;
out vec3 plain_verge;
#if defined(RAIN) || defined(VARIED)
out vec3 place;
out vec3 normal;
#else
vec3 place, normal;
#endif
void main() {
    place = at - eye.xyz;
    normal = facing;
    world = at.xy;
    track = road;
    kerb_tufts = vec2(kerbed, tuft_visibility(place));
    light_at_vertex(place, facing, 1.0, light_shares, air_light);
    plain_asphalt = asphalt.rgb * 0.86;
    plain_verge = mix(verge.rgb, mix(grass.rgb, dry.rgb, 0.3), verge.w);
#ifdef RAIN
    plain_asphalt *= 0.58 + 0.25 * (1.0 - horizon.w);
    plain_verge *= 0.86;
#endif
#ifdef SNOW
    plain_asphalt = mix(plain_asphalt, WHITE, 0.8);
    plain_verge = mix(plain_verge, WHITE, min(0.4 + 0.5 * horizon.w, 1.0));
#endif
    plain_verge = mix(plain_verge, vec3(0.53, 0.30, 0.28), kerbed);
    gl_Position = clip * vec4(place, 1.0);
}
