in vec3 at;
in vec2 road;
in vec3 facing;
in float kerbed;
out vec3 place;
out vec2 track;
out vec2 world;
out vec3 normal;
out float kerb;
void main() {
    place = at - eye.xyz;
    world = at.xy;
    track = road;
    normal = facing;
    kerb = kerbed;
    gl_Position = clip * vec4(place, 1.0);
}
