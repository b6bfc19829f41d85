"""Records rounds in which a controller drives on a model's perception, as further training data."""
