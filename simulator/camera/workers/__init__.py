"""Worker processes that draw the pictures of many cars into shared memory."""
