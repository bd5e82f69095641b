"""Functional Mock-up Units: valid for another implementation of FMI, and the motion that `jaxbl.run` finds."""

import ctypes
import functools
import os
import shutil
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from effect_values import ENCODERS, VALUES
from native import STRICT, run_program, to_integers
from small_study import rigid_study, small_study
from strict import Strict

import jaxbl
from jaxbl.config import read_config
from jaxbl.drive.effects import EFFECTS
from jaxbl.drive.transmission import LinearShaft
from jaxbl.errors import InputError
from jaxbl.exports.fmu import _WINDOWS, find_base_units, write_unit
from jaxbl.exports.plant import build_plant_program

fmpy = pytest.importorskip("fmpy", reason="runs FMUs by FMPy (pip install 'jaxbl[fmu]')")
from fmpy.fmi1 import FMICallException  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
COMPILED = pytest.mark.program("cc")
TOLERANCE = 1e-9
"""Of each output's range: XLA and the fused loop round otherwise than the code."""

# of the delay's own size, samples are shorter here
NUMBERS = VALUES | ENCODERS | {"actuator.delay": {"delay": 2.3e-3}}
EFFECT_TABLES = [
    {"kind": kind, **{key: list(number) if isinstance(number, tuple) else number for key, number in numbers.items()}}
    for kind, numbers in NUMBERS.items()
]
EXCITATION = {"kind": "multisine", "amplitude": 5.0, "frequency": 0.7}
GAP = {"law": "dead_zone", "stiffness": 1.0, "half_gap": 0.1}
INITIAL = {"motor_position": 0.3, "motor_velocity": -1.0, "load_position": 0.02, "load_velocity": 0.4}


def study(*places, base=small_study, **tables):
    """A drive that swings for 1.5 s, with the effects of some places; encoders with noise and counts."""
    effects = [table for table in EFFECT_TABLES if table["kind"].startswith(places)] if places else []
    inputs = {"effects": effects, "excitation": EXCITATION, "encoders": {"noise": 1e-3, "motor_resolution": 1e-3}}
    return base({"run.duration": 1.5, "run.substeps": 4}, **inputs | tables)


GAP_CHANGES = {"drive.motor_inertia": 0.08, "transmission.half_gap": 0.05, "effects.load.gravity.phase": 1.1,
               "initial.motor_velocity": 2.0}  # fmt: skip
STUDIES = {
    "rigid": study("motor.pre", "actuator.back", "encoder.", base=rigid_study),
    "shaft": study(transmission={"law": "linear_shaft", "stiffness": 1.0}),
    "moved gap": study(transmission=GAP, initial=INITIAL),
    "all effects": study("", initial=INITIAL),
    "gap": study(transmission=GAP),
    "gap with effects": study("load.gra", "motor.cou", transmission=GAP),
    "changed gap": study("load.gra", "motor.cou", transmission=GAP | {"half_gap": 0.05}, initial={"motor_velocity": 2.0}),
}
STUDIES["changed gap"]["drive"] |= {"motor_inertia": 0.08}
for table in STUDIES["changed gap"]["effects"]:
    table |= {"phase": 1.1} if "phase" in table else {}


@pytest.fixture(autouse=True)
def _for_this_machine(monkeypatch):
    """Export for this machine alone, because a second compilation takes half a second."""
    monkeypatch.setattr("jaxbl.exports.fmu._WINDOWS", _WINDOWS._replace(compiler="not here"))


@pytest.fixture
def windows_too(_for_this_machine, monkeypatch):
    monkeypatch.setattr("jaxbl.exports.fmu._WINDOWS", _WINDOWS)


@pytest.fixture
def sources_alone(monkeypatch):
    """Export without a binary."""
    offer_programs(monkeypatch)


def export_unit(data, folder, fmi=3, **options):
    """The path of a study's FMU, and what `export.json` says."""
    export = jaxbl.export(data, folder, "fmu", fmi=fmi, **options)
    return str(export.folder / export.files[0]), export.summary


@pytest.fixture(scope="module")
def unit_of(tmp_path_factory):
    """Return a function that exports a study by its name, once."""
    return functools.cache(lambda name, fmi: export_unit(STUDIES[name], tmp_path_factory.mktemp("unit"), fmi))


@functools.cache
def simulate_study(name):
    """The trace of a study."""
    return jaxbl.run(STUDIES[name]).trace


