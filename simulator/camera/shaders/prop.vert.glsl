// Faces are plain, so all that light and air do to them is worked out at their corners.
in vec3 at;
in vec3 facing;
in vec3 colour;
in vec2 face;     // m along and up
out vec2 world;
out vec3 albedo;
out vec2 across;
out float upward;
out vec2 reach;
out vec3 mist;
void main() {
    vec3 place = at - eye.xyz;
    world = at.xy;
    albedo = colour;
    across = face;
    upward = facing.z;
    see(place, dot(facing, place) > 0.0 ? -facing : facing, 1.0, reach, mist);
    gl_Position = clip * vec4(place, 1.0);
}
