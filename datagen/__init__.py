"""The dataset generator: a scripted AI driver records labelled rounds to MCAP."""