def run_by_fmpy(path, summary, trace, start=None, **options):
    """Simulate by FMPy under the trace's input."""
    period = summary["sample_period"]
    inputs = np.zeros(len(trace), [("time", float), ("u", float)])
    inputs["time"], inputs["u"] = np.arange(len(trace)) * period, trace.u
    times = {"stop_time": inputs["time"][-1], "step_size": period, "output_interval": period}
    return fmpy.simulate_fmu(path, input=inputs, start_values=start or {}, **times, **options)


def assert_agreement(outputs, trace, tolerance=TOLERANCE):
    """Outputs at the samples are the truth in a trace; means over the last sample are those of the sample before."""
    two = "z" in outputs.dtype.names
    expected = {name: trace[name].to_numpy() for name in outputs.dtype.names if name not in ("time", "z")}
    assert len(expected) == (7 if two else 4) and len(outputs) == len(trace)
    for name, truth in expected.items():
        output = np.asarray(outputs[name])
        if name.endswith("acceleration") or (name == "torque" and not two):
            assert output[0] == 0.0
            output, truth = output[1:], truth[:-1]
        assert np.ptp(truth) > 0.0
        assert np.max(np.abs(output - truth)) <= tolerance * np.ptp(truth), name


class Instance:
    """One instance in either version of FMI, by names of its variables; `messages` are the lines of its log."""

    def __init__(self, path, token=None):
        self.folder, self.messages = fmpy.extract(path), []
        self.description = fmpy.read_model_description(path)
        self.is_fmi2 = self.description.fmiVersion == "2.0"
        if token is not None:
            self.description.guid = token
        self._references = {
            model_variable.name: model_variable.valueReference for model_variable in self.description.modelVariables
        }
        logger = (lambda *inputs: self.messages.append(inputs[-1].decode())) if self.is_fmi2 else self._collect_message
        self.unit = fmpy.instantiate_fmu(self.folder, self.description, "CoSimulation", logger=logger)

    def _collect_message(self, environment, status, category, message):
        self.messages.append(message.decode())

    def begin(self, start=0.0, stop=None):
        if self.is_fmi2:
            self.unit.setupExperiment(startTime=start, stopTime=stop)
            self.unit.enterInitializationMode()
        else:
            self.unit.enterInitializationMode(startTime=start, stopTime=stop)
        self.unit.exitInitializationMode()
        return self

    def set(self, **values):
        (self.unit.setReal if self.is_fmi2 else self.unit.setFloat64)(
            [self._references[name.replace("__", ".")] for name in values], list(values.values())
        )

    def get(self, *names):
        return (self.unit.getReal if self.is_fmi2 else self.unit.getFloat64)([self._references[name] for name in names])

    def outputs(self):
        return self.get(
            *(
                model_variable.name
                for model_variable in self.description.modelVariables
                if model_variable.causality == "output"
            )
        )

    def time(self):
        last_successful = 2
        return self.unit.getRealStatus(last_successful) if self.is_fmi2 else self.get("time")[0]

    def step(self, time, length):
        self.unit.doStep(currentCommunicationPoint=time, communicationStepSize=length)

    def run(self, torques, first=0, period=1e-3):
        rows = []
        for i, torque in enumerate(torques, first):
            self.set(u=torque)
            self.step(i * period, period)
            rows.append(self.outputs())
        return np.array(rows)

    def state(self):
        return self.unit.getFMUstate() if self.is_fmi2 else self.unit.getFMUState()

    def restore(self, state):
        (self.unit.setFMUstate if self.is_fmi2 else self.unit.setFMUState)(state)

    def bytes_of(self, state):
        return (self.unit.serializeFMUstate if self.is_fmi2 else self.unit.serializeFMUState)(state)

    def state_of(self, serialized):
        return (self.unit.deSerializeFMUstate if self.is_fmi2 else self.unit.deserializeFMUState)(serialized)

    def release(self, state):
        (self.unit.freeFMUstate if self.is_fmi2 else self.unit.freeFMUState)(state)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.unit.freeInstance()
        shutil.rmtree(self.folder)


@COMPILED
@pytest.mark.parametrize(
    ("name", "fmi"), [("rigid", 2), ("rigid", 3), ("shaft", 3), ("moved gap", 2), ("moved gap", 3), ("all effects", 3)]
)
def test_the_free_run_is_that_of_the_simulation(unit_of, name, fmi):
    assert_agreement(run_by_fmpy(*unit_of(name, fmi), simulate_study(name)), simulate_study(name))


@pytest.mark.parametrize(("name", "fmi"), [("rigid", 2), ("gap", 3), ("all effects", 3)])
def test_tools_find_no_fault_in_the_description(unit_of, name, fmi):
    path, _ = unit_of(name, fmi)
    assert validate_fmu(path) == []


