"""Traffic cars: intelligent driver model, lane changes, and cars that were hit."""
