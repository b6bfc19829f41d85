"""Names that a dataset's files and the commands share: codecs of images, sides of a split."""

CODECS = ("jpeg", "png")
UNSEEN = "unseen"
SIDES = ("train", "test", UNSEEN)
"""Sides of a split. `unseen` has rounds on tracks that no model is trained on."""
MIDDLE = "middle"
"""The trajectory of the paper's drives: the middle of the middle lane. Training plans have none."""
PLACED = "placed"
"""The trajectory of rounds without a drive: in each frame the car stands at a random pose."""
POSES = ("driven", PLACED)
"""Values of `datagen collect --poses`."""
DRIVEN = "driven-"
"""Prefix of the ids of rounds that a controller drove on a model's answers."""
