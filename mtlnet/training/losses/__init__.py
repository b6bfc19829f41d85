"""The losses of the three tasks (distance, angle, class), and the weights of these losses."""
