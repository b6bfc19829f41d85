"""Lateral control of the simulated car: control laws, perception, closed-loop drives, training by
reinforcement learning, comparison, and the demo of the whole pipeline."""
