"""Training: recipes, loss, optimizers, the training loop, and a run from options to model."""
