"""Reading an image of unknown origin: structure first, then limits, then pixels."""