def test_every_effect_of_the_package_can_be_said(unit_of):
    """Those of other packages, too, unless they have operations that code does not know."""
    assert {kind for kind, cls in EFFECTS.items() if cls.__module__.startswith("jaxbl.")} == NUMBERS.keys()
    _, summary = unit_of("all effects", 3)
    variability = {variable["name"]: variable["variability"] for variable in summary["variables"]}
    numbers = {name for name in variability if name.startswith("effects.")}
    expected = {
        f"effects.{table['kind']}.{key}"
        for table in EFFECT_TABLES
        for key, number in table.items()
        if key != "kind" and not isinstance(number, list | bool) and not table["kind"].startswith("encoder.")
    }
    assert expected <= numbers
    assert all(variability[name] == "tunable" for name in numbers)
    assert not any(name.startswith("effects.encoder.") for name in numbers)


@COMPILED
@pytest.mark.parametrize("precision", ["double", "float"])
def test_the_motion_is_the_traced_step_bit_for_bit(tmp_path, precision):
    """Over hard impacts in a gap, which amplify the last digit: there no two roundings agree for long."""
    drive = {"kind": "two_inertia", "motor_inertia": 0.05, "motor_viscous": 0.01, "load_inertia": 0.5, "load_viscous": 0.02}
    data = study("motor.cou", "load.pre", drive=drive | {"gear_ratio": 2.0}, transmission=GAP | {"stiffness": 30.0})
    path, _ = export_unit(data, tmp_path, precision=precision)
    dtype = np.dtype(np.float32 if precision == "float" else np.float64)
    torques = (5.0 * np.sin(8.0 * np.arange(1200) * 1e-3)).astype(dtype)
    plant = build_plant_program(read_config(data), "drive", dtype)
    block = Strict(plant.program.block)
    inputs = {name: block.real(number.value) for name, number in plant.parameters.items()}
    first, later = plant.program.block.start_inputs, plant.program.block.inputs[1:]
    start = block.start([inputs[instance.name] for instance in first])
    state, rows = start[: len(plant.program.block.state)], []
    for torque in torques:
        state, out = block.step(state, [block.real(torque), *(inputs[instance.name] for instance in later)])
        rows.append(out)
    with Instance(path) as instance:
        trial = instance.begin().run(torques.astype(float))
    assert (to_integers(trial) == to_integers(np.array(rows, dtype).astype(float))).all()


@pytest.fixture(scope="module")
def wine(tmp_path_factory):
    """The environment of Wine: a folder for its Windows, which it makes once."""
    return os.environ | {
        "WINEPREFIX": str(tmp_path_factory.mktemp("wine")),
        "WINEDEBUG": "-all",
        "WINEDLLOVERRIDES": "mscoree,mshtml=",
    }


@COMPILED
@VERSIONS
@pytest.mark.program("x86_64-w64-mingw32-gcc", "wine")
@pytest.mark.usefixtures("windows_too")
def test_on_windows_it_runs_with_the_same_bits(tmp_path, wine, fmi):
    """A program for Windows runs it under Wine; a step of part of a period is refused with the same words."""
    path, summary = export_unit(study("motor.cou", "load.pre", transmission=GAP), tmp_path, fmi, name="axis")
    assert summary["binaries"] == (["linux64", "win64"] if fmi == 2 else ["x86_64-linux", "x86_64-windows"])
    library = zipfile.ZipFile(path).extract(f"binaries/{summary['binaries'][1]}/axis.dll", tmp_path)
    # the same study has the same bytes at any time: there is no time of linking in the header
    content = Path(library).read_bytes()
    assert content[int.from_bytes(content[60:64], "little") + 8 :][:4] == bytes(4)
    run_program("x86_64-w64-mingw32-gcc", "-O1", Path(__file__).parent / "run_on_windows.c", "-o", "run.exe", cwd=tmp_path)
    torques = [5.0 * np.sin(8.0 * i * 1e-3) for i in range(500)]
    with Instance(path) as instance:
        expected = instance.begin().run(torques)
        with pytest.raises(FMICallException):
            instance.step(0.5, 0.3e-3)
    arguments = library, fmi, summary["token"], summary["sample_period"], expected.shape[1]
    input_lines = "\n".join(repr(float(torque)) for torque in torques)
    stdout = run_program("wine", "run.exe", *arguments, cwd=tmp_path, env=wine, input=input_lines).stdout
    *rows, refusal = stdout.splitlines()
    assert refusal == instance.messages[-1]
    actual = np.array([[int(word, 16) for word in row.split()] for row in rows], np.uint64)
    assert (actual.view(np.int64) == to_integers(expected)).all()


