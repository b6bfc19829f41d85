"""Datasets in the formats of other trainers: WebDataset and LeRobot. Images are copied bytes."""
