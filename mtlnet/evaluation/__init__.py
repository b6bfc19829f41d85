"""Evaluation of a model: metrics, report pages, the paper's protocol, and a user's own pictures."""