@COMPILED
def test_in_single_precision_it_is_near_the_simulation(tmp_path):
    path, summary = export_unit(small_study({"run.precision": "float32"}, **STUDIES["moved gap"]), tmp_path)
    assert summary["precision"] == "float"
    # 1e-7 of rounding; accelerations are differences over a sample, which make it a thousand times as large
    trace = simulate_study("moved gap")
    assert_agreement(run_by_fmpy(path, summary, trace), trace, 2e-4)


@COMPILED
@VERSIONS
def test_parameters_are_those_of_the_study(unit_of, fmi):
    """Set before the run they give the run of the changed study, set between steps they act from there on."""
    path, summary = unit_of("gap with effects", fmi)
    trace = simulate_study("changed gap")
    assert_agreement(run_by_fmpy(path, summary, trace, GAP_CHANGES), trace)
    with Instance(path) as instance:
        instance.begin()
        before = instance.run([1.0] * 5)
        instance.set(drive__motor_viscous=3.0)
        slow = instance.run([1.0], 5)
        instance.unit.reset()
        instance.begin()
        assert (instance.run([1.0] * 5) == before).all()
        assert not (instance.run([1.0], 5) == slow).all()


@COMPILED
@VERSIONS
def test_states_are_kept_and_instances_are_apart(tmp_path, fmi):
    path, _ = export_unit(study("actuator.de", "actuator.la", "load.pre", transmission=GAP), tmp_path, fmi)
    torques = 3.0 * np.sin(0.2 * np.arange(60))
    with Instance(path) as instance, Instance(path) as second:
        instance.begin(), second.begin()
        instance.run(torques[:30])
        stored_state = instance.state()
        first = instance.run(torques[30:], 30)
        instance.restore(stored_state)
        assert (instance.run(torques[30:], 30) == first).all()
        # what the other one did changed nothing here
        alternating_rows = []
        instance.restore(stored_state)
        for i, torque in enumerate(torques[30:], 30):
            alternating_rows.append(instance.run([torque], i)[0])
            second.run([-torque], i - 30)
        assert (np.array(alternating_rows) == first).all()
        bytes_of = instance.bytes_of(stored_state)
        restored = second.state_of(bytes_of)
        second.restore(restored)
        assert (second.run(torques[30:], 30) == first).all()
        for other in (bytes_of[:-1], bytes_of + b"x", b"x" + bytes_of[1:]):
            with pytest.raises(FMICallException):
                second.state_of(other)
        assert second.messages[-1] == f"these {len(bytes_of)} bytes are no state of this model"
        instance.release(stored_state), second.release(restored)


@COMPILED
@VERSIONS
def test_steps_are_multiples_of_the_sample_period(unit_of, fmi):
    path, _ = unit_of("moved gap", fmi)
    # of several instances of FMI 2, FMPy gives the log to the last one
    with Instance(path) as second, Instance(path) as instance:
        instance.begin(10.0), second.begin()
        assert instance.get("motor.position", "load.velocity", "z") == [0.3, 0.4, 0.3 - 5.0 * 0.02]
        assert instance.time() == 10.0
        instance.set(u=1.5), second.set(u=1.5)
        # as sums of decimal numbers give it
        instance.step(10.0, 0.1 + 0.2 - 0.29)
        for i in range(10):
            second.step(i * 1e-3, 1e-3)
        assert instance.outputs() == second.outputs()
        assert instance.time() == 10.01
        before = instance.outputs()
        for time, length, message in (
            (10.01, 1.5e-3, "the communication step size 0.0015 s should be a multiple of the sample period 0.001 s"),
            (10.01, 5e-4, "should be a multiple"),
            (10.01, 0.0, "should be a multiple"),
            (10.01, -1e-3, "should be a multiple"),
            (10.01, float("nan"), "should be a multiple"),
            (0.01, 1e-3, "but the instance is at 10.01 s"),
        ):
            with pytest.raises(FMICallException, match="status 3"):
                instance.step(time, length)
            assert message in instance.messages[-1]
        assert instance.outputs() == before
        instance.step(10.01, 1e-3)


