in vec2 corner;
out vec3 ray;
void main() {
    ray = ray_corner.xyz + corner.x * ray_x.xyz + corner.y * ray_y.xyz;
    gl_Position = vec4(corner, 0.999999, 1.0);
}
