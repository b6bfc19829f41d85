in vec3 direction;
in vec2 place;   // in the panorama
out vec2 at;
void main() {
    at = place;
    gl_Position = clip * vec4(direction * 1000.0, 1.0);
    gl_Position.z = 0.999999 * gl_Position.w;
}
