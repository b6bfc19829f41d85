in vec2 picture;
in vec3 light;
in vec4 air;
out vec4 pixel;
uniform sampler2D atlas;
void main() {
    vec4 leaf = texture(atlas, picture, -0.7);
    if (leaf.a < 0.04) discard;
    pixel = vec4(sqrt(leaf.rgb * leaf.rgb * light * air.w + air.rgb), leaf.a);
}
