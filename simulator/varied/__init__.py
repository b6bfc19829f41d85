"""Roads as they are: what a round or a scene of `--roads varied` is drawn with; see ranges.toml."""
