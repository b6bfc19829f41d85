in vec3 at;
in vec3 facing;
in float sunlit;
out vec2 world;
out vec2 level_tufts;   // z of the normal, visibility of tufts
out vec2 light_shares;
out vec3 air_light;
#ifdef SEA
out vec3 place;
#else
vec3 place;
#endif
void main() {
    place = at - eye.xyz;
    world = at.xy;
    level_tufts = vec2(facing.z, tuft_visibility(place));
    light_at_vertex(place, facing, sunlit, light_shares, air_light);
    gl_Position = clip * vec4(place, 1.0);
}
