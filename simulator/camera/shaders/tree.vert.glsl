// A tree is a billboard that turns to the camera about its trunk; from above, a flat crown.
in vec3 at;
in vec3 shape;   // width, height, cell of the atlas
in vec3 tint;
in vec2 corner;  // (-0.5 .. 0.5, 0 .. 1)
out vec2 picture;
out vec3 light;
out vec4 air;    // what the air adds, and what it leaves
invariant gl_Position;  // so that a tree's fringe does not fight with its core
void main() {
    vec3 foot = at - eye.xyz;
    vec3 place;
    float cell = shape.z;
    vec2 away = normalize(foot.xy + vec2(1e-4, 0.0));
    vec2 right = vec2(away.y, -away.x);
    if (ahead.z < -0.9) {
        cell = 6.0;
        place = foot + vec3(corner.x, corner.y - 0.5, 0.0) * shape.x + vec3(0.0, 0.0, 0.7 * shape.y);
    } else {
        place = foot + vec3(right * corner.x * shape.x, corner.y * shape.y);
    }
    picture = (vec2(mod(cell, 4.0), floor(cell / 4.0)) + vec2(corner.x + 0.5, 1.0 - corner.y)) / vec2(4.0, 2.0);
    float side = dot(sun.xy, right) * corner.x;
    float front = 0.5 - 0.5 * dot(sun.xy, away);
#ifdef NIGHT
    light = skylight.rgb * (0.45 + 0.4 * corner.y) + sunlight.rgb * 0.8 * headlights_on(place, vec3(-away, 0.0));
#else
    light = skylight.rgb * (0.45 + 0.4 * corner.y) + sunlight.rgb * (0.22 + 0.42 * front + 0.6 * side) * (0.6 + 0.4 * corner.y);
#endif
    light *= tint * sunlight.w;
    float distance = length(place);
    float left = exp2(-skylight.w * distance);
    float toward = max(dot(place, sun.xyz) / distance, 0.0);
    toward *= toward;
    air = vec4(haze.rgb * (1.0 + 0.35 * sunlight.rgb * toward * toward) * (1.0 - left) * sunlight.w, left);
    gl_Position = clip * vec4(place, 1.0);
}
