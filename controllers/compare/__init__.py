"""Every controller on every track: one file of results, a table like the paper's, curves."""
