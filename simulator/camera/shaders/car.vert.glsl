in vec3 at;
in vec3 facing;
in vec3 colour;
out vec3 place;
out vec3 normal;
out vec3 albedo;
uniform mat4 stand;  // model matrix: car frame to eye-relative world
uniform vec3 paint;
void main() {
    place = (stand * vec4(at, 1.0)).xyz;
    normal = mat3(stand) * facing;
    albedo = colour.r < 0.0 ? paint : colour;
    gl_Position = clip * vec4(place, 1.0);
}
