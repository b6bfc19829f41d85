"""Exports datasets to WebDataset and LeRobot; encoded images are copied unchanged."""
