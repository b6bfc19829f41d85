"""The perception service: one driver-view image in, track features out."""
