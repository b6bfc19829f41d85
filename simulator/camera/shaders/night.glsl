// Light by night. The sun's place in the uniforms is taken by the car's headlights: `sunlight` is
// the colour of their light, and their share of it at a place takes that of the sun.

// Share of the headlights' light on a face at `place` (eye-relative) with this normal.
float headlights_on(vec3 place, vec3 normal) {
    vec3 ray = place - headlight.xyz;
    float distance = length(ray);
    ray /= distance;
    vec3 right = normalize(vec3(beam.y, -beam.x, 0.0));
    float side = dot(ray, right), up = ray.z - beam.z;
    // A low beam: wide below its cut-off, which rises to the right; a little stray light above.
    float cut = 0.012 + 0.03 * clamp(side * 4.0, 0.0, 1.0);
    float below = smoothstep(cut + 0.02, cut - 0.03, up);
    float wide = exp2(-5.0 * side * side) * (0.8 + 0.2 * exp2(-30.0 * side * side));
    float low = 0.25 + 0.75 * exp2(-70.0 * up * up);
    float ahead_of = smoothstep(0.05, 0.55, dot(ray, beam.xyz));
    float facing = mix(max(-dot(ray, normal), 0.0), 0.55, step(0.8, normal.z));
    return ahead_of * wide * (0.03 + 0.97 * below * low) * facing / (1.0 + distance * distance / 260.0);
}

#ifdef VARIED
// Light of the street lamps on the road at (s, y), a share of that below a lamp.
float lamps_on(float s, float y) {
    if (lamp_place.x <= 0.0) return 0.0;
    float off = mod(s + 0.5 * lamp_place.x, lamp_place.x) - 0.5 * lamp_place.x;
    float across = (y - lamp_place.y) * (y - lamp_place.y) + 64.0;
    float far = lamp_place.x - abs(off);
    return 512.0 / pow(off * off + across, 1.5) + 512.0 / pow(far * far + across, 1.5);
}
#endif
