"""The JSON schema of the `driverview.*` messages, published in every dataset folder.

It describes the messages as `google.protobuf.json_format.MessageToDict` gives them with
`preserving_proto_field_name`. Source of the format: json-schema.org, draft 2020-12; keys that
start with `x-` are extensions of this project.
"""

import json
import math
from functools import lru_cache
from typing import Any

from google.protobuf.descriptor import FieldDescriptor

import trackfeatures as tf
from datagen.recording.schema import topics
from datagen.recording.schema.fields import FIELDS, Field
from datagen.recording.schema.proto import driverview_pb2

SCHEMA_FILE = "schemas/driverview.schema.json"
INTEGERS = (FieldDescriptor.CPPTYPE_INT32, FieldDescriptor.CPPTYPE_UINT32)


@lru_cache(maxsize=1)
def schema_text() -> str:
    """Return the content of the schema file: the result of `json_schema` as indented JSON."""
    return json.dumps(json_schema(), indent=1) + "\n"


def json_schema() -> dict[str, Any]:
    """Return the schema as a dict: one definition per message with one property per field, and the
    message of each topic."""
    package = driverview_pb2.DESCRIPTOR.package
    own_types = {
        topic: kind.DESCRIPTOR.name
        for topic, kind in topics.MESSAGE_TYPES.items()
        if kind.DESCRIPTOR.file.package == package
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "driverview recordings",
        "description": (
            "The messages of a control step share one log time. Absent means unset: the value does "
            "not exist there, it is not zero. x-unit is 1 where there is none."
        ),
        "x-definitions-version": tf.VERSION,
        "x-topics": own_types,
        "x-clock": {
            "unit": "ns",
            "meaning": "log time: simulated time since the start of the round, plus the epoch",
            "epoch": topics.EPOCH_NS,
        },
        "$defs": {name: _message(name) for name in FIELDS},
    }


def _message(name: str) -> dict[str, Any]:
    fields = driverview_pb2.DESCRIPTOR.message_types_by_name[name].fields
    return {
        "type": "object",
        "additionalProperties": False,
        "properties": {f.name: _property(f, FIELDS[name][f.name]) for f in fields},
    }


def _property(descriptor: Any, field: Field) -> dict[str, Any]:
    value: dict[str, Any] = {"type": "integer" if descriptor.cpp_type in INTEGERS else "number"}
    if descriptor.enum_type is not None:
        value = {"enum": [kind.name for kind in descriptor.enum_type.values]}
    for key, limit in (("minimum", field.low), ("maximum", field.high)):
        if limit is not None and math.isfinite(limit):
            value[key] = limit
    if descriptor.is_repeated:
        value = {"type": "array", "items": value}
    about = {
        "description": field.meaning,
        "x-unit": field.unit,
        "x-frame": field.frame,
        "x-reference-point": field.reference,
        "x-absent": field.absent,
    }
    return value | {key: text for key, text in about.items() if text}