@COMPILED
@VERSIONS
def test_no_step_leads_past_the_stop_time(unit_of, fmi):
    """FMI 2.0 and 3.0: "if the environment tries to compute past stopTime", an error."""
    path, _ = unit_of("gap", fmi)
    with Instance(path) as instance:
        # as a sum of decimal numbers gives it
        instance.begin(0.1, stop=0.1 + 0.2 - 0.29 + 0.1)
        instance.step(0.1, 9e-3)
        with pytest.raises(FMICallException, match="status 3"):
            instance.step(0.109, 2e-3)
        assert instance.messages == ["a step to 0.111 s, past the stop time 0.11 s"]
        instance.step(0.109, 1e-3)
        assert instance.time() == pytest.approx(0.11)
        with pytest.raises(FMICallException, match="status 3"):
            instance.step(0.11, 1e-3)
        # the next run has a stop time of its own, or none
        instance.unit.reset()
        instance.begin().run([1.0] * 200)


@COMPILED
@VERSIONS
def test_tools_are_told_that_steps_do_not_vary(unit_of, fmi):
    """FMPy ends before a stop time between samples, and does not stop at events of the input between them."""
    path, _ = unit_of("gap", fmi)
    inputs = np.array([(0.0, 0.0), (0.0105, 0.0), (0.0105, 1.0), (0.1, 1.0)], [("time", float), ("u", float)])
    fmu = fmpy.simulate_fmu(path, input=inputs, stop_time=0.0995, output_interval=1e-3)
    assert fmu["time"][-1] == pytest.approx(0.099) and fmu["motor.velocity"][-1] > 0.0


@COMPILED
@VERSIONS
def test_what_a_phase_does_not_allow_is_refused(unit_of, fmi):
    path, _ = unit_of("gap", fmi)
    with Instance(path) as instance:
        with pytest.raises(FMICallException):
            instance.unit.terminate()
        assert instance.messages[-1] == "only what has been initialized can be terminated"
        with pytest.raises(FMICallException):
            instance.unit.exitInitializationMode()
        instance.begin()
        for again in (instance.begin, instance.unit.exitInitializationMode):
            with pytest.raises(FMICallException):
                again()
        outputs = instance.run([1.0] * 3)[-1]
        instance.unit.terminate()
        with pytest.raises(FMICallException):
            instance.set(u=2.0)
        assert instance.messages[-1] == "nothing can be set after termination"
        for no_more in (instance.unit.terminate, lambda: instance.step(3e-3, 1e-3)):
            with pytest.raises(FMICallException):
                no_more()
        assert instance.outputs() == list(outputs)


@COMPILED
@VERSIONS
def test_missing_arguments_are_refused(unit_of, fmi):
    path, _ = unit_of("gap", fmi)
    state, number = ("FMUstate", "Real") if fmi == 2 else ("FMUState", "Float64")
    values = [f"Get{number}", f"Set{number}"]
    with Instance(path) as instance:

        def call(name, component):
            # items of a library, unlike its attributes, are not those that FMPy calls
            inputs = component, None, ctypes.c_size_t(1), None, ctypes.c_size_t(1)
            return instance.unit.dll[f"fmi{fmi}{name}"](*inputs)

        for name in ("Reset", "Terminate", "ExitInitializationMode", f"Get{state}", f"Set{state}", *values):
            assert call(name, None) == 3
        for name in (f"Get{state}", f"Set{state}", *values):
            assert call(name, ctypes.c_void_p(instance.unit.component)) == 3
        assert instance.messages[-1] == "1 values for 1 variables, or no place for them"


@COMPILED
def test_event_mode_is_refused(unit_of):
    path, _ = unit_of("gap", 3)
    with Instance(path) as instance, pytest.raises(Exception, match="Failed to instantiate"):
        instance.unit.instantiate(eventModeUsed=True)


@COMPILED
@VERSIONS
def test_what_is_refused_has_a_line_in_the_log(unit_of, fmi):
    path, _ = unit_of("gap", fmi)
    with Instance(path) as instance:
        with pytest.raises(FMICallException):
            instance.set(drive__motor_inertia=0.0)
        assert instance.messages == ["drive.motor_inertia: 0 is out of range (min 0, exclusive, max inf)"]
        with pytest.raises(FMICallException):
            instance.set(drive__motor_viscous=0.3, drive__load_viscous=-1.0)
        assert instance.get("drive.motor_viscous") == [0.15]
        with pytest.raises(FMICallException):
            instance.set(u=float("nan"))
        with pytest.raises(FMICallException):
            instance.step(0.0, 1e-3)
        assert instance.messages[-1] == "a step needs an initialized instance"
        instance.begin()
        for name in ("initial__motor_position", "motor__position", *(() if instance.is_fmi2 else ("time",))):
            with pytest.raises(FMICallException):
                instance.set(**{name: 1.0})
            assert instance.messages[-1].startswith(f"{name.replace('__', '.')} cannot be set")
        instance.set(transmission__stiffness=1e12)
        with pytest.raises(FMICallException):
            instance.run([1.0] * 300)
        assert "the motion diverged" in instance.messages[-1]
        instance.unit.reset()
        assert np.isfinite(instance.begin().run([1.0] * 10)).all()
    with pytest.raises(Exception, match="Failed to instantiate"):
        Instance(path, token="another")


