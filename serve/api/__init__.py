"""The HTTP API: endpoints, request options, schemas and problems."""
