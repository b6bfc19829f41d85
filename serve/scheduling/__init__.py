"""Queues frames and chooses their order; limits rate, memory and engine time of clients."""
