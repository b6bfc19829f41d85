"""Generates datasets: a scripted driver drives in the simulator; each drive is one MCAP file."""
