"""Custom autograd functions that make training the paper's network faster on a CPU."""
