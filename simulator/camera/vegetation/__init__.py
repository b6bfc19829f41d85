"""Trees: their positions, their textures and how they are drawn."""
