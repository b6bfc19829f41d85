"""The HTTP server of one worker process and its connections, built on uvicorn."""
