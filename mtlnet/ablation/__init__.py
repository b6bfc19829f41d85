"""`mtlnet ablate`: trains and evaluates the networks of the paper's ablation table."""
