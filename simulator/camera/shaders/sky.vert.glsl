in vec3 direction;
in vec2 place;   // in the panorama
out vec3 ray;
void main() {
    ray = direction;
    gl_Position = vec4(place * 2.0 - 1.0, 0.0, 1.0);
}
