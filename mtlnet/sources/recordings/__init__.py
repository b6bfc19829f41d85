"""Reads pictures from recordings of other programs: MCAP files of Foxglove, and ROS 2 bags."""
