in vec3 at;
in vec2 along;    // s, height over the ground; past the upper edge the way across the top is added
in float kind;
in vec3 facing;
out vec3 place;
out vec2 face;
out vec3 normal;
flat out float sort;
void main() {
    place = at - eye.xyz;
    face = along;
    normal = facing;
    sort = kind;
    gl_Position = clip * vec4(place, 1.0);
}
