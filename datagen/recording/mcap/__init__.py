"""Reading and writing MCAP files, below the level of frames and labels."""
