"""Limit cycles of closed loops with a gap, beside an independent event-driven simulation.

    python benchmarks/limit_cycles.py [--drives 20] [--seed 0]
    python benchmarks/limit_cycles.py --throughput 10000 2000    # lanes and samples: closed loops over the same in open loop

Drives with a gap under a P-PI cascade, whose position comes from the load, start beside a reference at rest. The other side
of the comparison is written here with NumPy alone: between samples the drive is linear in contact and in the gap, and is
moved by matrix exponentials from event to event (a face is touched or left); the controller is written out once more.

A drive is left out at the border of existence: where the amplitude of either simulation changes by more than 3 % from the
third quarter of the run to the last one, or is below a hundredth of the half gap.
"""

import argparse
import dataclasses
import time
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

import jaxbl
from jaxbl.control import Cascade, StepsReference

PERIOD = 1e-3
STEPS = 12_000
START = 0.3  # rad, of the motor


@dataclasses.dataclass(frozen=True)
class Loop:
    """Numbers of a closed loop, in SI units; angles of the gap are on the motor side."""

    motor_inertia: float
    motor_viscous: float
    load_inertia: float
    load_viscous: float
    gear_ratio: float
    stiffness: float
    half_gap: float
    position_gain: float
    speed_gain: float
    integral_time: float
    torque_limit: float
    speed_filter: float = 2e-3

    def experiment(self) -> jaxbl.Experiment:
        """The experiment that jaxbl simulates."""
        numbers = dataclasses.asdict(self)
        drive = jaxbl.TwoInertia(**{field.name: numbers[field.name] for field in dataclasses.fields(jaxbl.TwoInertia)})
        names = ("position_gain", "speed_gain", "integral_time", "torque_limit", "speed_filter")
        return jaxbl.experiment(
            jaxbl.Experiment(
                drive=drive,
                transmission=jaxbl.DeadZone(self.stiffness, self.half_gap),
                initial=jaxbl.Initial(motor_position=START, load_position=START / self.gear_ratio),
                observer=jaxbl.Observers(jaxbl.ExtendedState(200.0), jaxbl.ExtendedState(200.0)),
                controller=Cascade(**{name: numbers[name] for name in names}, side="load", speed_from="differences"),
                reference=StepsReference(0.0, 1.0),
                run=jaxbl.Run(PERIOD, STEPS, 40),
            )
        )


def draw_loop(rng: np.random.Generator) -> Loop:
    """Draw a loop whose speed loop is damped and whose position gain is large enough for many gaps to make a limit cycle."""
    ratio, motor = rng.uniform(2.0, 20.0), 10.0 ** rng.uniform(-3.0, -1.0)
    load = motor * ratio**2 * 10.0 ** rng.uniform(-0.5, 0.7)
    total = motor + load / ratio**2
    # the speed loop's bandwidth, rad/s, is a third of the resonance at most
    bandwidth = rng.uniform(20.0, 60.0)
    stiffness = total * (bandwidth * rng.uniform(3.0, 8.0)) ** 2
    return Loop(
        motor_inertia=motor,
        motor_viscous=motor * rng.uniform(0.5, 3.0),
        load_inertia=load,
        load_viscous=load * rng.uniform(0.5, 3.0),
        gear_ratio=ratio,
        stiffness=stiffness,
        half_gap=10.0 ** rng.uniform(-2.5, -1.0),
        position_gain=bandwidth * rng.uniform(0.15, 0.4),
        speed_gain=total * bandwidth,
        integral_time=rng.uniform(3.0, 8.0) / bandwidth,
        torque_limit=total * 10.0 ** rng.uniform(3.0, 4.0),
    )


