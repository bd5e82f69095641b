"""What is installed here, and whether it works: the function behind `jaxbl doctor`."""

import os
import platform
import re
import sys
import time
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .errors import InputError, NoResult
from .fused import Unsupported
from .sweeps.sweep import sweep
from .sweeps.trial import run
from .workers import PROGRAMS_VARIABLE, announce, count_cores, count_memory


class Finding(NamedTuple):
    """A line of the report: name of the check, its result, True if that is in order. If not, `outcome` says what to do."""

    name: str
    outcome: str
    good: bool = True


def examine() -> list[Finding]:
    """Look at versions, devices and folders, and run the self-test."""
    began = time.perf_counter()
    findings = [
        Finding("jaxbl", f"{version('jaxbl')} in {Path(__file__).parent}"),
        Finding("python", f"{platform.python_version()} ({sys.executable})"),
        Finding("system", f"{platform.platform(terse=True)}, {platform.machine()}"),
        *_check_packages(),
        Finding("devices", _describe_devices()),
        _check_cache(),
        _check_results_folder(),
    ]
    for name, test in (("one run", _test_one_run), ("two backends", _test_two_backends)):
        announce(f"testing {name}")
        try:
            error, measurement = test()
            is_close = error < _CLOSE
            text = measurement.format(error) + ("" if is_close else ": too far; report it with these lines")
            findings.append(Finding(name, text, is_close))
        except (InputError, NoResult, Unsupported, RuntimeError) as error:
            findings.append(Finding(name, f"{type(error).__name__}: {error}", False))
    return [*findings, Finding("time", f"{time.perf_counter() - began:.1f} s")]


def _check_packages() -> list[Finding]:
    """Check the packages that jaxbl needs, and those of its extras."""
    versions_by_extra: dict[str, dict[str, str]] = {}
    for requirement in requires("jaxbl") or ():
        name = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"""extra\s*==\s*['"](\w+)""", requirement)
        assert name is not None
        versions_by_extra.setdefault(extra[1] if extra else "", {})[name[0]] = _version(name[0])
    findings = []
    for extra, versions in versions_by_extra.items():
        # of developers
        if extra == "dev":
            continue
        missing = [name for name, version_text in versions.items() if not version_text]
        state = ", ".join(f"{name} {version_text}" for name, version_text in versions.items())
        if missing:
            state = f"lacks {', '.join(missing)}; for it: pip install 'jaxbl[{extra}]'".replace("[]", "")
        findings.append(Finding(f"extra {extra}" if extra else "packages", state, bool(extra) or not missing))
    return findings


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _describe_devices() -> str:
    devices = jax.devices()
    kinds = sorted({device.device_kind for device in devices})
    memory = count_memory() / 2**30
    return f"{len(devices)} {jax.default_backend()} ({', '.join(kinds)}); {count_cores()} cores, {memory:.0f} GiB"


def _check_cache() -> Finding:
    """Check the folder of compiled programs."""
    name = os.environ.get(PROGRAMS_VARIABLE)
    if not name:
        return Finding("cache", "compiled programs are not kept, so that every command compiles; set XDG_CACHE_HOME", False)
    folder = Path(name).parent
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return Finding("cache", f"{folder}, {size / 1e6:.0f} MB; it may be deleted at any time")


def _check_results_folder() -> Finding:
    """Check the folder for results."""
    where = Path.cwd()
    if os.access(where, os.W_OK):
        return Finding("results", f"{where / 'results'}")
    return Finding("results", f"{where} cannot be written to; go to another folder, or give --out", False)


_GAINS = {"lambda": 4.0, "alpha": 9.0}
_TORQUE, _FREQUENCY, _INERTIA, _VISCOUS = 0.1, 2.0, 0.05, 0.15
"""N m, Hz, kg m², N m s/rad."""


def _make_study(**tables: Any) -> dict[str, Any]:
    return {
        "drive": {"kind": "rigid", "motor_inertia": _INERTIA, "motor_viscous": _VISCOUS},
        "excitation": {"kind": "sine", "amplitude": _TORQUE, "frequency": _FREQUENCY},
        "observer": {"motor": _GAINS},
        "run": {"duration": 0.5},
    } | tables


def _test_one_run() -> tuple[float, str]:
    """Compare a motor under a held sine with the closed form."""
    trace = run(_make_study()).trace
    period = float(trace["t"].iloc[1] - trace["t"].iloc[0])
    decay = np.exp(-_VISCOUS * period / _INERTIA)
    velocity, exact = 0.0, []
    for torque in trace["u"]:
        exact.append(velocity)
        velocity = decay * velocity + (1.0 - decay) * torque / _VISCOUS
    error = float(np.max(np.abs(trace["motor.velocity"] - exact)) / np.max(np.abs(exact)))
    return error, "velocity within {:.1e} of the closed form"


def _test_two_backends() -> tuple[float, str]:
    """Compare the fused loop with XLA's scan on a motor with several observer gains and noise."""
    study = _make_study(
        encoders={"noise": 1e-5},
        sweep={"chunk": 4, "metrics": ["velocity_rmse"]},
        axes=[{"path": "observer.motor.alpha", "values": [9.0, 20.0, 40.0, 80.0]}],
    )
    errors = [sweep(study, backend=backend).frame["motor.velocity_rmse"].to_numpy() for backend in ("fused", "scan")]
    error = float(np.max(np.abs(errors[0] / errors[1] - 1.0)))
    return error, "fused and scan within {:.1e} of each other"


_CLOSE = 1e-6
"""Relative: steps of the plant and roundings are far below, anything that is wrong far above."""
