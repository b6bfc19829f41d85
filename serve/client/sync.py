"""A client of the service on the standard library alone: one connection, kept open.

    with Client("http://127.0.0.1:8000") as client:
        client.wait_until_ready()
        answer = client.features(jpeg_bytes)

Not to be shared between threads: each makes its own.
"""

import http.client
import json
import os
import re
import time
from types import TracebackType
from typing import Any
from urllib.parse import SplitResult, urlsplit

from serve.config import MAX_DEADLINE_MS, TOKEN_VARIABLE
from trackfeatures.errors import UserError

POLL_S = 0.1
# Refusals of a frame that stay true when it is sent again.
FINAL = ("/problems/superseded", "/problems/deadline-passed")
UNSENDABLE = re.compile("[^!-~]")  # what the path of an HTTP request cannot hold
PNG_SIGNATURE = b"\x89PNG"
# How a connection dies that the service closed while it was idle.
DROPPED = (http.client.RemoteDisconnected, ConnectionResetError, BrokenPipeError)


class ServiceError(UserError):
    """The service cannot be reached or gave no answer.

    `status` is the HTTP status and `problem` the problem's type, None where nothing came back;
    `retry_after_s` is when the service says to ask again.
    """

    def __init__(
        self,
        message: str,
        status: int | None = None,
        problem: str | None = None,
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(message)
        self.status = status
        self.problem = problem
        self.retry_after_s = retry_after_s


def retry_pause_s(error: ServiceError) -> float | None:
    """How long to wait before the same is asked again, s; None where that would not help."""
    if error.status is None:  # nobody answered: it may be starting
        return POLL_S
    if error.status not in (429, 503) or error.problem in FINAL:
        return None
    return POLL_S if error.retry_after_s is None else min(error.retry_after_s, POLL_S)


class Client:
    """A connection to the service at `url` ("http://HOST:PORT" or "HOST:PORT").

    `token`: what the service asks of its clients; None: $DRIVERVIEW_TOKEN, or nothing.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        timeout_s: float = 5.0,
        token: str | None = None,
    ) -> None:
        """Raises ServiceError when `url` is none. Nothing is sent before the first request."""
        parts = _parse(url)
        self.url = parts.geturl().rstrip("/")
        self._path = parts.path.rstrip("/")
        kind = http.client.HTTPSConnection if parts.scheme == "https" else _plain_connection
        assert parts.hostname is not None
        self._connection = kind(parts.hostname, parts.port, timeout=timeout_s)
        self._timeout_s = timeout_s
        token = os.environ.get(TOKEN_VARIABLE, "").strip() if token is None else token
        self._known = {"Authorization": f"Bearer {token}"} if token else {}

    def features(
        self,
        image: bytes,
        content_type: str | None = None,
        frame_id: str | None = None,
        *,
        stream: str | None = None,
        deadline_s: float | None = None,
    ) -> dict[str, Any]:
        """The service's answer to a JPEG or PNG file's bytes, as DESIGN §9 gives it.

        `content_type` None: by the image's first bytes. `stream`: a newer frame of it supersedes
        this one. With `deadline_s` the service drops the frame when it is late, and where asking
        again may help (it is full, not ready, or restarts), that is done until then. Raises
        ServiceError.
        """
        if content_type is None:
            content_type = "image/png" if image.startswith(PNG_SIGNATURE) else "image/jpeg"
        headers = {"Content-Type": content_type}
        if frame_id is not None:
            headers["X-Frame-Id"] = frame_id
        if stream is not None:
            headers["X-Stream-Id"] = stream
        if deadline_s is None:
            return self._ask("POST", "/features", image, headers)
        return self._ask_until(time.monotonic() + deadline_s, image, headers)

    def _ask_until(self, end: float, image: bytes, headers: dict[str, str]) -> dict[str, Any]:
        """Ask, and ask again as long as that may help, until `end` (s, monotonic)."""
        while True:
            left_s = max(0.0, end - time.monotonic())
            headers["X-Deadline-Ms"] = f"{min(1e3 * left_s, MAX_DEADLINE_MS):.1f}"
            self._wait_at_most(max(left_s, 0.001))
            try:
                return self._ask("POST", "/features", image, headers)
            except ServiceError as error:
                pause_s = retry_pause_s(error)
                if pause_s is None or time.monotonic() + pause_s >= end:
                    raise
            finally:
                self._wait_at_most(self._timeout_s)
            time.sleep(pause_s)

    def _wait_at_most(self, seconds: float) -> None:
        self._connection.timeout = seconds
        if self._connection.sock is not None:
            self._connection.sock.settimeout(seconds)

    def model(self) -> dict[str, Any]:
        """The card of the model that answers. Raises ServiceError."""
        return self._ask("GET", "/model")

    def ready(self) -> bool:
        """Whether the service answers images now."""
        try:
            self._ask("GET", "/readyz")
        except ServiceError:
            return False
        return True

    def wait_until_ready(self, timeout_s: float = 30.0) -> None:
        """Return once the service is ready; raise ServiceError with its last reason if not."""
        end = time.monotonic() + timeout_s
        while True:
            try:
                self._ask("GET", "/readyz")
            except ServiceError as error:
                if time.monotonic() >= end:
                    message = f"the service was not ready within {timeout_s:g} s: {error}"
                    raise ServiceError(message, error.status, error.problem) from error
            else:
                return
            time.sleep(POLL_S)

    def close(self) -> None:
        """Close the connection; the next request opens another."""
        self._connection.close()

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _ask(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        headers: dict[str, str] | None = None,
    ) -> dict[str, Any]:
        # Only an old connection may be dead for no fault of the service. Asking for features
        # twice does no harm: nothing is stored.
        fresh = self._connection.sock is None
        try:
            status, content = self._exchange(method, path, body, headers or {})
        except DROPPED as error:
            if fresh:
                raise ServiceError(f"{self.url} closed the connection without an answer") from error
            status, content = self._exchange_again(method, path, body, headers or {})
        return _read(status, content, f"{self.url}{path}")

    def _exchange_again(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str]
    ) -> tuple[int, bytes]:
        try:
            return self._exchange(method, path, body, headers)
        except DROPPED as error:
            raise ServiceError(f"{self.url} closed the connection twice, unanswered") from error

    def _exchange(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str]
    ) -> tuple[int, bytes]:
        try:
            everything = {**self._known, **headers}
            self._connection.request(method, self._path + path, body, everything)
            response = self._connection.getresponse()
            return response.status, response.read()
        except DROPPED:
            self.close()
            raise
        except ConnectionRefusedError as error:
            self.close()
            raise ServiceError(
                f"no service listens at {self.url}; start one with `serve`, or give its address"
            ) from error
        except TimeoutError as error:
            self.close()
            raise ServiceError(f"{self.url} gave no answer within {self._timeout_s:g} s") from error
        except OSError as error:
            self.close()
            raise ServiceError(f"cannot reach {self.url}: {error.strerror or error}") from error
        except http.client.HTTPException as error:
            self.close()
            raise ServiceError(f"{self.url} does not answer as HTTP: {error!r}") from error


def _plain_connection(host: str, port: int | None, *, timeout: float) -> http.client.HTTPConnection:
    return http.client.HTTPConnection(host, port, timeout=timeout)


def _parse(url: str) -> SplitResult:
    try:
        parts = urlsplit(url if "://" in url else f"http://{url}")
        host = parts.hostname or ""
        host.encode("idna")  # as looking it up will do
        usable = host and parts.scheme in ("http", "https") and parts.port != 0
        usable = usable and host.isprintable() and " " not in host
        usable = usable and not UNSENDABLE.search(parts.path)
    except ValueError:  # an open bracket, a port that is no number, a label too long (UnicodeError)
        usable = False
    if not usable:
        raise ServiceError(
            f"{url!r} is no address of a service; it looks like http://127.0.0.1:8000"
        )
    return parts


def _read(status: int, content: bytes, asked: str) -> dict[str, Any]:
    try:
        answer = json.loads(content)
    except ValueError:
        answer = None
    if not isinstance(answer, dict):
        raise ServiceError(
            f"{asked} answered {status} with something else than JSON; is it this service?", status
        )
    if status != 200:
        detail = answer.get("detail", "no reason given")
        after_ms = answer.get("retry_after_ms")
        after_s = after_ms / 1e3 if isinstance(after_ms, int | float) else None
        raise ServiceError(
            f"{asked} answered {status}: {detail}", status, answer.get("type"), after_s
        )
    return answer
