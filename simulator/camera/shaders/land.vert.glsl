in vec3 at;
in vec3 facing;
out vec3 place;
out vec3 normal;
out vec2 world;
void main() {
    place = at - eye.xyz;
    world = at.xy;
    normal = facing;
    gl_Position = clip * vec4(place, 1.0);
}
