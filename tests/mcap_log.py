"""Recordings in MCAP for tests, which are skipped where the extra `logs` is not installed."""

import json

import pytest


def write_mcap(path, topics, **options):
    """Messages in JSON, `(time, message)` by topic, at times of recording (s); `options` are those of the writer."""
    library = pytest.importorskip("mcap.writer", reason="the extra logs is not installed")
    with path.open("wb") as file:
        writer = library.Writer(file, **options)
        writer.start()
        schema = writer.register_schema("state", "jsonschema", b"{}")
        for name, messages in topics.items():
            channel = writer.register_channel(f"/{name}", "json", schema)
            for t, message in messages:
                time = round(1e9 * t) + 1_700_000_000_000_000_000
                writer.add_message(channel, time, json.dumps(message).encode(), time)
        writer.finish()
