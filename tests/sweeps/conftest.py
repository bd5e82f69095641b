"""What tests of sweeps share."""

import pytest

from jaxbl.sweeps.engine import Engine


@pytest.fixture
def computed_chunks(monkeypatch):
    """Indices of the chunks that are computed."""
    indices, compute = [], Engine.run
    monkeypatch.setattr(Engine, "run", lambda engine, chunk: indices.append(chunk.index) or compute(engine, chunk))
    return indices
