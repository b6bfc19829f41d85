"""Finding one field in a serialised protobuf message without copying the rest."""


def bytes_field(message: memoryview, wanted: int) -> memoryview:
    """The length-delimited field numbered `wanted`; ValueError when it is not there.

    Source: protobuf.dev/programming-guides/encoding.
    """
    at, end = 0, len(message)
    while at < end:
        tag, at = _varint(message, at)
        kind = tag & 7
        if kind == 2:
            length, at = _varint(message, at)
            if at + length > end:
                break
            if tag >> 3 == wanted:
                return message[at : at + length]
            at += length
        elif kind == 0:
            _, at = _varint(message, at)
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            break
    raise ValueError(f"the message is damaged: field {wanted} was not found")


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    value, shift = 0, 0
    while at < len(message) and shift < 64:
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError("the message is damaged: a number has no end")
