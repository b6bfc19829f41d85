"""The service's log: one JSON object a line on stderr, with the request's id.

Refusals are told ten times a second at most: who sends rubbish must not fill the disk. The count of
those that were not told stands in the next that is.
"""

import json
import logging
import os
import sys
import time
from datetime import UTC, datetime

from serve.api.problems import Problem

REFUSALS_PER_S = 10.0
FIELDS = ("request", "client", "problem", "status", "total_ms", "untold")

logger = logging.getLogger("serve.requests")


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON."""

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
    """Log to stderr from now on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    logging.getLogger("serve").setLevel(logging.INFO)
    # What a client did wrong is in our own lines.
    logging.getLogger("uvicorn").setLevel(logging.ERROR)


class Refusals:
    """Tells of refused requests, not too often."""

    def __init__(self) -> None:
        self._left, self._when, self._untold = REFUSALS_PER_S, time.monotonic(), 0

    def tell(self, request: str, client: str, problem: Problem) -> None:
        """Log that a request got a problem."""
        now = time.monotonic()
        self._left = min(REFUSALS_PER_S, self._left + (now - self._when) * REFUSALS_PER_S)
        self._when = now
        if self._left < 1.0:
            self._untold += 1
            return
        self._left -= 1.0
        fields: dict[str, object] = {
            "request": request,
            "client": client,
            "problem": problem.kind.type,
            "status": problem.kind.status,
        }
        if self._untold:
            fields["untold"] = self._untold
        self._untold = 0
        logger.info("refused: %s", problem.detail, extra=fields)


def tell_answer(request: str, client: str, total_ms: float) -> None:
    """Log that a request was answered."""
    fields = {"request": request, "client": client, "status": 200, "total_ms": round(total_ms, 3)}
    logger.info("answered", extra=fields)
