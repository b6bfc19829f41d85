"""The service's log on stderr: each line is a JSON object, with the id of the request.

Rate limits keep clients from filling the disk. Refusals of all kinds, also because of token, Host,
Origin or rate, are logged at most once per second for each client and ten times per second for all
clients. Equal errors and lines of native libraries are logged at most once per second. With several
workers each has its share of these rates. The next logged line has the number of omitted lines as
`suppressed`.
"""

import faulthandler
import json
import logging
import os
import sys
import threading
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from serve.config import network_of

if TYPE_CHECKING:
    from serve.problems import Problem  # loads FastAPI, which the supervisor does not need

REFUSALS_PER_S = 10.0
INTERVAL_S = 1.0  # least time between two refusals of one client, and between two equal errors
REMEMBERED = 1024  # number of clients or errors whose last time is kept
MAX_LINE = 500  # characters kept of a native library's line
SUPERVISION = "serve.workers"  # logger without limits: clients cannot cause its lines
FIELDS = ("request", "client", "problem", "status", "total_ms", "suppressed")

logger = logging.getLogger("serve.requests")


class JsonFormatter(logging.Formatter):
    """Formats a log record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        content: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "pid": os.getpid(),
            "message": record.getMessage(),
        }
        for name in FIELDS:
            if hasattr(record, name):
                content[name] = getattr(record, name)
        if record.exc_info:
            content["trace"] = self.formatException(record.exc_info)
        return json.dumps(content)


class Interval:
    """Lets each key pass at most once in `workers` seconds, so that `workers` processes together
    let it pass at most once per second (INTERVAL_S) on average."""

    def __init__(self, workers: int = 1) -> None:
        self._interval_s = INTERVAL_S * workers
        self._last_s: dict[str, float] = {}

    def passes(self, key: str, now: float) -> bool:
        """Whether `key` passes at `now` in s; if it passes, `now` is its last time."""
        if now - self._last_s.get(key, -self._interval_s) < self._interval_s:
            return False
        if len(self._last_s) >= REMEMBERED:
            self._last_s.clear()
        self._last_s[key] = now
        return True


class ErrorLimit(logging.Filter):
    """Lets warnings and errors with the same logger and text template pass at most once in
    `workers` seconds. Lines of the supervisor have no limit."""

    def __init__(self, workers: int = 1) -> None:
        super().__init__()
        self._interval, self._suppressed = Interval(workers), 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether `record` is logged."""
        if record.levelno < logging.WARNING or record.name.startswith(SUPERVISION):
            return True
        if not self._interval.passes(f"{record.name} {record.msg}", time.monotonic()):
            self._suppressed += 1
            return False
        if self._suppressed:
            record.suppressed, self._suppressed = self._suppressed, 0
        return True


def set_up(workers: int = 1) -> None:
    """Configure logging to stderr in one of `workers` processes, each of which gets its share of
    the permitted rate of lines."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    handler.addFilter(ErrorLimit(workers))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    logging.getLogger("serve").setLevel(logging.INFO)
    # This module logs the errors of clients, so uvicorn's warnings about them are not needed.
    logging.getLogger("uvicorn").setLevel(logging.ERROR)


def capture_native_lines() -> None:
    """Redirect the output of native libraries on stderr to the log; call it before `set_up`.

    libpng writes a line for each damaged image. Python's stderr, and the stack that `faulthandler`
    writes in a crash, still go to the original stderr.
    """
    own = os.fdopen(os.dup(2), "w", buffering=1, encoding="utf-8", errors="backslashreplace")
    reader, writer = os.pipe()
    os.dup2(writer, 2)
    os.close(writer)
    sys.stderr = own
    faulthandler.enable(own)
    threading.Thread(target=_log_native_lines, args=(reader,), daemon=True).start()


def _log_native_lines(reader: int) -> None:
    while part := os.read(reader, 65536):
        line = part.partition(b"\n")[0].decode("utf-8", "backslashreplace")
        logger.warning("a native library wrote: %s", line[:MAX_LINE])


class RefusalLog:
    """Logs refused requests. A token bucket limits the lines of all clients, a second limit the
    lines of each client's network."""

    def __init__(self, workers: int = 1) -> None:
        self._rate = REFUSALS_PER_S / workers
        self._most = max(self._rate, 1.0)
        self._tokens, self._updated_s, self._suppressed = self._most, time.monotonic(), 0
        self._clients = Interval(workers)

    def log(self, request_id: str, client: str, problem: "Problem") -> None:
        """Log a refused request, or only count it if a limit is exceeded."""
        now = time.monotonic()
        elapsed_s = now - self._updated_s
        self._tokens = min(self._most, self._tokens + elapsed_s * self._rate)
        self._updated_s = now
        if self._tokens < 1.0 or not self._clients.passes(network_of(client), now):
            self._suppressed += 1
            return
        self._tokens -= 1.0
        fields: dict[str, object] = {
            "request": request_id,
            "client": client,
            "problem": problem.type.uri,
            "status": problem.type.status,
        }
        if self._suppressed:
            fields["suppressed"] = self._suppressed
        self._suppressed = 0
        logger.info("refused: %s", problem.detail, extra=fields)


def log_answer(request_id: str, client: str, total_ms: float) -> None:
    """Log an answered request; `total_ms` is the time from its arrival to the answer."""
    fields = {
        "request": request_id,
        "client": client,
        "status": 200,
        "total_ms": round(total_ms, 3),
    }
    logger.info("answered", extra=fields)
