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
from .workers import PROGRAMS_VARIABLE, announce, count_cores


class Finding(NamedTuple):
    """One line: what was looked at, what was found, and whether it is in order; if not, `found` says what to do."""

    name: str
    found: str
    good: bool = True


def examine() -> list[Finding]:
    """Look at versions, devices and folders, and run the self-test."""
    began = time.perf_counter()
    findings = [
        Finding("jaxbl", f"{version('jaxbl')} in {Path(__file__).parent}"),
        Finding("python", f"{platform.python_version()} ({sys.executable})"),
        Finding("system", f"{platform.platform(terse=True)}, {platform.machine()}"),
        *_packages(),
        Finding("devices", _devices()),
        _cache(),
        _folder(Path()),
    ]
    for name, test in (("one run", _one_run), ("two backends", _two_backends)):
        announce(f"testing {name}")
        try:
            findings.append(test(name))
        except (InputError, NoResult, Unsupported, RuntimeError) as error:
            findings.append(Finding(name, f"{type(error).__name__}: {error}", False))
    return [*findings, Finding("time", f"{time.perf_counter() - began:.1f} s")]


def _packages() -> list[Finding]:
    """Versions of what the package needs, and of its extras."""
    wanted: dict[str, dict[str, str]] = {}
    for requirement in requires("jaxbl") or ():
        name = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"""extra\s*==\s*['"](\w+)""", requirement)
        assert name is not None
        wanted.setdefault(extra[1] if extra else "", {})[name[0]] = _version(name[0])
    findings = []
    for extra, versions in wanted.items():
        # of developers
        if extra == "dev":
            continue
        missing = [name for name, found in versions.items() if not found]
        there = ", ".join(f"{name} {found}" for name, found in versions.items() if found)
        if not extra:
            how = f"missing: {', '.join(missing)}; pip install jaxbl" if missing else there
            findings.append(Finding("packages", how, not missing))
        elif missing:
            lacking = f"lacks {', '.join(missing)}; for it: pip install 'jaxbl[{extra}]'"
            findings.append(Finding(f"extra {extra}", lacking))
        else:
            findings.append(Finding(f"extra {extra}", there))
    return findings


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _devices() -> str:
    devices = jax.devices()
    kinds = sorted({device.device_kind for device in devices})
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{len(devices)} {jax.default_backend()} ({', '.join(kinds)}); {count_cores()} cores, {memory:.0f} GiB"


def _cache() -> Finding:
    """The folder of compiled programs."""
    name = os.environ.get(PROGRAMS_VARIABLE)
    if not name:
        return Finding("cache", "compiled programs are not kept, so that every command compiles; set XDG_CACHE_HOME", False)
    folder = Path(name).parent
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return Finding("cache", f"{folder}, {size / 1e6:.0f} MB; it may be deleted at any time")


def _folder(folder: Path) -> Finding:
    """Where results go unless a command says otherwise."""
    where = folder.absolute()
    if os.access(where, os.W_OK):
        return Finding("results", f"{where / 'results'}")
    return Finding("results", f"{where} cannot be written to; go to another folder, or give --out", False)


_GAINS = {"lambda": 4.0, "alpha": 9.0}
_TORQUE, _FREQUENCY, _INERTIA, _VISCOUS = 0.1, 2.0, 0.05, 0.15
"""N m, Hz, kg m², N m s/rad."""


def _study(**tables: Any) -> dict[str, Any]:
    return {
        "drive": {"kind": "rigid", "motor_inertia": _INERTIA, "motor_viscous": _VISCOUS},
        "excitation": {"kind": "sine", "amplitude": _TORQUE, "frequency": _FREQUENCY},
        "observer": {"motor": _GAINS},
        "run": {"duration": 0.5},
    } | tables


def _one_run(name: str) -> Finding:
    """A motor under a held sine, against the solution in closed form."""
    trace = run(_study()).trace
    period = float(trace["t"].iloc[1] - trace["t"].iloc[0])
    decay = np.exp(-_VISCOUS * period / _INERTIA)
    velocity, exact = 0.0, []
    for torque in trace["u"]:
        exact.append(velocity)
        velocity = decay * velocity + (1.0 - decay) * torque / _VISCOUS
    error = float(np.max(np.abs(trace["motor.velocity"] - exact)) / np.max(np.abs(exact)))
    return _judged(name, f"velocity within {error:.1e} of the closed form", error < _CLOSE)


def _two_backends(name: str) -> Finding:
    """The motor at several gains of its observer and with noise, by the fused loop and by XLA's."""
    study = _study(
        encoders={"noise": 1e-5},
        sweep={"chunk": 4, "metrics": ["velocity_rmse"]},
        axes=[{"path": "observer.motor.alpha", "values": [9.0, 20.0, 40.0, 80.0]}],
    )
    found = [sweep(study, backend=backend).frame["motor.velocity_rmse"].to_numpy() for backend in ("fused", "scan")]
    error = float(np.max(np.abs(found[0] / found[1] - 1.0)))
    return _judged(name, f"fused and scan within {error:.1e} of each other", error < _CLOSE)


_CLOSE = 1e-6
"""Relative: steps of the plant and roundings are far below, anything that is wrong far above."""


def _judged(name: str, found: str, good: bool) -> Finding:
    return Finding(name, found if good else f"{found}: too far; report it with these lines", good)