def test_without_a_compiler_it_holds_the_sources_alone(tmp_path, monkeypatch):
    offer_programs(monkeypatch)
    export = jaxbl.export(study(), tmp_path, "fmu", name="axis")
    assert export.lines == [
        "axis.fmu: FMI 3.0, co-simulation, steps of 0.001 s, 12 parameters; the sources alone: no C compiler (cc) was found."
    ]
    assert export.summary["binaries"] == []
    names = zipfile.ZipFile(tmp_path / "axis.fmu").namelist()
    assert {"modelDescription.xml", "sources/buildDescription.xml", "sources/axis.c", "sources/fmi-3.c"} <= {*names}
    assert not [name for name in names if name.startswith("binaries")]
    assert validate_fmu(str(tmp_path / "axis.fmu")) == []


def offer_programs(monkeypatch, *programs):
    """Let the export find these programs and no others."""
    monkeypatch.setattr(
        "jaxbl.exports.fmu.shutil.which", {program: shutil.which(program) or program for program in programs}.get
    )


@pytest.mark.parametrize(
    ("machine", "fmi", "reason"),
    [
        (("Windows", "AMD64"), 2, "no C compiler (x86_64-w64-mingw32-gcc) was found"),
        (("Linux", "aarch64"), 2, "for Linux on aarch64 none is compiled in FMI 2.0"),
        (("Linux", "riscv64"), 3, "for Linux on riscv64 none is compiled in FMI 3.0"),
    ],
)
def test_on_other_machines_it_holds_the_sources_alone(tmp_path, monkeypatch, machine, fmi, reason):
    offer_programs(monkeypatch, "cc")
    for name, value in zip(("system", "machine"), machine, strict=True):
        monkeypatch.setattr(f"jaxbl.exports.fmu.platform.{name}", lambda value=value: value)
    assert jaxbl.export(study(), tmp_path, "fmu", fmi=fmi).lines[0].endswith(f"; the sources alone: {reason}.")


@pytest.mark.program("x86_64-w64-mingw32-gcc")
@pytest.mark.usefixtures("windows_too")
def test_with_a_compiler_for_windows_alone_it_says_which_binary_is_missing(tmp_path, monkeypatch):
    offer_programs(monkeypatch, "x86_64-w64-mingw32-gcc")
    export = jaxbl.export(study(), tmp_path, "fmu")
    assert export.lines[0].endswith("; a binary for x86_64-windows, and the sources.")
    assert export.lines[1:] == ["One more binary is missing: no C compiler (cc) was found."]
    assert export.summary["binaries"] == ["x86_64-windows"]


def test_a_compiler_that_fails_is_told(tmp_path, monkeypatch):
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho 'no headers' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setattr("jaxbl.exports.fmu.shutil.which", {"cc": str(broken)}.get)
    export = jaxbl.export(study(), tmp_path / "new", "fmu")
    assert f"the sources alone: {broken} failed: no headers." in export.lines[0]


# each pair of compiler, version and precision
@pytest.mark.parametrize(
    ("compiler", "fmi", "precision"),
    [
        pytest.param(*names, marks=pytest.mark.program(names[0]))
        for names in [("gcc", 2, "float"), ("gcc", 3, "double"), ("clang", 2, "double"), ("clang", 3, "float")]
    ],
)
@pytest.mark.usefixtures("sources_alone")
def test_the_sources_compile_without_a_warning_or_a_global_number(tmp_path, compiler, fmi, precision):
    path, _ = export_unit(study("transmission.", "load.flex"), tmp_path, fmi, precision=precision)
    zipfile.ZipFile(path).extractall(tmp_path / "there")
    sources = tmp_path / "there" / "sources"
    run_program(compiler, *STRICT, "-O2", "-c", *(file.name for file in sources.glob("*.c")), cwd=sources)
    # kinds of symbols: of data that can be written there is none
    symbol_kinds = {line[17:18] for line in run_program("nm", *sources.glob("*.o")).stdout.splitlines()}
    assert {"T", "r"} <= symbol_kinds
    assert not symbol_kinds & {*"dDbBC"}


