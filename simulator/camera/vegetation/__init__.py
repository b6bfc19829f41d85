"""Trees: where they stand, their textures and how they are drawn."""
