// Faces are plain, so all that light and air do to them is worked out at their corners.
in vec3 at;
in vec3 facing;
in vec3 colour;
in vec2 face;     // m along and up
out vec2 world;
out vec3 albedo;
out vec2 across;
out float upward;
out vec2 light_shares;
out vec3 air_light;
void main() {
    vec3 place = at - eye.xyz;
    world = at.xy;
    albedo = colour;
    across = face;
    upward = facing.z;
    light_at_vertex(place, dot(facing, place) > 0.0 ? -facing : facing, 1.0, light_shares, air_light);
    gl_Position = clip * vec4(place, 1.0);
}
