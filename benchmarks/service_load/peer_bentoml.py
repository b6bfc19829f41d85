"""The model behind BentoML, set up as its manual shows for a raw image body.

`bentoml serve` runs this file.
"""

from pathlib import Path
from typing import Annotated, Any

import bentoml
from bentoml.validators import ContentType

from benchmarks.service_load.peer_work import Work, workers


@bentoml.service(workers=workers(), traffic={"timeout": 30}, logging={"access": {"enabled": False}})
class Features:
    """The service with POST /features, which answers a JPEG."""

    def __init__(self) -> None:
        self.work = Work()

    @bentoml.api(route="/features")
    def features(self, image: Annotated[Path, ContentType("image/jpeg")], /) -> dict[str, Any]:
        return self.work(image.read_bytes())
