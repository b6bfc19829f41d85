"""The scripted driver of a round and the trajectory that it follows."""
