in vec2 across;
in vec4 drop;
void main() {
    vec2 off = across * across;
    pixel = vec4(drop.rgb, drop.a * (1.0 - off.x) * (1.0 - off.y * off.y));
}
