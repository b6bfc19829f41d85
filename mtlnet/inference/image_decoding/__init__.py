"""Decodes images from untrusted sources; checks structure and limits before pixels are decoded."""
