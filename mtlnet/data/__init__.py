"""Data for training and evaluation: rounds, labelled pictures, batches, augmentation."""
