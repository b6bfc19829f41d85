in vec2 at;
uniform sampler2D panorama;
void main() {
    pixel = texture(panorama, at);
}
