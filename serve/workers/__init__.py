"""The worker processes, their supervisor, and what they share."""
