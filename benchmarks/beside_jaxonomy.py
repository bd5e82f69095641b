"""One closed loop with a gap, in jaxbl and in jaxonomy (block diagrams in JAX), at the same accuracy.

    python benchmarks/beside_jaxonomy.py [--lanes 1000] [--steps 2000]

A motor under a sampled P-P cascade, with its speed by differences and the torque one sample late, turns a load through a
gear with a gap. Each side takes the coarsest settings whose load position stays within `ACCURACY` of SciPy's at tight
tolerance: plant steps a sample of jaxbl; the longest step (s) of jaxonomy, whose tolerances do not see an error of first
order where the torque changes. Then: lines of user code (those of the functions `*_model`, `*_run` and `*_batch` below),
time from the first line to the first result, and samples of drives with other gaps a second by each one's own batch call.
jaxonomy is left out where it is not installed. jaxonomy 3.4 asks for jax < 0.10 and jaxbl for jax >= 0.10.2, so that pip
refuses the pair, and `jaxbl bench` has no row for it; it runs with the newer one all the same:

    printf 'jax>=0.10.2\njaxlib>=0.10.2\n' > newer.txt && uv pip install --override newer.txt "jaxonomy>=3.4" -e .
"""

import argparse
import importlib.util
import inspect
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

jax.config.update("jax_enable_x64", True)

ACCURACY = 2e-5  # rad, of the load, at all samples
PERIOD, STIFFNESS, HALF_GAP, RATIO = 1e-3, 60.0, 0.08, 5.0
INERTIA, VISCOUS = (0.05, 1.0), (0.15, 2.0)
POSITION_GAIN, SPEED_GAIN, AMPLITUDE, RATE = 8.0, 2.0, 1.0, 4.0


def jaxbl_model(steps: int, substeps: int) -> Any:
    import jaxbl

    drive = jaxbl.TwoInertia(INERTIA[0], VISCOUS[0], INERTIA[1], VISCOUS[1], RATIO)
    gear = jaxbl.DeadZone(STIFFNESS, HALF_GAP)
    observers = jaxbl.Observers(jaxbl.ExtendedState(300.0), jaxbl.ExtendedState(300.0))
    cascade = jaxbl.Cascade(POSITION_GAIN, SPEED_GAIN, speed_from="differences", velocity_feedforward=0.0)
    return jaxbl.experiment(
        jaxbl.Experiment(
            drive=drive, transmission=gear, observer=observers, controller=cascade,
            reference=lambda time: AMPLITUDE * jnp.sin(RATE * time), run=jaxbl.Run(PERIOD, steps, substeps),
        )
    )  # fmt: skip


def jaxbl_run(model: Any, steps: int) -> np.ndarray:
    import jaxbl

    return np.asarray(jaxbl.simulate(model).load.true.position)


def jaxbl_batch(model: Any, steps: int, gaps: np.ndarray) -> np.ndarray:
    import jaxbl

    return jaxbl.sweep_arrays(model, {"transmission.half_gap": gaps}, names=("following_rmse",))["motor.following_rmse"][
        :, 0
    ]


def jaxonomy_model(steps: int, longest_step: float) -> Any:
    import jaxonomy
    from jaxonomy.library import Adder, DerivativeDiscrete, Gain, Sine, UnitDelay, ZeroOrderHold

    class Drive(jaxonomy.LeafSystem):
        def __init__(self, **options):
            super().__init__(**options)
            self.declare_input_port(name="torque")
            self.declare_dynamic_parameter("half_gap", HALF_GAP)
            self.declare_continuous_state(default_value=jnp.zeros(4), ode=self.derivative)
            self.declare_output_port(lambda time, state, *inputs, **numbers: state.continuous_state[0], name="motor",
                                     requires_inputs=False)  # fmt: skip
            self.declare_output_port(lambda time, state, *inputs, **numbers: state.continuous_state[1], name="load",
                                     requires_inputs=False)  # fmt: skip

        def derivative(self, time, state, torque, half_gap):
            motor, load, motor_speed, load_speed = state.continuous_state
            twist = motor - RATIO * load
            transmitted = STIFFNESS * (twist - jnp.clip(twist, -half_gap, half_gap))
            return jnp.array([
                motor_speed, load_speed, (torque - VISCOUS[0] * motor_speed - transmitted) / INERTIA[0],
                (RATIO * transmitted - VISCOUS[1] * load_speed) / INERTIA[1],
            ])  # fmt: skip

    builder = jaxonomy.DiagramBuilder()
    drive = builder.add(Drive(name="drive"))
    reference, sample = builder.add(Sine(AMPLITUDE, RATE, name="reference"), ZeroOrderHold(PERIOD, name="sample"))
    error, goal = builder.add(Adder(2, operators="+-", name="error"), Gain(POSITION_GAIN, name="position_gain"))
    speed, speed_error = builder.add(DerivativeDiscrete(PERIOD, name="speed"), Adder(2, operators="+-", name="speed_error"))
    torque, late = builder.add(Gain(SPEED_GAIN, name="speed_gain"), UnitDelay(PERIOD, initial_state=0.0, name="late"))
    sampled_reference = builder.add(ZeroOrderHold(PERIOD, name="sampled_reference"))
    for source, target in [
        (drive.output_ports[0], sample.input_ports[0]), (reference.output_ports[0], sampled_reference.input_ports[0]),
        (sampled_reference.output_ports[0], error.input_ports[0]), (sample.output_ports[0], error.input_ports[1]),
        (error.output_ports[0], goal.input_ports[0]), (sample.output_ports[0], speed.input_ports[0]),
        (goal.output_ports[0], speed_error.input_ports[0]), (speed.output_ports[0], speed_error.input_ports[1]),
        (speed_error.output_ports[0], torque.input_ports[0]), (torque.output_ports[0], late.input_ports[0]),
        (late.output_ports[0], drive.input_ports[0]),
    ]:  # fmt: skip
        builder.connect(source, target)
    options = jaxonomy.SimulatorOptions(
        math_backend="jax", max_minor_step_size=longest_step, max_major_steps=2 * steps + 10,
        buffer_length=steps * round(4 + 2 * PERIOD / longest_step),
    )  # fmt: skip
    return builder.build(), drive, options


