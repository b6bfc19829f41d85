"""`mtlnet ablate`: the paper's ablation table."""
