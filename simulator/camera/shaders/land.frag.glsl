in vec3 place;
in vec3 normal;
in vec2 world;
out vec4 pixel;
void main() {
    float near = exp2(-0.012 * dot(place, place) / 60.0);
    vec3 facing = normalize(normal);
    pixel = finish(lit(meadow(world, facing, near), facing, 0.9), place);
}
