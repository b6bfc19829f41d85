"""Augmentation of training images and their labels."""
