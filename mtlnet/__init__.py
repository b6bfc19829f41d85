"""The multi-task perception network: training, evaluation, export and the engine that runs it."""
