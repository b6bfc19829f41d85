"""Blocking client of the service, with one persistent connection. It uses the standard library.

    with Client("http://127.0.0.1:8000") as client:
        client.wait_until_ready()
        answer = client.features(jpeg_bytes)

Not thread-safe: use one client per thread.
"""

import http.client
import json
import os
import re
import time
from typing import Any
from urllib.parse import SplitResult, urlsplit

from runtime.access import TOKEN_VARIABLE
from runtime.sockets import connect
from serve.config import MAX_DEADLINE_MS
from trackfeatures.errors import UserError

RETRY_S = 0.1
MAX_TIMEOUT_S = 1e6  # operating systems refuse much longer timeouts
# Problem types for which a retry is useless.
NOT_RETRIED = ("/problems/superseded", "/problems/deadline-passed")
UNSENDABLE = re.compile("[^!-~]")  # characters that the path of an HTTP request cannot contain
UNSENDABLE_IN_HEADER = re.compile(r"[\r\n\0]|[^\x00-\xff]")
PNG_SIGNATURE = b"\x89PNG"
# Errors of a request on a connection that the service has closed while it was idle.
DROPPED = (http.client.RemoteDisconnected, ConnectionResetError, BrokenPipeError)


class ServiceError(UserError):
    """The service cannot be reached, or refused the request.

    `status` is the HTTP status and `problem` the problem's type; both are None without a reply.
    `retry_after_s` is the service's recommended time until a retry in s.
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
    """Return the time in s to wait before the request that failed with `error` is sent again; None
    if a retry is useless."""
    if error.status is None:  # no reply: the service can be starting
        return RETRY_S
    if error.status not in (429, 503) or error.problem in NOT_RETRIED:
        return None
    return RETRY_S if error.retry_after_s is None else min(error.retry_after_s, RETRY_S)


class Client:
    """A connection to the service at `url` ("http://HOST:PORT" or "HOST:PORT").

    `timeout_s` is the time limit of one request. `token` is the service's token; the default is
    $DRIVERVIEW_TOKEN, if it is set.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        timeout_s: float = 5.0,
        token: str | None = None,
    ) -> None:
        """Raises ServiceError if `url` or `token` is not valid. Connects at the first request."""
        parts = _parse_url(url)
        self.url = parts.geturl().rstrip("/")
        self._path = parts.path.rstrip("/")
        kind = http.client.HTTPSConnection if parts.scheme == "https" else _plain_connection
        # Without a port http.client would take the last group of an IPv6 address for the port.
        default = http.client.HTTPS_PORT if parts.scheme == "https" else http.client.HTTP_PORT
        self._connection = kind(_host(parts), parts.port or default, timeout=timeout_s)
        # Tries IPv4 and IPv6 for "localhost" within the timeout; /etc/hosts can lack one of them.
        self._connection._create_connection = connect  # type: ignore[attr-defined]
        self._timeout_s = timeout_s
        token = os.environ.get(TOKEN_VARIABLE, "").strip() if token is None else token
        self._auth_headers = {"Authorization": f"Bearer {token}"} if token else {}
        _check_headers(self._auth_headers)

    def features(
        self,
        image: bytes,
        content_type: str | None = None,
        frame_id: str | None = None,
        *,
        stream: str | None = None,
        deadline_s: float | None = None,
        fov_y_deg: float | None = None,
        camera: str | None = None,
    ) -> dict[str, Any]:
        """Send `image`, the bytes of a JPEG or PNG file, to POST /features; return the answer with
        its track features. Raises ServiceError.

        `content_type` is detected from the first bytes if it is None. `frame_id` is returned in the
        answer. `stream` names a stream of frames, in which a newer frame replaces a queued frame.
        `fov_y_deg` is the vertical field of view of the image in degrees; the default is the value
        of the model's camera. `camera` names a camera that the service was started with.
        `deadline_s` is the time in s from now to the deadline. The service drops the frame if its
        processing has not begun by the deadline. Before the deadline the request is retried if the
        service is overloaded, not ready, or restarting.
        """
        if content_type is None:
            content_type = "image/png" if image.startswith(PNG_SIGNATURE) else "image/jpeg"
        headers = {"Content-Type": content_type}
        if frame_id is not None:
            headers["X-Frame-Id"] = frame_id
        if stream is not None:
            headers["X-Stream-Id"] = stream
        if fov_y_deg is not None:
            headers["X-Camera-Fov-Y"] = str(float(fov_y_deg))
        if camera is not None:
            headers["X-Camera"] = camera
        _check_headers(headers)
        if deadline_s is None:
            return self._request("POST", "/features", image, headers)
        return self._request_until(time.monotonic() + deadline_s, image, headers)

    def _request_until(self, end: float, image: bytes, headers: dict[str, str]) -> dict[str, Any]:
        """Send the image; after a failure, send it again while that can help, until `end` (s of the
        monotonic clock)."""
        while True:
            left_s = max(0.0, end - time.monotonic())
            headers["X-Deadline-Ms"] = f"{min(1e3 * left_s, MAX_DEADLINE_MS):.1f}"
            self._set_timeout(min(max(left_s, 0.001), MAX_TIMEOUT_S))
            try:
                return self._request("POST", "/features", image, headers)
            except ServiceError as error:
                pause_s = retry_pause_s(error)
                if pause_s is None or time.monotonic() + pause_s >= end:
                    raise
            finally:
                self._set_timeout(self._timeout_s)
            time.sleep(pause_s)

    def _set_timeout(self, seconds: float) -> None:
        self._connection.timeout = seconds
        if self._connection.sock is not None:
            self._connection.sock.settimeout(seconds)

    def model(self) -> dict[str, Any]:
        """Return the card of the served model. Raises ServiceError."""
        return self._request("GET", "/model")

    def ready(self) -> bool:
        """Whether the service can answer images."""
        try:
            self._request("GET", "/readyz")
        except ServiceError:
            return False
        return True

    def wait_until_ready(self, timeout_s: float = 30.0) -> None:
        """Wait until the service is ready. Raises ServiceError, with the last reason, if it is not
        ready after `timeout_s`."""
        end = time.monotonic() + timeout_s
        while True:
            try:
                self._request("GET", "/readyz")
            except ServiceError as error:
                if time.monotonic() >= end:
                    message = f"the service was not ready within {timeout_s:g} s: {error}"
                    raise ServiceError(message, error.status, error.problem) from error
            else:
                return
            time.sleep(RETRY_S)

    def close(self) -> None:
        """Close the connection; the next request opens a new connection."""
        self._connection.close()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _request(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        headers: dict[str, str] | None = None,
    ) -> dict[str, Any]:
        # The service can have closed an idle connection. Then the request is sent again on a new
        # connection, which is harmless because the service stores nothing.
        fresh = self._connection.sock is None
        try:
            status, content = self._send(method, path, body, headers or {})
        except DROPPED as error:
            if fresh:
                raise ServiceError(f"{self.url} closed the connection without a reply") from error
            status, content = self._send_again(method, path, body, headers or {})
        return _parse_reply(status, content, f"{self.url}{path}")

    def _send_again(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str]
    ) -> tuple[int, bytes]:
        try:
            return self._send(method, path, body, headers)
        except DROPPED as error:
            raise ServiceError(f"{self.url} closed the connection twice without a reply") from error

    def _send(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str]
    ) -> tuple[int, bytes]:
        try:
            return self._exchange(method, path, body, {**self._auth_headers, **headers})
        except DROPPED:
            raise
        except ConnectionRefusedError as error:
            raise ServiceError(
                f"no service listens at {self.url}; start one with `serve`, or give its address"
            ) from error
        except TimeoutError as error:
            limit_s = self._connection.timeout  # a deadline shortens it
            raise ServiceError(f"{self.url} did not reply within {limit_s:.3g} s") from error
        except OSError as error:
            raise ServiceError(f"cannot reach {self.url}: {error.strerror or error}") from error
        except http.client.HTTPException as error:
            raise ServiceError(f"{self.url} does not answer as HTTP: {error!r}") from error

    def _exchange(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str]
    ) -> tuple[int, bytes]:
        try:
            self._connection.request(method, self._path + path, body, headers)
            response = self._connection.getresponse()
            return response.status, response.read()
        except BaseException:  # an incomplete request, or an unread reply
            self.close()
            raise


