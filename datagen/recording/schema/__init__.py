"""Topics and messages of a recording, and the description of their fields."""
