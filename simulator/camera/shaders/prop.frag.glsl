in vec3 place;
in vec3 normal;
in vec3 albedo;
in vec2 face;
flat in float material;

void main() {
    vec2 w = fwidth(face) + 1e-4;
    vec4 rough = texture(noise, face * 0.07 + albedo.rg * 7.0);
    vec3 facing = normalize(normal);
    if (dot(facing, place) > 0.0) facing = -facing;
    vec3 colour = albedo;
    if (material > 0.5 && material < 1.5) {         // facade: rows of windows, the lowest 1 m is plinth
        float window = repeated(face.x - 0.9, w.x, 1.2, 2.6) * repeated(face.y - 1.9, w.y, 1.4, 2.9) * step(1.2, face.y);
        colour = mix(albedo * (0.85 + 0.25 * rough.g), vec3(0.045, 0.06, 0.08), window);
    } else if (material < 2.5 && material > 1.5) {  // crowd
        vec4 people = texture(noise, face * vec2(0.11, 0.13), -0.5);
        vec4 tint = texture(noise, face * vec2(0.043, 0.05) + 0.21, -0.5);
        colour = mix(vec3(0.10, 0.10, 0.11), vec3(people.r, tint.r, people.g) * 0.75, smoothstep(0.25, 0.55, people.r));
        colour *= 0.6 + 0.4 * repeated(face.y, w.y, 0.6, 0.9);
    } else if (material < 3.5 && material > 2.5) {  // board: a pale rim and lines of lettering
        vec2 rim = min(face, 1.0 - face);
        float frame = 1.0 - smoothstep(0.035, 0.05 + w.x, min(rim.x, rim.y * 0.7));
        float text = repeated(face.y - 0.16, w.y, 0.13, 0.3) * step(0.12, rim.x) * step(0.12, rim.y)
            * smoothstep(0.35, 0.5, texture(noise, vec2(face.x * 0.05 + albedo.r, floor(face.y / 0.3) * 0.37)).r);
        vec3 ink = dot(albedo, vec3(0.33)) > 0.3 ? vec3(0.03) : vec3(0.68);
        colour = mix(albedo, ink, max(frame, text));
    } else if (material < 4.5 && material > 3.5) {  // marker post
        colour = mix(albedo, vec3(0.03), step(1.0, face.y) * step(face.y, 1.2));
    } else if (material > 6.5) {                    // earth: what lies round it
        vec2 world = place.xy + eye.xy;
        colour = ground(world, texture(noise, world * 0.0083), texture(noise, world * 0.137), 0.5 + 0.5 * facing.z, 1.0);
    } else if (material > 5.5) {                    // concrete, masonry
        vec4 stain = texture(noise, face * vec2(0.031, 0.017) + albedo.gb * 5.0);
        colour *= 0.62 + 0.38 * rough.g + 0.34 * stain.b;
    } else if (material > 4.5) {                    // tiles
        colour = albedo * (0.7 + 0.45 * rough.g) * (0.8 + 0.2 * repeated(face.y, w.y, 0.22, 0.34));
    }
#ifdef SNOW
    if (material < 1.5 || material > 2.5) colour = snowed(colour, smoothstep(0.35, 0.6, normalize(normal).z + 0.1 * (rough.g - 0.5)));
#endif
    SHOW(finish(lit(colour, facing, 1.0), place), OBJECT);
}
