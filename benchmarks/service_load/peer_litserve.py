"""The model behind LitServe, set up as its manual advises for speed: ZeroMQ queues, no batching.

The manual sends images as base64 in JSON. Here the body of a request is the JPEG itself, which
takes LitServe less time.
"""

from typing import Annotated, Any

import litserve
from fastapi import Body

from benchmarks.service_load.peer_work import Work, port, workers


class Features(litserve.LitAPI):
    """The API POST /features, which answers a JPEG."""

    def setup(self, device: str) -> None:
        self.work = Work()

    def decode_request(self, request: Annotated[bytes, Body(media_type="image/jpeg")]) -> bytes:
        return request

    def predict(self, x: bytes) -> dict[str, Any]:
        return self.work(x)

    def encode_response(self, output: dict[str, Any]) -> dict[str, Any]:
        return output


if __name__ == "__main__":
    server = litserve.LitServer(
        Features(api_path="/features"),
        accelerator="cpu",
        workers_per_device=workers(),
        fast_queue=True,
    )
    server.run(
        host="127.0.0.1", port=port(), num_api_servers=workers(), generate_client_file=False,
        log_level="error", access_log=False,
    )  # fmt: skip
