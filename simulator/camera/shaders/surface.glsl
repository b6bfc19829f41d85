// The surface of varied roads at (s, y): asphalt or concrete, seams, tar, patches; and puddles.

// A number in [0, 1) for a whole number.
float random_of(float number) {
    float h = fract(number * 0.1031);
    h *= h + 33.33;
    h *= h + h;
    return fract(h);
}

// Share of a section that lies at s, 0 or 1, of the road's other material.
float other_material(float s, float ws) {
    float at = s / surface_tone.y + 7.0 * surface_repair.w;
    float here = step(random_of(floor(at)), 0.42);
    float before = step(random_of(floor(at) - 1.0), 0.42);
    return mix(before, here, clamp(fract(at) * surface_tone.y / ws, 0.0, 1.0)) * step(0.001, surface_tone.x);
}

// Tar in lengthwise seams and in cracks across the road: how much of the footprint it covers.
float tar_at(float s, float y, float ws, float wy, float wander) {
    float drift = 0.10 * wander;
    float seam = surface_joint.w;
    float along = covered(y + drift, wy, seam - 0.025, seam + 0.025)
        + covered(y - drift, wy, -0.6 * seam - 1.92, -0.6 * seam - 1.88);
    float cell = floor(s / 11.0);
    float crack_at = (cell + 0.2 + 0.6 * random_of(cell + 17.0)) * 11.0 + 1.3 * wander;
    float across = covered(s, ws, crack_at - 0.04, crack_at + 0.04) * step(random_of(cell + 5.0), 0.5);
    across *= step(-8.0 + 16.0 * random_of(cell + 31.0), y);
    return clamp(along + across, 0.0, 1.0) * surface_repair.x;
}

// Coverage by rectangular patches, one at most in a cell of 14 m by 2.6 m.
float patch_at(float s, float y, float ws, float wy) {
    vec2 cell = floor(vec2(s / 14.0, y / 2.6));
    float number = cell.x * 7.0 + cell.y * 131.0 + 400.0;
    vec2 size = vec2(1.5 + 11.0 * random_of(number + 1.0), 0.8 + 1.7 * random_of(number + 2.0));
    vec2 low = cell * vec2(14.0, 2.6) + vec2(random_of(number + 3.0), random_of(number + 4.0)) * (vec2(14.0, 2.6) - size);
    float cover = covered(s, ws, low.x, low.x + size.x) * covered(y, wy, low.y, low.y + size.y);
    return cover * step(random_of(number), 1.8 * surface_repair.y);
}

// Albedo of the road. `track_off`: distance from the nearest wheel track; `lane_side`: from the
// nearest side of a lane.
vec3 surface_at(float s, float y, float ws, float wy, vec4 fine, vec4 broad, float track_off, float lane_side) {
    vec3 colour = asphalt.rgb;
    float concrete = 0.0;
#ifdef SLABS
    float other = other_material(s, ws);
    colour *= mix(1.0, surface_tone.x, other);
    concrete = surface_joint.x > 0.5 ? 1.0 : surface_joint.x < -0.5 ? other : 0.0;
#endif
    float side = clamp((y - surface_joint.w) / wy + 0.5, 0.0, 1.0);
    colour *= 1.0 + surface_joint.z * (side - 0.5);

    float grain = surface_wear.y * mix(1.0, 0.7, concrete);
    float tone = 0.95 + grain * (0.34 * (fine.r - 0.5) + (0.12 + 0.35 * asphalt.w) * (broad.g - 0.5) + 0.2 * (fine.g - 0.5));
    tone *= 1.0 - surface_wear.x * exp2(-8.0 * track_off * track_off);
    float crack = smoothstep(0.90, 0.97, max(fine.a, broad.a - 0.02)) * smoothstep(0.50, 0.75, broad.b);
    tone *= 1.0 - 0.45 * soil.w * crack * (1.0 - 0.6 * concrete);
    colour *= max(tone, 0.2);

#ifdef SLABS
    // Slabs of concrete differ a little in tone; dirt lies in the joints between them.
    float slab = random_of(floor(s / surface_joint.y) + 50.0 * floor(lane_side + 20.0));
    float joint = max(repeated(s, ws, 0.025, surface_joint.y), covered(lane_side - floor(lane_side + 0.5), wy / lanes.y, -0.004, 0.004));
    colour *= mix(1.0, (0.92 + 0.16 * slab) * (1.0 - 0.55 * joint), concrete);
#endif
#ifdef REPAIRS
    colour *= mix(1.0, surface_repair.z, patch_at(s, y, ws, wy));
    colour = mix(colour, vec3(0.022), 0.9 * tar_at(s, y, ws, wy, broad.g - 0.5));
#endif
    return colour;
}

// Share of the footprint under water: hollows, most of them beside the wheel tracks.
float puddle_at(vec4 fine, vec4 broad) {
    float level = broad.b * 0.8 + broad.g * 0.15 + fine.g * 0.05;
    float least = 1.0 - surface_wear.z;
    return smoothstep(least, least + 0.03, level) * step(0.001, surface_wear.z);
}

// Light of the sky that a puddle mirrors to the eye at `place`.
vec3 mirrored_sky(vec3 place) {
    float grazing = 1.0 - clamp(-normalize(place).z, 0.0, 1.0);
    grazing *= grazing;
    return mix(zenith.rgb, horizon.rgb, grazing) * (0.03 + 0.75 * grazing * grazing);
}

// Coverage by what lies between asphalt and verge: kerb stones, or a strip of gravel.
float beside_asphalt(float away, float wy, float y) {
    float end = asphalt_end(y);
    return covered(away, wy, end, end + max(surface_edge.x, surface_edge.y)) * step(0.001, max(surface_edge.x, surface_edge.y));
}

// Its albedo: pale stones a metre long with dark joints, or grey grit.
vec3 edge_albedo(float s, float ws, float away, vec4 fine) {
    vec3 stones = vec3(0.36, 0.355, 0.34) * (0.85 + 0.3 * fine.g) * (1.0 - 0.5 * repeated(s, ws, 0.03, 1.0));
    vec3 grit = vec3(0.25, 0.235, 0.21) * (0.55 + 0.6 * fine.r + 0.3 * fine.g);
    return mix(grit, stones, step(0.001, surface_edge.y));
}

#ifdef NIGHT
// Light at the eye of ground at `place`: `sky_share` is that of `light_at_vertex`.
vec3 light_by_night(vec3 albedo, vec2 track, vec3 place, vec3 normal, float sky_share) {
    float left = exp2(-skylight.w * length(place)) * sunlight.w;
    vec3 lamps = lamp_light.rgb * lamps_on(track.x, track.y);
    vec3 head = sunlight.rgb * headlights_on(place, normalize(normal));
    return albedo * ((head + lamps) * left + skylight.rgb * sky_share);
}
#endif
