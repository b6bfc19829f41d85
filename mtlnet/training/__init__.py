"""Training: recipes, loss, optimizers, the training loop, and the run that trains a network by a
configuration."""