ODD_CALLS = """
#include "fmi-3.c"

static const double odd[] = {0.0, -1.0, 1e-320, 1e308, -1e308, (double)NAN, (double)INFINITY};
static int lines = 0;

static void count(void *environment, int status, const char *category, const char *message)
{
    (void)environment; (void)status; (void)category; (void)message;
    lines++;
}

static void *make(void)
{
    return fmi3InstantiateCoSimulation("", MODEL_TOKEN, NULL, false, false, false, false, NULL, 0u, NULL, count, NULL);
}

int main(void)
{
    void *instance = make(), *second = make(), *state = NULL, *copy = NULL;
    uint8_t bytes[BYTES];
    uint32_t i, k, first = 1u;
    double value, reached;
    bool event, terminate, early;
    int failures = 0;
    for (i = 0u; i <= MODEL_VARIABLES; i++)
        for (k = 0u; k < sizeof(odd) / sizeof(odd[0]); k++)
        {
            const int before = lines;
            int refused = fmi3SetFloat64(instance, &i, 1u, &odd[k], 1u) != 0;
            refused += fmi3EnterInitializationMode(instance, false, 0.0, odd[k], true, 1e9) != 0;
            refused += fmi3ExitInitializationMode(instance) != 0;
            refused += fmi3SetFloat64(instance, &first, 1u, &odd[k], 1u) != 0;
            refused += fmi3DoStep(instance, odd[k], 3.0 * MODEL_PERIOD, true, &event, &terminate, &early, &reached) != 0;
            refused += fmi3DoStep(instance, reached, odd[k], true, &event, &terminate, &early, &reached) != 0;
            refused += fmi3GetFloat64(instance, &i, 1u, &value, 1u) != 0;
            failures += fmi3GetFMUState(instance, &state) + fmi3SerializeFMUState(instance, state, bytes, BYTES);
            failures += fmi3DeserializeFMUState(second, bytes, BYTES, &copy) + fmi3SetFMUState(second, copy);
            failures += (lines - before) != refused;
            failures += fmi3Reset(instance);
        }
    failures += fmi3FreeFMUState(instance, &state) + fmi3FreeFMUState(instance, &copy);
    fmi3FreeInstance(instance);
    fmi3FreeInstance(second);
    return failures + (lines == 0);
}
"""


@VERSIONS
@pytest.mark.program("gcc")
@pytest.mark.usefixtures("sources_alone")
def test_many_are_linked_into_one_program_by_a_prefix(tmp_path, fmi):
    names = "axis", "table"
    for name in names:
        path, _ = export_unit(STUDIES["gap"], tmp_path / name, fmi, name=name)
        zipfile.ZipFile(path).extractall(tmp_path / name)
        files = f"fmi-{fmi}.c", f"{name}.c"
        run_program("gcc", "-std=c99", f"-DFMI{fmi}_FUNCTION_PREFIX={name}_", "-c", *files, cwd=tmp_path / name / "sources")
    calls = [f"{name}_fmi{fmi}GetVersion" for name in names]
    declarations = "".join(f"const char *{call}(void);\n" for call in calls)
    (tmp_path / "both.c").write_text(f"{declarations}int main(void) {{ return *{calls[0]}() - *{calls[1]}(); }}\n")
    run_program("gcc", "both.c", *tmp_path.glob("*/sources/*.o"), "-lm", "-o", "both", cwd=tmp_path)
    run_program("./both", cwd=tmp_path)


@pytest.mark.program("gcc")
@pytest.mark.usefixtures("sources_alone")
def test_odd_calls_do_nothing_undefined(tmp_path):
    """No memory that is another's or lost, no overflow; a line in the log for each call that is refused."""
    path, _ = export_unit(study("actuator.", "motor.pre", "load.flex", transmission=GAP), tmp_path)
    zipfile.ZipFile(path).extractall(tmp_path)
    (tmp_path / "sources" / "odd.c").write_text(ODD_CALLS)
    checks = "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"
    run_program("gcc", "-std=c99", "-g", *checks, "odd.c", "drive.c", "-lm", "-o", "odd", cwd=tmp_path / "sources")
    run_program("./odd", cwd=tmp_path / "sources")


@VERSIONS
@pytest.mark.program("cc", "cmake")
def test_another_tool_compiles_the_sources_from_what_the_fmu_says_of_them(tmp_path, monkeypatch, fmi):
    """FMPy by CMake, which reads which files these are."""
    build = pytest.importorskip("fmpy.build", reason="compiles FMUs by FMPy (pip install 'jaxbl[fmu]')")
    with monkeypatch.context() as without:
        offer_programs(without)
        path, summary = export_unit(STUDIES["moved gap"], tmp_path, fmi)
    folder = fmpy.extract(path, tmp_path / "there")
    (tmp_path / "build").mkdir()
    build.build_platform_binary(folder, tmp_path / "build")
    trace = simulate_study("moved gap")
    assert_agreement(run_by_fmpy(folder, summary, trace), trace)


