"""The HTTP API: endpoints, request options, schemas, problems, and the web pages."""
