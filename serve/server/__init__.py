"""The HTTP server that runs inside one worker process: its connections, built on uvicorn."""
