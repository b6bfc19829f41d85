// Shared by all shaders. Colours are linear until to_display(); places are eye-relative world metres.
layout(std140) uniform Frame {
    mat4 clip;        // eye-relative world to clip space
    vec4 eye;         // place of the eye
    vec4 ahead;       // the optical axis
    vec4 sun;         // unit vector to the sun; w: light left in a hard shadow
    vec4 sunlight;    // light of the sun on a surface facing it; w: exposure
    vec4 skylight;    // light from above; w: extinction of the air, 1/m
    vec4 zenith;      // sky colours; w: share of cloud
    vec4 horizon;     // w: how wet or white the ground is
    vec4 haze;
    vec4 headlight;   // place of the car's headlights, eye-relative
    vec4 beam;        // unit vector along the car
};
layout(std140) uniform Scene {
    vec4 asphalt;     // w: how worn the surface is
    vec4 verge;       // w: how much of the verge is grass
    vec4 grass;       // w: level of the sea
    vec4 dry;
    vec4 soil;        // w: how cracked the asphalt is
    vec4 left_line;   // colour of the leftmost line; w: half of a line's width
    vec4 line;        // colour of the other lines; w: wear of the paint
    vec4 lanes;       // number, lane width, half the asphalt, edge
    vec4 dashes;      // length, period, share of missing paint, length of the track
    vec4 mask;        // shadow mask: metres a texel along s and y, texels and rows of a band
};
#ifdef SNOW
const vec3 WHITE = vec3(0.80, 0.82, 0.85);
#endif
uniform sampler2D noise; // r: grain, g: patches of some centimetres, b: broad patches, a: cracks

#ifdef NIGHT
float headlights_on(vec3 place, vec3 normal);
#endif

vec3 lit(vec3 albedo, vec3 normal, float sun_share, vec3 place) {
#ifdef NIGHT
    float direct = headlights_on(place, normal);
#else
    float direct = max(dot(normal, sun.xyz), 0.0) * sun_share;
#endif
    return albedo * (sunlight.rgb * direct + skylight.rgb * (0.62 + 0.38 * normal.z));
}

// Attenuation and scattering by the air, then display values: a square root approximates sRGB.
vec4 to_display(vec3 light, vec3 place) {
    float distance = length(place);
    float toward = max(dot(place, sun.xyz) / distance, 0.0);
    vec3 air = haze.rgb * (1.0 + 0.35 * sunlight.rgb * toward * toward * toward * toward);
    vec3 colour = mix(air, light, exp2(-skylight.w * distance)) * sunlight.w;
    return vec4(sqrt(colour), 1.0);
}

// The same for smooth ground, computed per vertex. light_shares: shares of the sun's (x) and the
// sky's (y) light on it that reach the eye; air_light: light scattered by the air in between.
void light_at_vertex(vec3 place, vec3 normal, float sun_share, out vec2 light_shares, out vec3 air_light) {
    float distance = length(place);
    float left = exp2(-skylight.w * distance) * sunlight.w;
    float toward = max(dot(place, sun.xyz) / distance, 0.0);
    toward *= toward;
#ifdef NIGHT
    float direct = headlights_on(place, normal);
#else
    float direct = max(dot(normal, sun.xyz), 0.0) * sun_share;
#endif
    light_shares = vec2(direct, 0.62 + 0.38 * normal.z) * left;
    air_light = haze.rgb * (1.0 + 0.35 * sunlight.rgb * toward * toward) * (sunlight.w - left);
}

// Light of smooth ground that arrives at the eye; `sunny`: share of sunlight left in shadow.
vec3 light_at_eye(vec3 albedo, vec2 light_shares, float sunny) {
    return albedo * (sunlight.rgb * (light_shares.x * sunny) + skylight.rgb * light_shares.y);
}

// Display values of that light with the air's light added.
vec4 display_values(vec3 light, vec3 air_light) {
    return vec4(sqrt(light + air_light), 1.0);
}

// Visibility of single tufts of grass: 1 at the eye, falling with the distance.
float tuft_visibility(vec3 place) {
    return exp2(-0.0002 * dot(place, place));
}

vec3 meadow(vec4 broad, vec4 fine, float level, float near) {
    float tuft = mix(0.5, fine.r * 0.5 + fine.g * 0.5, near);
    vec3 colour = mix(grass.rgb, dry.rgb, smoothstep(0.42, 0.72, broad.g * 0.6 + broad.b * 0.4));
    float bare = smoothstep(0.86, 0.70, level) + smoothstep(0.70, 0.80, fine.g * 0.4 + broad.b * 0.6);
    colour = mix(colour, soil.rgb, clamp(bare, 0.0, 1.0));
    return colour * (0.62 + 0.76 * tuft);
}
