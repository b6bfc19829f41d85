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
    vec3 light = lit(albedo, facing, 1.0) + reflection * sheen;
    light += sunlight.rgb * 0.5 * pow(max(dot(mirrored, sun.xyz), 0.0), 60.0);
    OUTPUT(to_display(light, place), CAR);
}