def _plain_connection(host: str, port: int, *, timeout: float) -> http.client.HTTPConnection:
    return http.client.HTTPConnection(host, port, timeout=timeout)


def _parse_url(url: str) -> SplitResult:
    try:
        parts = urlsplit(url if "://" in url else f"http://{url}")
        host = _host(parts)
        host.encode("idna")  # the name lookup does the same
        usable = host and parts.scheme in ("http", "https") and parts.port != 0
        usable = usable and host.isprintable() and " " not in host
        usable = usable and not UNSENDABLE.search(parts.path)
    except (
        ValueError
    ):  # an open bracket, a port that is not a number, too long a label (UnicodeError)
        usable = False
    if not usable:
        raise ServiceError(
            f"{url!r} is not the address of a service; give one like http://127.0.0.1:8000"
        )
    return parts


def _host(parts: SplitResult) -> str:
    """The host of a URL, with an unescaped IPv6 zone: a URL has [fe80::1%25eth0] (RFC 6874)."""
    return (parts.hostname or "").replace("%25", "%")


def _check_headers(headers: dict[str, str]) -> None:
    """Raise ServiceError for values that a header cannot contain. `http.client` refuses them only
    after it has sent a part of the request."""
    for name, value in headers.items():
        if UNSENDABLE_IN_HEADER.search(value):
            raise ServiceError(f"{name} has characters that a header cannot contain")


def _parse_reply(status: int, content: bytes, url: str) -> dict[str, Any]:
    try:
        answer = json.loads(content)
    except ValueError:
        answer = None
    if not isinstance(answer, dict):
        raise ServiceError(
            f"{url} replied {status}, but not with a JSON object; is it this service?", status
        )
    if status != 200:
        detail = answer.get("detail", "no reason given")
        after_ms = answer.get("retry_after_ms")
        after_s = after_ms / 1e3 if isinstance(after_ms, int | float) else None
        raise ServiceError(
            f"{url} answered {status}: {detail}", status, answer.get("type"), after_s
        )
    return answer
