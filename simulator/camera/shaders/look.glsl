// What varied roads are drawn with; simulator/camera/scene/look_block.py fills it in this order.
#define MARKINGS 4
#define LINES 2
layout(std140) uniform Look {
    vec4 sides;                      // left and right end of the asphalt (y)
    vec4 line_place[MARKINGS * LINES];  // y of the middle, half width (none: < 0), dash, period
    vec4 line_paint[MARKINGS * LINES];  // colour; w: from one dot to the next, 0: no dots
    vec4 paint_state;                // wear, share of missing paint, phase
    vec4 paint_gap;                  // length, period, marking (9: all)
    vec4 sign_colour;                // of arrows and crosswalks
    vec4 paint_signs;                // from arrow to arrow, turn of arrows, from crosswalk to crosswalk
    vec4 surface_tone;               // of the other material against the first, mean section
    vec4 surface_joint;              // concrete (1: all, -1: the other), joints, halves, seam
    vec4 surface_repair;             // tar, patches, their tone, phase
    vec4 surface_wear;               // wheel tracks, grain, puddles, ragged edge
    vec4 surface_edge;               // widths of gravel and of kerb stones
    vec4 barrier_shape;              // factor on heights, ripeness of crops
    vec4 lamp_place;                 // from one street lamp to the next along s, y
    vec4 lamp_light;                 // on the road below a lamp
};
