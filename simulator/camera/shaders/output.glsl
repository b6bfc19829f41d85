// Output of a fragment shader: colour, or with LABELS defined the pixel's depth and class.
#ifdef LABELS
out vec2 label;   // depth along the optical axis, m; number of the class
#define OUTPUT(colour, number) label = vec2(1.0 / gl_FragCoord.w, float(number))
#define LEAST_ALPHA 0.5
#else
out vec4 pixel;
#define OUTPUT(colour, number) pixel = colour
#define LEAST_ALPHA 0.0
#endif

// Share of the footprint [x - w/2, x + w/2] that lies in [low, high].
float covered(float x, float w, float low, float high) {
    return clamp((min(x + 0.5 * w, high) - max(x - 0.5 * w, low)) / w, 0.0, 1.0);
}

// The same for a pattern of period p that is 1 from 0 to a.
float repeated(float x, float w, float a, float p) {
    float low = (x - 0.5 * w) / p, high = (x + 0.5 * w) / p;
    float share = a / p;
    return (((floor(high) - floor(low)) * share) + min(fract(high), share) - min(fract(low), share)) * p / w;
}
