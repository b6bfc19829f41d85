"""The plan of a dataset: configuration, rounds, class balance, split."""
