"""The order in which frames are processed, and who may send how many."""
