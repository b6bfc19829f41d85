"""What a request must be before its body is looked at as an image: `mtlnet.images` does that."""

from collections.abc import AsyncIterator, Mapping

from serve.problems import BODY_TOO_LARGE, UNSUPPORTED_TYPE, Problem

MAX_BODY_BYTES = 4 * 1024 * 1024
MEDIA_TYPES = ("image/jpeg", "image/png")


def check_headers(headers: Mapping[str, str]) -> None:
    """Refuse what the headers alone rule out. Raises Problem."""
    sent = headers.get("content-type", "")
    if sent.partition(";")[0].strip().lower() not in MEDIA_TYPES:
        seen = f"is {sent[:80]!r}" if sent else "has no Content-Type"
        raise Problem(
            UNSUPPORTED_TYPE,
            f"the body {seen}; post the bytes of the file itself with the header "
            "Content-Type: image/jpeg (or image/png)",
        )
    coding = headers.get("content-encoding", "identity")
    if coding.strip().lower() != "identity":
        raise Problem(
            UNSUPPORTED_TYPE, f"the body has Content-Encoding {coding[:40]!r}; post it uncompressed"
        )
    length = headers.get("content-length", "")
    if length.isdecimal() and int(length[:20]) > MAX_BODY_BYTES:
        raise _too_large(f"{int(length[:20])} bytes")


async def read_body(chunks: AsyncIterator[bytes]) -> bytes:
    """The whole body, as long as it stays within the limit. Raises Problem."""
    body = bytearray()
    async for chunk in chunks:
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            raise _too_large(f"more than {MAX_BODY_BYTES} bytes")
    return bytes(body)


def _too_large(seen: str) -> Problem:
    return Problem(
        BODY_TOO_LARGE,
        f"the body has {seen}, at most {MAX_BODY_BYTES} are taken; send a smaller image or "
        "compress it more",
    )
