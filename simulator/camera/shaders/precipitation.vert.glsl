// A drop or a flake: a quad along its path during the exposure, facing the camera.
in vec4 at;       // place in the box of air, 0 .. 1; w: how large it is
in vec2 corner;   // across -1 .. 1, along 0 .. 1
out vec2 across;
out vec4 drop;
uniform vec4 shift;
uniform vec4 streak;  // path during the exposure, m; w: side of the box, m
uniform vec3 shape;   // width, m; least width at 1 m, m; alpha
void main() {
    vec3 head = (fract(at.xyz + shift.xyz) - 0.5) * streak.w;
    vec3 way = streak.xyz;
    float distance = length(head);
    float wanted = shape.x * (0.55 + 0.9 * at.w);
    float drawn = max(wanted, shape.y * distance);
    vec3 side = normalize(cross(way, head) + vec3(1e-5)) * drawn * 0.5;
    // A quad is never shorter than it is wide.
    vec3 run = way * max(1.0, drawn / length(way));
    vec3 place = head + side * corner.x + run * (corner.y - 0.5);
    across = vec2(corner.x, corner.y * 2.0 - 1.0);
    float near = smoothstep(0.5, 1.2, distance) * (1.0 - smoothstep(0.38, 0.5, distance / streak.w));
    float strength = shape.z * near * min(1.0, wanted / drawn);
    drop = vec4(sqrt((skylight.rgb * 0.75 + horizon.rgb * 0.3) * sunlight.w), strength);
    gl_Position = clip * vec4(place, 1.0);
}
