// The shadow of a car: a flat patch on the road under it, drawn out away from the sun.
in vec2 corner;   // (-1 .. 1)
out vec3 place;
out vec2 car;     // place on the ground in the car frame
uniform mat4 stand;
uniform vec4 shadow_extent;  // car frame: how far a shadow of height 1 runs (x, y); half sizes of the patch
uniform vec2 middle;
void main() {
    car = middle + corner * shadow_extent.zw;
    place = (stand * vec4(car, 0.02, 1.0)).xyz;
    // A little nearer, so that the road under it never shows through.
    gl_Position = clip * vec4(place * 0.994, 1.0);
}
