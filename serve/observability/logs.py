"""The service's log: one JSON object a line on stderr, with the id of the request.

Refusals are logged at most ten times a second, so that a faulty client cannot fill the disk. The
number of those left out is in the next one logged, as `untold`.
"""

import json
import logging
import os
import sys
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from serve.api.problems import Problem  # loads FastAPI, which the supervisor does without

REFUSALS_PER_S = 10.0
FIELDS = ("request", "client", "problem", "status", "total_ms", "untold")

logger = logging.getLogger("serve.requests")


class JsonFormatter(logging.Formatter):
    """Formats a record as one line of JSON."""

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


def set_up() -> None:
    """Configure logging to stderr."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    logging.getLogger("serve").setLevel(logging.INFO)
    # Errors of clients are in the lines of this module.
    logging.getLogger("uvicorn").setLevel(logging.ERROR)


class RefusalLog:
    """Logs refused requests, limited by a token bucket."""

    def __init__(self) -> None:
        self._tokens, self._updated_s, self._suppressed = REFUSALS_PER_S, time.monotonic(), 0

    def log(self, request_id: str, client: str, problem: "Problem") -> None:
        """Log a refused request, or only count it when there were too many."""
        now = time.monotonic()
        elapsed_s = now - self._updated_s
        self._tokens = min(REFUSALS_PER_S, self._tokens + elapsed_s * REFUSALS_PER_S)
        self._updated_s = now
        if self._tokens < 1.0:
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
            fields["untold"] = self._suppressed
        self._suppressed = 0
        logger.info("refused: %s", problem.detail, extra=fields)


def log_answer(request_id: str, client: str, total_ms: float) -> None:
    """Log an answered request."""
    fields = {
        "request": request_id,
        "client": client,
        "status": 200,
        "total_ms": round(total_ms, 3),
    }
    logger.info("answered", extra=fields)