class Events:
    """The drive between samples: linear in each of three modes (contact behind, gap, contact ahead: -1, 0, 1)."""

    def __init__(self, loop: Loop):
        twist = np.array([1.0, -loop.gear_ratio, 0.0, 0.0, 0.0, 0.0])
        self.twist, self.half_gap = twist, loop.half_gap
        self.generators, self.whole_steps = {}, {}
        self.impacts = list[float]()  # relative speed, rad/s, at each closing of the gap
        for mode in (-1, 0, 1):
            # state: angles, speeds, torque, 1
            torque = 0.0 if mode == 0 else loop.stiffness * (twist - mode * loop.half_gap * np.eye(6)[5])
            a = np.zeros((6, 6))
            a[0, 2] = a[1, 3] = 1.0
            a[2] = (np.eye(6)[4] - loop.motor_viscous * np.eye(6)[2] - torque) / loop.motor_inertia
            a[3] = (loop.gear_ratio * torque - loop.load_viscous * np.eye(6)[3]) / loop.load_inertia
            self.generators[mode], self.whole_steps[mode] = a, expm(PERIOD * a)

    def mode(self, state: np.ndarray) -> int:
        """The mode in which a state moves on."""
        z, a = self.twist @ state, self.twist @ self.generators[0] @ state
        if abs(abs(z) - self.half_gap) < 1e-13:
            return int(np.sign(z)) if np.sign(a) == np.sign(z) else 0
        return int(np.sign(z)) if abs(z) > self.half_gap else 0

    def advance(self, state: np.ndarray) -> np.ndarray:
        """Move the state by one sampling period, from event to event."""
        left = PERIOD
        while left > 0.0:
            mode = self.mode(state)
            step = self.whole_steps[mode] if left == PERIOD else expm(left * self.generators[mode])
            after = step @ state
            z = self.twist @ after
            face = float(np.sign(z)) if mode == 0 else float(mode)
            leaves = abs(z) > self.half_gap if mode == 0 else mode * z < self.half_gap
            if not leaves:
                return after

            def distance(time: float, mode: int = mode, face: float = face, state: np.ndarray = state) -> float:
                return float(self.twist @ expm(time * self.generators[mode]) @ state) - face * self.half_gap

            # beside the event that the state may stand on
            first = 1e-6 * left
            if distance(first) * distance(left) >= 0.0:  # it grazes the face
                return after
            event = brentq(distance, first, left, xtol=1e-15)
            state, left = expm(event * self.generators[mode]) @ state, left - event
            if mode == 0:
                self.impacts.append(abs(float(self.twist @ self.generators[0] @ state)))
        return state


class Cycle(NamedTuple):
    """Amplitude (rad) and frequency (Hz) of the load, the amplitude in the quarter before, and closings of the gap: their
    rate in the last quarter (Hz), and the largest speed (rad/s)."""

    amplitude: float
    frequency: float
    before: float
    impact_rate: float
    impact_speed: float


