"""The models that ship with the program: the folder of the default weights, and the hashes of all
files."""

from pathlib import Path

SHIPPED = Path(__file__).parents[1] / "weights" / "default"
"""Folder of the model that is used by default."""
DEFAULT_FILES = {
    "model.safetensors": "6894e11c0211330c33c3018ce9479bcd39e5d4151237dd6a2c46c5a07e35ef8b",
    "model.xml": "2b2eab26bd9d92f02c107ac395f6a30b80355fcf23da28810af10c0185885c4b",
    "model.bin": "c29fa70baad6ab421c4dcbd9d0dd9a25dfed741cf77b11d526ef2f08fbdd7208",
    "uncertainty.safetensors": "3a4e5a467545445e2e87eb5b96cf414b38ed8bbaa8ceb8d384218d6f628a8717",
}
VARIED_FILES = {
    "model.safetensors": "2ac2cd4e24ae98ba6ab029cc8cd6974b95ea00313a615f9fd1e76b58e846db8e",
    "model.xml": "2b2eab26bd9d92f02c107ac395f6a30b80355fcf23da28810af10c0185885c4b",
    "model.bin": "ed15fca3e3c1e5f3c503dd18ec28a90c57c9fb249da7d56b78e6e88a510589dd",
    "uncertainty.safetensors": "2042be0acae0688c300afcb1069cef27853c20fabd7c941e76bd6d159804ae3a",
}
SHIPPED_FILES = {"default": DEFAULT_FILES, "varied": VARIED_FILES}
"""SHA-256 of the files of each shipped model, by its name."""
