in vec3 at;
in vec3 facing;
in float sunlit;
out vec2 world;
out vec2 lie;   // how level, how near
out vec2 reach;
out vec3 mist;
#ifdef SEA
out vec3 place;
#else
vec3 place;
#endif
void main() {
    place = at - eye.xyz;
    world = at.xy;
    lie = vec2(facing.z, nearness(place));
    see(place, facing, sunlit, reach, mist);
    gl_Position = clip * vec4(place, 1.0);
}