def test_the_same_study_gives_the_same_bytes_and_another_one_another_token(tmp_path):
    files, tokens = [], []
    for i, name in enumerate(("shaft", "shaft", "gap")):
        path, summary = export_unit(STUDIES[name], tmp_path / str(i))
        files.append(Path(path).read_bytes())
        tokens.append(summary["token"])
    assert files[0] == files[1] != files[2]
    assert tokens[0] == tokens[1] != tokens[2]
    assert tokens[0].startswith(jaxbl.run(STUDIES["shaft"]).summary["single_run"])


@pytest.mark.usefixtures("sources_alone")
def test_the_same_study_with_other_code_has_another_token(tmp_path, monkeypatch):
    """A law that a later version, or another package, has changed: states and descriptions of the old one do not fit."""
    before = export_unit(STUDIES["shaft"], tmp_path / "a")[1]
    monkeypatch.setattr(LinearShaft, "torque", lambda self, deflection: self.stiffness * deflection * deflection)
    changed = export_unit(STUDIES["shaft"], tmp_path / "b")[1]
    assert before["identity"] == changed["identity"] and before["token"] != changed["token"]


@pytest.mark.usefixtures("sources_alone")
def test_a_motor_fed_by_voltage_has_an_input_in_volts(tmp_path):
    path, _ = export_unit(study("actuator.back_emf"), tmp_path)
    units = {model_variable.name: model_variable.unit for model_variable in fmpy.read_model_description(path).modelVariables}
    assert (units["u"], units["torque"]) == ("V", "N.m")


@pytest.mark.usefixtures("sources_alone")
def test_two_effects_of_one_kind_have_names_of_their_own(tmp_path):
    waves = [{"kind": "motor.cogging", "amplitude": 0.1, "harmonic": n} for n in (6.0, 12.0)]
    path, summary = export_unit(study() | {"effects": waves}, tmp_path)
    names = [variable["name"] for variable in summary["variables"] if variable["name"].startswith("effects")]
    assert names[::3] == ["effects[0].amplitude", "effects[1].amplitude"]
    assert validate_fmu(path) == []


@COMPILED
@pytest.mark.parametrize(
    "name", ["model", "fmi_model", "fmi_instance", "fmi3", "set", "taken", "free", "u", "state", "variables", "z"]
)
def test_any_name_that_is_allowed_compiles(tmp_path, monkeypatch, name):
    # names meet in the code whatever the compiler makes of it
    monkeypatch.setattr("jaxbl.exports.fmu._FLAGS", ("-std=c99", "-O0", "-shared"))
    path, summary = export_unit(STUDIES["gap"], tmp_path, name=name)
    assert summary["binaries"]
    with Instance(path) as instance:
        assert np.isfinite(instance.begin().run([1.0] * 3)).all()


@pytest.mark.parametrize(
    ("unit", "name", "base"),
    [
        ("N m s²/rad²", "N.m.s2/rad2", {"kg": 1, "m": 2, "rad": -2}),
        ("kg m²", "kg.m2", {"kg": 1, "m": 2}),
        ("N m/A", "N.m/A", {"kg": 1, "m": 2, "s": -2, "A": -1}),
        ("ohm", "ohm", {"kg": 1, "m": 2, "s": -3, "A": -2}),
        ("1/rad", "1/rad", {"rad": -1}),
        ("rad/s^2", "rad/s2", {"rad": 1, "s": -2}),
        ("1/turn", "1/turn", None),
    ],
)
def test_units_have_exponents_of_base_units(unit, name, base):
    assert write_unit(unit) == name
    assert find_base_units(name) == base


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target": "fmu", "fmi": 4}, "--fmi 4: should be one of 2, 3"),
        ({"target": "fmu", "fmi": 0}, "--fmi 0: should be one of 2, 3"),
        ({"target": "c", "fmi": 3}, "--fmi: --target c has no such option; leave it out"),
        ({"target": "fmu", "linear": ["motor"]}, "--linear: --target fmu has no such option"),
    ],
)
def test_wrong_requests_get_one_line(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        jaxbl.export(study(), tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()


def test_an_operation_that_code_does_not_know_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(LinearShaft, "torque", lambda self, deflection: self.stiffness * jnp.arctan(deflection))
    with pytest.raises(InputError, match="--target fmu: the study has what it cannot say: atan of float64"):
        jaxbl.export(STUDIES["shaft"], tmp_path / "new", "fmu")
