"""Shows a recorded round in Rerun or as an HTML page."""
