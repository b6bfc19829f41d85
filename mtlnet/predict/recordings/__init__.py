"""Pictures in recordings of other programs: Foxglove's MCAP files and ROS 2 bags."""
