"""Compiled programs on disk: another process finds them without tracing, and what may have changed is not found."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_server import run_python

from jaxbl.drive.effects import make_effect
from jaxbl.fused import program_cache

SCRIPT = """
import sys
import numpy as np
import jax
import jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
from jaxbl.config import prepare, read_config
from jaxbl.drive.parameters import as_arrays
from jaxbl.fused.single_plant import simulate_plant
from jaxbl.diagnosis import candidates

traced = []
candidates.effect_path, effect_path = lambda *arguments: traced.append(1) or effect_path(*arguments), candidates.effect_path
time = np.arange(200) * 1e-3
study = {"title": "t", "drive": {"kind": "rigid", "motor_inertia": 0.05, "motor_viscous": 0.1},
         "excitation": {"kind": "sine", "amplitude": 1.0, "frequency": 2.0}, 
         "observer": {"motor": {"lambda": 9.0, "alpha": 90.0}},
         "run": {"duration": 1.0}}
model = as_arrays(prepare(read_config(study)), float)
states = simulate_plant(model, model.plant.init(model.initial), np.sin(5.0 * time))
motion = [{"motor": np.sin(9.0 * time)}] * 3
part = candidates.Part(time, time, *motion, None, None, None)
needed = candidates._find_needed(model, part)["motor"]
print(len(traced), repr(float(np.sum(needed))), repr(float(np.sum(states.position["motor"]))))
"""


def test_another_process_does_not_trace(tmp_path, monkeypatch):
    monkeypatch.setenv(program_cache.PROGRAMS_VARIABLE, str(tmp_path))
    output = []
    for _ in range(2):
        result = run_python("-c", SCRIPT, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        output.append(result.stdout.split())
    assert output[0][0] == "1" and output[1][0] == "0"
    assert output[0][1:] == output[1][1:]


def test_names_tell_structures_apart(tmp_path, monkeypatch):
    monkeypatch.setenv(program_cache.PROGRAMS_VARIABLE, str(tmp_path))
    drag, lag = make_effect("motor.quadratic_drag", drag=1.0), make_effect("actuator.lag", time_constant=1.0)
    inputs = [
        drag,
        lag,
        make_effect("load.quadratic_drag", drag=1.0),
        jnp.zeros(3),
        jnp.zeros(4),
        np.zeros(3, np.float32),
        1,
        1.0,
    ]
    keys = [program_cache.program_key("program", number) for number in inputs]
    assert None not in keys and len(set(keys)) == len(keys)
    # of arrays what they are, not what they hold
    assert program_cache.program_key("program", jnp.ones(3)) == program_cache.program_key("program", jnp.zeros(3))
    assert program_cache.program_key(
        "program", make_effect("motor.quadratic_drag", drag=jnp.ones(()))
    ) == program_cache.program_key("program", make_effect("motor.quadratic_drag", drag=jnp.zeros(())))
    with jax.enable_x64(False):
        assert program_cache.program_key("program", 1) != program_cache.program_key("program", 1.0) != keys[-1]


def test_what_is_not_known_by_its_text_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setenv(program_cache.PROGRAMS_VARIABLE, str(tmp_path))
    assert program_cache.program_key("program", lambda x: x) is None
    assert program_cache.program_key("program", np.random.default_rng(0)) is None
    monkeypatch.setenv(program_cache.PROGRAMS_VARIABLE, "")
    assert program_cache.program_key("program", 1) is None


@pytest.mark.parametrize("content", [b"", b"half a pickle"])
def test_a_broken_file_is_no_program(tmp_path, monkeypatch, content):
    monkeypatch.setenv(program_cache.PROGRAMS_VARIABLE, str(tmp_path))
    key = program_cache.program_key("program", 1)
    program_cache.save(key, [1, 2])
    assert program_cache.load(key) == [1, 2]
    folder = program_cache.cache_folder()
    assert folder is not None and key is not None
    (folder / key).write_bytes(content)
    assert program_cache.load(key) is None


def test_programs_in_a_folder_that_others_can_write_to_are_not_loaded(tmp_path, monkeypatch):
    """They are pickled: to load one is to run it."""
    monkeypatch.setenv(program_cache.PROGRAMS_VARIABLE, str(tmp_path / "programs"))
    program_cache._make_folder.cache_clear()
    program_cache.save("key", 3)
    assert program_cache.load("key") == 3
    (tmp_path / "programs").chmod(0o777)
    program_cache._make_folder.cache_clear()
    assert program_cache.load("key") is None
    program_cache._make_folder.cache_clear()
