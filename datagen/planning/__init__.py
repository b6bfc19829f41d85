"""Makes the plan of a dataset: options, rounds, class balance and split."""
