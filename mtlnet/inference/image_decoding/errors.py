"""The error for an image that cannot be used. `serve` maps its reason to an HTTP status."""

from enum import StrEnum

from trackfeatures.errors import UserError


class Fault(StrEnum):
    """The reasons why an image cannot be used."""

    NOT_AN_IMAGE = "not-an-image"
    DAMAGED = "damaged-image"
    UNSUPPORTED = "unsupported-image"
    SIZE = "image-size"
    ASPECT = "image-aspect"
    FIELD_OF_VIEW = "field-of-view"
    TRAILING = "trailing-bytes"


class ImageError(UserError):
    """Raised for an image that the model cannot use; `fault` is the reason."""

    def __init__(self, fault: Fault, message: str) -> None:
        super().__init__(message)
        self.fault = fault
