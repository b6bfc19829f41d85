"""Decoding of images from untrusted sources: structure and limits are checked before pixels are
decoded."""
