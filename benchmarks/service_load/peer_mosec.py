"""The model behind mosec, set up as its manual shows: one stage, several processes, no batching."""

import sys
from typing import Any

import mosec

from benchmarks.service_load.peer_work import Work, port, workers


class Features(mosec.Worker):
    """The only stage: it answers a JPEG."""

    def __init__(self) -> None:
        super().__init__()
        self.work = Work()

    def deserialize(self, data: bytes) -> bytes:
        return data

    def forward(self, data: bytes) -> dict[str, Any]:
        return self.work(data)


if __name__ == "__main__":
    # mosec reads its settings from the command line.
    sys.argv[1:] = ["--port", str(port()), "--address", "127.0.0.1", "--log-level", "warning"]
    server = mosec.Server()
    server.append_worker(Features, num=workers(), route="/features")
    server.run()
