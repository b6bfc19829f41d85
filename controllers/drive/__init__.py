"""A closed-loop drive: the loop, its disturbances, its film and its live page."""
