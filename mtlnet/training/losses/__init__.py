"""The losses of the tasks, and their weights."""
