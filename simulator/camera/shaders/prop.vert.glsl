in vec3 at;
in vec3 facing;
in vec3 colour;
in vec3 surface;  // u, v, material
out vec3 place;
out vec3 normal;
out vec3 albedo;
out vec2 face;
flat out float material;
void main() {
    place = at - eye.xyz;
    normal = facing;
    albedo = colour;
    face = surface.xy;
    material = surface.z;
    gl_Position = clip * vec4(place, 1.0);
}
