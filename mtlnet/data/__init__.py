"""Training data: its sources, batches, and augmentation."""
