in vec2 world;
in vec2 level_tufts;
in vec2 light_shares;
in vec3 air_light;
#ifdef SEA
in vec3 place;
#endif
void main() {
    vec4 broad = texture(noise, world * 0.0083);
    vec4 fine = texture(noise, world * 0.137);
    vec3 colour = ground(world, broad, fine, level_tufts.x, level_tufts.y);
#ifdef SEA
    float above = place.z + eye.z - grass.w;
    if (above < 0.02) {
        OUTPUT(to_display(water(world, place), place), GROUND);
        return;
    }
    colour = shore(colour, above, broad.g);
#endif
    OUTPUT(display_values(light_at_eye(colour, light_shares, 1.0), air_light), GROUND);
}
