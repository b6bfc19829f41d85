"""Speed control and steering law of the scripted drivers."""
