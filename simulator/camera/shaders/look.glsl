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
};
