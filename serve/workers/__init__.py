"""The worker processes: their start, end and replacement by the supervisor; what they share."""
