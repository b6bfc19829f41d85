"""Which camera took the pictures of a source: the one given, else what is known of the source.

Here a camera is found for `mtlnet predict` where the user gives none.
"""

from dataclasses import replace

from mtlnet.inference.rectification import Rectification
from mtlnet.predict.kinds import Kind
from mtlnet.predict.pictures import Lens
from mtlnet.predict.sources import Note, Source
from trackfeatures.camera import CameraParameters


def with_lens(source: Source, model: CameraParameters, given: Lens, note: Note) -> Source:
    """The source with its lens: the one given, else that of the camera that a recording states.

    `note`: takes a line on what was found.
    """
    if given is not None or source.kind is not Kind.RECORDING or source.opened is None:
        return replace(source, lens=given)
    from mtlnet.predict.recordings.cameras import is_models
    from mtlnet.predict.recordings.recording import Recording

    assert isinstance(source.opened, Recording)
    camera, about = source.opened.camera(model)
    if about:
        note(about)
    if camera is None or is_models(camera, model):
        return source
    return replace(source, lens=Rectification(camera, model))
