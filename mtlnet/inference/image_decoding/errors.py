"""Why an image is not taken: one error with a kind, which `serve` maps to HTTP."""

from enum import StrEnum

from trackfeatures.errors import UserError


class Fault(StrEnum):
    """What is wrong with an image."""

    NOT_AN_IMAGE = "not-an-image"
    DAMAGED = "damaged-image"
    UNSUPPORTED = "unsupported-image"
    SIZE = "image-size"
    ASPECT = "image-aspect"
    FIELD_OF_VIEW = "field-of-view"
    TRAILING = "trailing-bytes"


class ImageError(UserError):
    """Bytes that are no image this model can read; `fault` says of which kind."""

    def __init__(self, fault: Fault, message: str) -> None:
        super().__init__(message)
        self.fault = fault
