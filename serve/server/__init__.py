"""The HTTP server below ASGI, built on internals of uvicorn."""
