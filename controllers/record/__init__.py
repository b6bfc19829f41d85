"""Rounds recorded while a controller drives on a model's perception: data for further training."""
