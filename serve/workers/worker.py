"""One worker process: one engine, one event loop. `serve.workers.supervisor` starts it, as
`python -m serve.workers.worker FD`, and talks to it over the socket FD, one line of JSON a message.

From the supervisor: the Task, then {"load": folder, "generation": n}, {"drop": n}. To it:
{"loaded": n, "model": hash, "engine": ..., "precision": ...} or {"failed": n, "why": ...}, and
{"ready": true}. The end of that socket is the end of the worker.
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
from serve.observability import logs, telemetry
from serve.scheduling.warmup import warm_up
from serve.server.worker_server import WorkerServer
from serve.workers.shared_memory import COMMITTED, BlockPeers, attach
from serve.workers.worker_process import read_task
from trackfeatures.errors import UserError

logger = logging.getLogger(__name__)


class Control:
    """The worker's side of the socket to its supervisor."""

    def __init__(self, fd: int) -> None:
        self._socket = socket.socket(fileno=fd)
        self._lock = threading.Lock()

    def lines(self) -> Iterator[str]:
        """What the supervisor says, until it says no more."""
        # Not a buffered file: at the interpreter's end that would wait for the thread reading it.
        rest = b""
        while received := self._socket.recv(65536):
            *whole, rest = (rest + received).split(b"\n")
            yield from (line.decode() for line in whole)

    def say(self, **message: Any) -> None:
        """Tell the supervisor; if it is gone, nobody needs to know."""
        with self._lock:
            try:
                self._socket.sendall(json.dumps(message).encode() + b"\n")
            except OSError:
                logger.debug("the supervisor is gone")

    def say_loaded(self, generation: int, engine: Engine) -> None:
        """Tell which engine was loaded."""
        self.say(
            loaded=generation,
            model=engine.card.model_hash,
            engine=engine.kind,
            precision=engine.precision,
        )


def main() -> None:
    """Run one worker until its supervisor or SIGTERM ends it."""
    logs.set_up()
    control = Control(int(sys.argv[1]))
    lines = control.lines()
    line = next(lines, None)
    if line is None:
        return
    task = read_task(line)
    try:
        engine = load(Path(task.folder), task.expected)
    except UserError as error:
        control.say(failed=task.generation, why=str(error))
        return
    control.say_loaded(task.generation, engine)
    shared = attach(task.memory, task.slots)
    app = Service(engine, warm_up, task.limits, shared, task.slot, telemetry.tracer())
    app.perceiver.when_warm(lambda: say_ready(control))
    peers = BlockPeers(shared, task.slot)
    server = WorkerServer(app, task.limits, peers)
    threading.Thread(target=follow, args=(control, lines, server, app), daemon=True).start()
    server.run(sockets=[socket.socket(fileno=task.listener)])
    peers.leave()


def load(folder: Path, expected: str | None) -> Engine:
    """The engine of a run. Raises UserError, also when its weights are others than expected."""
    engine = load_engine(folder)
    found = engine.card.model_hash
    if expected is not None and found != expected:
        raise UserError(
            f"{folder} holds model {found[:12]} now, {expected[:12]} is being served; "
            "`serve reload` takes the new one"
        )
    return engine


def say_ready(control: Control) -> None:
    """Tell that images are answered from now on."""
    # What is here now stays. To look through it for garbage held up every client for 50 to 80 ms,
    # several times a minute; what requests leave behind is looked through in 3.
    gc.freeze()
    control.say(ready=True)


def follow(control: Control, lines: Iterator[str], server: WorkerServer, app: Service) -> None:
    """Do what the supervisor says, until it says no more."""
    for line in lines:
        message = json.loads(line)
        if "load" in message:
            reload(control, app, message["load"], message["generation"])
        elif "drop" in message:
            app.perceiver.drop()
    server.should_exit = True


def reload(control: Control, app: Service, folder: str, generation: int) -> None:
    """Load new weights beside the old and check them; they answer once all workers have them."""
    head = app.shared.head()
    try:
        engine = load(Path(folder), None)
        warm_up(engine)
    except UserError as error:
        control.say(failed=generation, why=str(error))
        return
    except Exception as error:  # whatever new weights do, the old ones go on answering
        logger.exception("new weights failed")
        control.say(failed=generation, why=repr(error))
        return
    app.perceiver.stage(engine, lambda: head[COMMITTED] >= generation)
    control.say_loaded(generation, engine)


if __name__ == "__main__":
    main()
