"""The sensors of the paper's table, and how to declare more."""
