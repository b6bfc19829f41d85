"""Scheduling: queues and the order of frames; limits on rate, memory and engine time of clients."""