def jaxonomy_run(model: Any, steps: int) -> np.ndarray:
    import jaxonomy

    diagram, drive, options = model
    found = jaxonomy.simulate(
        diagram, diagram.create_context(), (0.0, steps * PERIOD), options=options,
        recorded_signals={"load": drive.output_ports[1]},
    )  # fmt: skip
    return np.interp(np.arange(steps) * PERIOD, found.time, found.outputs["load"])


def jaxonomy_batch(model: Any, steps: int, gaps: np.ndarray, use_vmap: bool = True) -> np.ndarray:
    import jaxonomy

    diagram, drive, options = model
    found = jaxonomy.simulate_batch(
        diagram, (0.0, steps * PERIOD), {"drive.half_gap": gaps}, options,
        recorded_signals={"motor": drive.output_ports[0]}, use_vmap=use_vmap,
    )  # fmt: skip
    times = np.asarray(found.time) * np.ones((len(gaps), 1))
    motors = zip(times, np.asarray(found.outputs["motor"]), strict=True)
    motors = np.array([np.interp(np.arange(steps) * PERIOD, at, motor) for at, motor in motors])
    window = np.arange(steps - steps // 4, steps)
    return np.sqrt(np.mean((AMPLITUDE * np.sin(RATE * PERIOD * window) - motors[:, window]) ** 2, axis=1))


def solve_by_scipy(steps: int, half_gap: float = HALF_GAP) -> np.ndarray:
    """Positions of motor and load at the samples, rad, shape (steps, 2)."""

    def derivative(time: float, state: np.ndarray, torque: float) -> list[float]:
        motor, load, motor_speed, load_speed = state
        twist = motor - RATIO * load
        transmitted = STIFFNESS * (twist - np.clip(twist, -half_gap, half_gap))
        return [motor_speed, load_speed, (torque - VISCOUS[0] * motor_speed - transmitted) / INERTIA[0],
                (RATIO * transmitted - VISCOUS[1] * load_speed) / INERTIA[1]]  # fmt: skip

    state, torque, last, positions = np.zeros(4), 0.0, 0.0, []
    for k in range(steps):
        positions.append(state[:2])
        goal = POSITION_GAIN * (AMPLITUDE * np.sin(RATE * k * PERIOD) - state[0])
        following, last = SPEED_GAIN * (goal - (state[0] - last) / PERIOD), state[0]
        state = solve_ivp(derivative, (0.0, PERIOD), state, "DOP853", args=(torque,), rtol=1e-11, atol=1e-13).y[:, -1]
        torque = following
    return np.array(positions)


def count_lines(*functions: Callable[..., Any]) -> int:
    """Lines of code of functions, without their heads and blank ones."""
    lines = [line.strip() for function in functions for line in inspect.getsource(function).splitlines()[1:]]
    return sum(bool(line) for line in lines)


def measure(name: str, settings: list[Any], lanes: int, steps: int) -> None:
    """Print a row of the table: the first settings that are accurate enough, and what they cost."""
    make, run, batch = (globals()[f"{name}_{part}"] for part in ("model", "run", "batch"))
    start = time.perf_counter()
    run(make(steps, settings[0]), steps)
    first = time.perf_counter() - start
    reference = solve_by_scipy(steps)
    for setting in settings:
        model = make(steps, setting)
        if (error := np.abs(run(model, steps) - reference[:, 1]).max()) <= ACCURACY:
            break
    gaps = np.linspace(0.02, 0.1, lanes)
    for options in [{}] if name == "jaxbl" else [{"use_vmap": True}, {"use_vmap": False}]:
        start = time.perf_counter()
        errors = batch(model, steps, gaps, **options)
        cold = time.perf_counter() - start
        start = time.perf_counter()
        batch(model, steps, gaps[::-1].copy(), **options)
        warm = time.perf_counter() - start
        motor = solve_by_scipy(steps, gaps[0])[-(steps // 4) :, 0]
        target = AMPLITUDE * np.sin(RATE * PERIOD * np.arange(steps - steps // 4, steps))
        expected = np.sqrt(np.mean((target - motor) ** 2))
        samples = lanes * steps / warm
        print(
            f"{name} {options or ''}: setting {setting}, load within {error:.1e} rad, "
            f"{count_lines(make, run, batch)} lines, first result {first:.1f} s, "
            f"{lanes} drives in {warm:.2f} s ({samples:.3g} samples/s; with compilation {cold:.1f} s), "
            f"following error {errors[0]:.6f} rad (SciPy {expected:.6f})",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lanes", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=2000)
    arguments = parser.parse_args()
    measure("jaxbl", [1, 2, 4, 8, 16, 32], arguments.lanes, arguments.steps)
    if importlib.util.find_spec("jaxonomy") is None:
        print("jaxonomy is not installed: left out")
        return
    measure("jaxonomy", [1e-3, 5e-4, 2e-4, 1e-4, 5e-5], arguments.lanes, arguments.steps)


if __name__ == "__main__":
    main()
