"""Worker processes: start, end and replacement by the supervisor; their shared memory."""