def simulate_events(loop: Loop) -> Cycle:
    """Simulate a closed loop from event to event."""
    drive = Events(loop)
    state = np.array([START, START / loop.gear_ratio, 0.0, 0.0, 0.0, 1.0])
    integral, speed, last, load = 0.0, 0.0, START, np.empty(STEPS)
    before = 0
    for k in range(STEPS):
        if k == 3 * STEPS // 4:
            before = len(drive.impacts)
        load[k], motor = state[1], state[0]
        speed += PERIOD / (PERIOD + loop.speed_filter) * ((motor - last) / PERIOD - speed)
        wanted = loop.speed_gain * (-loop.position_gain * loop.gear_ratio * load[k] - speed)
        torque = np.clip(wanted + integral, -loop.torque_limit, loop.torque_limit)
        integral += PERIOD / loop.integral_time * (torque - integral)
        last = motor
        # what is computed now acts from the next sample on
        state = drive.advance(state)
        state[4] = torque
    third, fourth = load[STEPS // 2 : 3 * STEPS // 4], load[3 * STEPS // 4 :]
    rest = fourth - 0.5 * (third.max() + third.min())
    ups = np.flatnonzero((rest[:-1] <= 0.0) & (rest[1:] > 0.0))
    times = PERIOD * (ups - rest[ups] / (rest[ups + 1] - rest[ups]))
    frequency = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
    rate = (len(drive.impacts) - before) / (0.25 * STEPS * PERIOD)
    return Cycle(0.5 * np.ptp(fourth), frequency, 0.5 * np.ptp(third), rate, max(drive.impacts, default=0.0))


def simulate_chain(loop: Loop) -> Cycle:
    """Simulate a closed loop by jaxbl: its metrics, and the trace for the quarter before."""
    experiment = loop.experiment()
    names = ("limit_cycle_amplitude", "limit_cycle_frequency", "impact_rate")
    metrics = jaxbl.metrics(experiment, names=(*names, "impact_speed"))
    load = np.asarray(jaxbl.simulate(experiment).load.true.position)
    amplitude, frequency, rate = (float(metrics[f"load.{name}"]) for name in names)
    before, speed = 0.5 * np.ptp(load[STEPS // 2 : 3 * STEPS // 4]), float(metrics["motor.impact_speed"])
    return Cycle(amplitude, frequency, before, rate, speed)


def is_at_border(loop: Loop, *cycles: Cycle) -> bool:
    """True for a loop that the comparison leaves out."""
    least = 0.01 * loop.half_gap / loop.gear_ratio
    return any(c.amplitude < least or abs(c.before / c.amplitude - 1.0) > 0.03 for c in cycles)


CHAIN_METRICS = ("position_rmse", "velocity_rmse", "torque_rmse", "f_plus")
LOOP_METRICS = (*CHAIN_METRICS, "following_rmse", "limit_cycle_amplitude", "limit_cycle_frequency")
"""What is measured in both loops, and in the closed one as well."""


def measure_throughput(lanes: int, steps: int, repeats: int = 5) -> None:
    """Print how fast lanes of one drive with other gaps run in a closed loop and in an open one: the best of some runs."""
    import jax

    from jaxbl.sweeps.programs import Layout, compile_program

    loop = draw_loop(np.random.default_rng(2))
    closed = jaxbl.with_values(loop.experiment(), {"encoders.noise": 1e-5})
    closed = dataclasses.replace(closed, run=dataclasses.replace(closed.run, steps=steps, substeps=10))
    sine = jaxbl.Sine(0.02 * loop.torque_limit, 1.0)
    opened = jaxbl.experiment(dataclasses.replace(closed, controller=None, reference=None, excitation=sine))
    gaps = {"transmission.half_gap": np.geomspace(0.2, 5.0, lanes) * loop.half_gap}
    cases = {"open": (opened, CHAIN_METRICS), "closed": (closed, CHAIN_METRICS), "closed, cycles": (closed, LOOP_METRICS)}
    programs = {}
    for name, (experiment, metrics) in cases.items():
        programs[name] = compile_program(
            experiment, Layout(1, lanes), jax.local_devices(), "fused", gaps, metric_names=metrics, require_backend=True
        )
    best = dict.fromkeys(cases, np.inf)
    # in turns, so that other load meets all alike
    for _ in range(repeats):
        for name, program in programs.items():
            start = time.perf_counter()
            program.run(gaps, np.zeros(1, np.uint32))
            best[name] = min(best[name], time.perf_counter() - start)
    for name, seconds in best.items():
        print(f"{name:15} {lanes * steps / seconds:.3e} lane-steps/s, {best['open'] / seconds:.2f} of the open loop")


def main() -> None:
    import jax

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--throughput", type=int, nargs=2, metavar=("LANES", "SAMPLES"))
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.throughput:
        measure_throughput(*arguments.throughput)
        return
    rng, rows, drawn = np.random.default_rng(arguments.seed), [], 0
    while len(rows) < arguments.drives:
        loop, drawn = draw_loop(rng), drawn + 1
        by_events = simulate_events(loop)
        if is_at_border(loop, by_events) or is_at_border(loop, by_chain := simulate_chain(loop)):
            continue
        errors = by_chain.amplitude / by_events.amplitude - 1.0, by_chain.frequency / by_events.frequency - 1.0
        rows.append(errors)
        print(
            f"{len(rows):3} {by_events.amplitude:.3e} rad {by_events.frequency:6.2f} Hz  {errors[0]:+.2e} {errors[1]:+.2e}"
        )
    for name, column in zip(("amplitude", "frequency"), np.abs(rows).T, strict=True):
        print(f"{name}: median {100 * np.median(column):.3f} %, worst {100 * column.max():.3f} % of {len(rows)}")
    print(f"left out at the border of existence, or without a limit cycle: {drawn - len(rows)} of {drawn}")


if __name__ == "__main__":
    main()
