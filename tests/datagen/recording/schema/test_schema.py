"""The published JSON schema: it describes every field, and recordings are valid under it."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from google.protobuf.json_format import MessageToDict
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import trackfeatures as tf
from datagen.recording.folder import round_path
from datagen.recording.schema.fields import FIELDS
from datagen.recording.schema.json_schema import SCHEMA_FILE, json_schema
from datagen.recording.schema.proto import driverview_pb2
from tests.datagen.conftest import Samples


def test_every_field_of_every_message_is_described_and_no_other() -> None:
    messages = driverview_pb2.DESCRIPTOR.message_types_by_name
    assert {name: [f.name for f in m.fields] for name, m in messages.items()} == {
        name: list(fields) for name, fields in FIELDS.items()
    }
    for name, fields in FIELDS.items():
        for field in messages[name].fields:
            optional = field.has_presence
            assert bool(fields[field.name].absent) == optional, f"{name}.{field.name}"


def test_the_published_schema_is_valid_json_schema(dataset: Path) -> None:
    found = json.loads((dataset / SCHEMA_FILE).read_text())
    assert found == json_schema()
    jsonschema.Draft202012Validator.check_schema(found)
    ml = found["$defs"]["TrackFeatures"]["properties"]["to_marking_ml"]
    assert (ml["type"], ml["x-unit"], ml["minimum"], ml["maximum"]) == ("number", "m", -4.0, -0.5)
    assert ml["x-reference-point"] == "centre of gravity, in the road plane"
    heading = found["$defs"]["TrackFeatures"]["properties"]["heading"]
    assert heading["enum"] == [kind.name for kind in tf.RoadClass]
    assert found["x-topics"]["/labels"] == "TrackFeatures"


def recorded(path: Path) -> list[tuple[str, dict[str, Any]]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        topics = list(json_schema()["x-topics"])
        return [
            (channel.topic, MessageToDict(
                message, preserving_proto_field_name=True,
                always_print_fields_with_no_presence=True,
            ))
            for _, channel, _, message in reader.iter_decoded_messages(topics)
        ]  # fmt: skip


def validator(topic: str) -> jsonschema.Draft202012Validator:
    schema = json_schema()
    return jsonschema.Draft202012Validator(
        {"$ref": f"#/$defs/{schema['x-topics'][topic]}", "$defs": schema["$defs"]}
    )


def test_recorded_messages_are_valid_under_the_schema(dataset: Path) -> None:
    messages = recorded(round_path(dataset, "r000"))
    validators = {topic: validator(topic) for topic in json_schema()["x-topics"]}
    for topic, message in messages:
        validators[topic].validate(message)
    assert len(messages) == 4 * Samples.frames_a_round


@pytest.mark.parametrize(
    ("topic", "change"),
    [
        ("/labels", {"to_marking_ml": 0.3}),
        ("/labels", {"heading": "BACKWARDS"}),
        ("/labels", {"lanes": 4}),
        ("/command", {"steer": 1.2}),
        ("/ego/state", {"colour": "red"}),
        ("/sensors", {"range": [201.0]}),
    ],
)
def test_the_schema_refuses_impossible_values(topic: str, change: dict[str, Any]) -> None:
    validator(topic).validate({})
    with pytest.raises(jsonschema.ValidationError):
        validator(topic).validate(change)
