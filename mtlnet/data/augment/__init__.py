"""Augmentation of training images, with labels that change accordingly."""
