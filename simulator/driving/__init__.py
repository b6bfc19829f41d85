"""Driving without an operator: speed control and the steering law of scripted cars."""
