"""The multi-task perception network: training, evaluation, export and inference."""
