in vec3 place;
in vec2 face;
in vec3 normal;
flat in float sort;

void main() {
    float s = face.x, h = face.y;
#ifdef VARIED
    if (sort > 5.5 || abs(sort - 1.0) < 0.5) h /= barrier_shape.x;
#endif
    float ws = fwidth(s) + 1e-4, wh = fwidth(h) + 1e-4;
    vec4 fine = texture(noise, vec2(s * 0.31, h * 0.31));
    vec4 broad = texture(noise, vec2(s * 0.021, h * 0.05 + 0.3));
    vec3 facing = normalize(normal);
    if (dot(facing, place) > 0.0) facing = -facing;
    vec3 colour;
    float solid = 1.0;
    if (sort < 0.5) {            // steel rail on posts
        float beam = covered(h, wh, 0.46, 0.80);
        float post = repeated(s, ws, 0.12, 4.0) * covered(h, wh, -0.3, 0.72);
        solid = max(beam, post);
        float bulge = sin((h - 0.46) * 18.5);
        facing = normalize(facing + vec3(0.0, 0.0, 0.55 * bulge * beam));
        colour = mix(vec3(0.25), vec3(0.42, 0.43, 0.44) * (0.85 + 0.3 * broad.g), beam);
    } else if (sort < 1.5) {     // concrete
        colour = vec3(0.40, 0.39, 0.365) * (0.72 + 0.3 * broad.g + 0.22 * fine.g);
        colour *= 1.0 - 0.5 * repeated(s, ws, 0.05, 4.0) * step(h, 0.89);
        colour *= mix(0.7, 1.0, smoothstep(0.0, 0.35, h));
    } else if (sort < 2.5) {     // hedge
        colour = grass.rgb * vec3(0.62, 0.66, 0.6) * (0.45 + 1.1 * fine.g) * (0.6 + 0.4 * smoothstep(0.0, 1.2, h));
        facing = normalize(facing + vec3(0.0, 0.0, 0.8));
        solid = clamp(1.25 + (1.2 - h) * 8.0 - 4.0 * fine.r * step(h, 1.25), 0.0, 1.0);
    } else if (sort < 3.5) {     // boards
        float board = covered(h, wh, 0.30, 0.42) + covered(h, wh, 0.60, 0.72) + covered(h, wh, 0.90, 1.02);
        float post = repeated(s, ws, 0.14, 2.5) * step(h, 1.05);
        solid = clamp(max(board, post), 0.0, 1.0);
        colour = mix(vec3(0.21, 0.15, 0.10), vec3(0.46, 0.45, 0.42), step(0.5, fract(broad.b * 3.0)) * 0.2) * (0.7 + 0.5 * fine.g);
    } else if (sort < 4.5) {     // stones
        float row = floor(h / 0.19);
        vec2 joint = vec2(fract(s / 0.42 + row * 0.5), fract(h / 0.19));
        float grout = smoothstep(0.0, 0.10 + 2.0 * ws, joint.x) * smoothstep(0.0, 0.2 + 4.0 * wh, joint.y);
        colour = vec3(0.30, 0.275, 0.24) * (0.55 + 0.75 * fine.g) * mix(0.55, 1.0, grout);
#ifdef VARIED
    } else if (sort > 6.5) {     // a bank of ploughed snow
        colour = vec3(0.62, 0.64, 0.68) * (0.55 + 0.25 * broad.g + 0.35 * fine.g) * mix(0.75, 1.0, smoothstep(0.0, 0.5, h));
        facing = normalize(facing + vec3(0.0, 0.0, 0.7 + fine.g));
        solid = clamp(1.2 + (0.55 - h) * 8.0 - 2.5 * broad.r * step(h, 0.7), 0.0, 1.0);
    } else if (sort > 5.5) {     // crops, as high as they are dense
        vec4 stalk = texture(noise, vec2(s * 0.37 + 0.02 * broad.g, h * 0.17));
        colour = mix(grass.rgb, vec3(0.40, 0.31, 0.12), barrier_shape.y) * (0.5 + 0.4 * stalk.g + 0.35 * fine.r) * (0.5 + 0.5 * smoothstep(0.0, 1.0, h));
        facing = normalize(facing + vec3(0.0, 0.0, 1.0));
        solid = clamp(1.3 + (1.1 - h) * 6.0 - 3.0 * stalk.r * step(h, 1.12), 0.0, 1.0);
#endif
    } else {                     // stacked tyres, painted in blocks
        float bump = abs(fract(s / 0.65) - 0.5) * 2.0;
        float paint = repeated(s, ws, 6.5, 13.0);
        colour = mix(vec3(0.025), mix(vec3(0.5, 0.03, 0.03), vec3(0.62), paint), covered(h, wh, 0.32, 0.66));
        colour *= mix(0.55, 1.0, bump * exp2(-2.0 * ws) + 0.6 * (1.0 - exp2(-2.0 * ws)));
    }
#ifdef SNOW
    float top = sort > 5.5 ? 1.0 : sort < 0.5 ? 0.79 : sort < 1.5 ? 0.9 : sort < 2.5 ? 1.1 : sort < 3.5 ? 1.0 : sort < 4.5 ? 0.72 : 0.93;
    colour = snowed(colour, smoothstep(top - 0.03, top + 0.02, h + 0.12 * (fine.g - 0.5)) + smoothstep(0.12, -0.08, h + 0.15 * (fine.g - 0.5)));
#endif
    if (solid < max(0.12, LEAST_ALPHA)) discard;
    OUTPUT(vec4(to_display(lit(colour, facing, 0.9, place), place).rgb, solid), OBJECT);
}
