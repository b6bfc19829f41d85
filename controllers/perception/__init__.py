"""What a controller knows of the road: sources of perception, late and uncertain answers."""
