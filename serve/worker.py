"""One worker process: one engine, one event loop. `serve.workers.supervisor` starts it as
`python -m serve.worker FD`; supervisor and worker exchange lines of JSON over the socket FD.

The supervisor sends the WorkerTask first. For a reload it sends {"load": folder, "generation": n,
"cameras": {name: camera}}; the cameras replace the old ones together with the weights. If the
reload fails in any worker, it sends {"drop": n}, and both are discarded. The worker sends
{"loaded": n, "model": hash, "engine": ..., "precision": ...} or {"failed": n, "why": ...} for each
generation n of weights, and {"ready": true} once it can answer images. When the supervisor closes
the socket, the worker stops.
"""

import gc
import json
import logging
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mtlnet.inference.engine import Engine, load_engine
from serve.app import Service
from serve.cameras import Cameras
from serve.observability import logs, telemetry
from serve.scheduling.warmup import warm_up
from serve.server.worker_server import WorkerServer
from serve.shared_memory import COMMITTED_GENERATION, WorkerPeers, attach_shared_memory
from serve.workers.worker_process import WorkerTask, read_cameras
from trackfeatures.errors import UserError

logger = logging.getLogger(__name__)


class SupervisorConnection:
    """The worker's end of the socket to its supervisor."""

    def __init__(self, fd: int) -> None:
        self._socket = socket.socket(fileno=fd)
        self._lock = threading.Lock()

    def lines(self) -> Iterator[str]:
        """Yield the supervisor's messages (lines of JSON) until it closes the socket."""
        # Not a buffered file: at interpreter exit it would wait for the thread that reads it.
        rest = b""
        while received := self._socket.recv(65536):
            *lines, rest = (rest + received).split(b"\n")
            yield from (line.decode() for line in lines)

    def send(self, **message: Any) -> None:
        """Send the keyword arguments as a JSON message; no effect if the supervisor has ended."""
        with self._lock:
            try:
                self._socket.sendall(json.dumps(message).encode() + b"\n")
            except OSError:
                logger.debug("the supervisor has ended")

    def send_loaded(self, generation: int, engine: Engine) -> None:
        """Send the supervisor the hash of the weights, the kind and the precision of `engine`,
        which was loaded for this generation of weights."""
        self.send(
            loaded=generation,
            model=engine.card.model_hash,
            engine=engine.kind,
            precision=engine.precision,
        )


def main() -> None:
    """Run one worker until its supervisor or SIGTERM stops it."""
    logs.capture_native_lines()
    supervisor = SupervisorConnection(int(sys.argv[1]))
    lines = supervisor.lines()
    line = next(lines, None)
    if line is None:
        return
    task = WorkerTask.from_json_line(line)
    shared = attach_shared_memory(task.memory, task.blocks)
    logs.set_up(shared.workers)
    try:
        engine = load(task, task.folder, task.expected)
    except UserError as error:
        supervisor.send(failed=task.generation, why=str(error))
        return
    supervisor.send_loaded(task.generation, engine)
    app = Service(
        engine, warm_up, task.limits, shared, task.block, telemetry.tracer(), task.cameras
    )
    app.frame_queue.on_warm(lambda: send_ready(supervisor))
    peers = WorkerPeers(shared, task.block)
    server = WorkerServer(app, task.limits, peers)
    arguments = (supervisor, lines, server, app, task)
    threading.Thread(target=handle_commands, args=arguments, daemon=True).start()
    server.run(sockets=[socket.socket(fileno=number) for number in task.listeners])
    peers.withdraw()


def load(task: WorkerTask, folder: str, expected: str | None) -> Engine:
    """Load the engine of the model in `folder`, with the views and threads of `task`. `expected`:
    the required hash of the weights; None accepts any. Raises UserError if the model cannot be
    loaded or its weights have another hash."""
    engine = load_engine(Path(folder), threads=task.threads, views=task.views)
    found = engine.card.model_hash
    if expected is not None and found != expected:
        raise UserError(
            f"{folder} now has model {found[:12]}, but the service uses {expected[:12]}; "
            "`serve reload` switches to the new one"
        )
    return engine


def send_ready(supervisor: SupervisorConnection) -> None:
    """Send the supervisor the message that this worker can answer images."""
    # The objects loaded so far are permanent. With them a full garbage collection delays all
    # clients by 50 to 80 ms, several times per minute; without them it takes 3 ms.
    gc.freeze()
    supervisor.send(ready=True)


def handle_commands(
    supervisor: SupervisorConnection,
    lines: Iterator[str],
    server: WorkerServer,
    app: Service,
    task: WorkerTask,
) -> None:
    """Execute the supervisor's commands until it closes the socket, then stop the server."""
    for line in lines:
        message = json.loads(line)
        if "load" in message:
            cameras = read_cameras(message["cameras"])
            reload(supervisor, app, task, message["load"], message["generation"], cameras)
        elif "drop" in message:
            app.frame_queue.drop_staged_model()
    server.should_exit = True


def reload(
    supervisor: SupervisorConnection,
    app: Service,
    task: WorkerTask,
    folder: str,
    generation: int,
    cameras: Cameras,
) -> None:
    """Load and check new weights while the old weights are in use. The new weights and `cameras`,
    the cameras that clients can name, replace the old ones once the supervisor commits
    `generation`."""
    head = app.shared.head()
    try:
        engine = load(task, folder, None)
        warm_up(engine)
    except UserError as error:
        supervisor.send(failed=generation, why=str(error))
        return
    except Exception as error:  # after any error the old weights stay in use
        logger.exception("new weights failed")
        supervisor.send(failed=generation, why=repr(error))
        return
    app.frame_queue.stage_model(engine, cameras, lambda: head[COMMITTED_GENERATION] >= generation)
    supervisor.send_loaded(generation, engine)


if __name__ == "__main__":
    main()
