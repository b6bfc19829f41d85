"""Processes that draw the pictures of many cars into shared memory."""
