in vec3 place;
in vec3 normal;
in vec3 albedo;
void main() {
    // Both sides are drawn: turn the normal to the eye.
    vec3 facing = normalize(normal);
    if (dot(facing, place) > 0.0) facing = -facing;
    vec3 mirrored = reflect(normalize(place), facing);
    vec3 reflection = mix(haze.rgb * 0.35, horizon.rgb, smoothstep(-0.05, 0.25, mirrored.z));
    float sheen = 0.04 + 0.30 * pow(1.0 - abs(dot(facing, normalize(place))), 4.0);
    vec3 light = lit(albedo, facing, 1.0, place) + reflection * sheen;
#ifdef NIGHT   // its own lights are on, and number plates shine
    if (abs(albedo.r - 0.5) + albedo.g + albedo.b < 0.03) light = vec3(0.75, 0.03, 0.015);
    if (abs(albedo.r - 0.85) + abs(albedo.b - 0.78) < 0.01) light = vec3(2.5, 2.4, 2.1);
#else
    light += sunlight.rgb * 0.5 * pow(max(dot(mirrored, sun.xyz), 0.0), 60.0);
#endif
    OUTPUT(to_display(light, place), CAR);
}
