in vec2 world;
in vec2 lie;
in vec2 reach;
in vec3 mist;
#ifdef SEA
in vec3 place;
#endif
void main() {
    vec4 broad = texture(noise, world * 0.0083);
    vec4 fine = texture(noise, world * 0.137);
    vec3 colour = ground(world, broad, fine, lie.x, lie.y);
#ifdef SEA
    float above = place.z + eye.z - grass.w;
    if (above < 0.02) {
        SHOW(finish(water(world, place), place), GROUND);
        return;
    }
    colour = shore(colour, above, broad.g);
#endif
    SHOW(shown(reaching(colour, reach, 1.0), mist), GROUND);
}
