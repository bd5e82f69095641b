"""The limit cycle of sweeps/closed_loop.toml beside its describing function.

    python benchmarks/describing_function.py [--figure docs/figures/closed_loop.png]

First harmonics alone: the dead zone is a gain N that grows with the amplitude of the twist, the load's dry friction F is the
viscous one 4 F / (pi w a) of an amplitude a. What remains is linear, the controller's samples, hold and delay exact.
"""

import argparse
import math
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.optimize import brentq

import jaxbl

ROOT = Path(__file__).resolve().parents[1]
STUDY = ROOT / "sweeps" / "closed_loop.toml"
FREQUENCIES = np.geomspace(0.5, 300.0, 4000)
"""Where a cycle is looked for, rad/s."""


class Cycle(NamedTuple):
    """Amplitude of the load (rad) and frequency (Hz); zeros without a cycle."""

    amplitude: float
    frequency: float


def dead_zone_gain(ratio: float) -> float:
    """Describing function of a dead zone of slope 1 at an amplitude over its half width."""
    if ratio <= 1.0:
        return 0.0
    return 1.0 - 2.0 / math.pi * (math.asin(1.0 / ratio) + math.sqrt(1.0 - ratio**-2) / ratio)


def find_gain(config: jaxbl.Config, rate: np.ndarray, friction: float) -> tuple[np.ndarray, np.ndarray]:
    """Solve the loop for the gain N of the dead zone that each rate (rad/s) asks for.

    Returns N, which is real where there is a cycle, and the load's amplitude over that of the gear's torque.

    `friction` is the load's viscous one, N m s/rad.
    """
    drive, loop, period = config.drive, config.controller, config.run.sample_period
    s, z = 1j * rate, np.exp(1j * rate * period)
    share = period / (period + loop.speed_filter)
    speed = share * (1.0 - 1.0 / z) / period / (1.0 - (1.0 - share) / z)
    integral = 1.0 + period / loop.integral_time / (z - 1.0)
    # acts a sample later, and is held
    act = loop.speed_gain * integral / z * (1.0 - 1.0 / z) / (s * period)
    ratio, stiffness = drive.gear_ratio, config.transmission.stiffness
    load = ratio / (drive.load_inertia * s**2 + friction * s)
    motor = drive.motor_inertia * s**2 + drive.motor_viscous * s + act * speed
    # twist 1: motor (1 + ratio load K N) = -act position_gain ratio load K N - K N
    return -motor / (stiffness * (motor * ratio * load + act * loop.position_gain * ratio * load + 1.0)), load


def predict(config: jaxbl.Config) -> Cycle:
    """Predict the limit cycle of a study with a cascade on the load's position, whose speed comes from differences."""
    torque = next((effect.torque for effect in config.effects if effect.kind == "load.coulomb_friction"), 0.0)
    cycle = Cycle(math.inf, 1.0)
    for _ in range(200):
        before, friction = cycle, config.drive.load_viscous
        friction += 4.0 * torque / (math.pi * 2.0 * math.pi * before.frequency * before.amplitude)

        def imaginary(rate: float, friction: float = friction) -> float:
            return float(find_gain(config, np.array([rate]), friction)[0][0].imag)

        gain, _ = find_gain(config, FREQUENCIES, friction)
        candidates = []
        for i in np.flatnonzero(gain.imag[:-1] * gain.imag[1:] < 0.0):
            rate = brentq(imaginary, FREQUENCIES[i], FREQUENCIES[i + 1])
            real, load = (x[0] for x in find_gain(config, np.array([rate]), friction))
            if 0.0 < real.real < 1.0:
                twist = brentq(lambda ratio, goal=real.real: dead_zone_gain(ratio) - goal, 1.0, 1e9)
                twist *= config.transmission.half_gap
                amplitude = abs(load) * config.transmission.stiffness * real.real * twist
                candidates.append(Cycle(amplitude, rate / (2.0 * math.pi)))
        if not candidates:
            return Cycle(0.0, 0.0)
        cycle = max(candidates)
        if math.isclose(cycle.amplitude, before.amplitude, rel_tol=1e-9):
            break
    return cycle


def draw(frame: pd.DataFrame, amplitude: np.ndarray, frequency: np.ndarray, file: Path) -> None:
    """Draw both amplitudes as maps, and the frequencies over the gain at three gaps."""
    gaps, gains = (np.unique(frame[path]) for path in ("transmission.half_gap", "controller.position_gain"))
    shape = len(gaps), len(gains)
    simulated = frame["load.limit_cycle_amplitude"].to_numpy().reshape(shape)
    figure, panels = plt.subplots(1, 3, figsize=(12.0, 3.8), layout="constrained")
    scale = {"norm": "log", "vmin": 1e-4, "vmax": 0.1, "cmap": "viridis_r"}
    for panel, values, title in zip(panels, (simulated, amplitude.reshape(shape)), ("simulated", "predicted"), strict=False):
        panel.set_facecolor("0.85")
        image = panel.pcolormesh(gains, gaps, np.where(values > 1e-4, values, np.nan), **scale)
        panel.set(
            yscale="log", title=f"{title}; grey: no cycle", xlabel="position gain (1/s)", ylabel="half gap, motor side (rad)"
        )
    figure.colorbar(image, ax=panels[:2], label="amplitude of the load (rad)")
    hertz = frame["load.limit_cycle_frequency"].to_numpy().reshape(shape), frequency.reshape(shape)
    for i, colour in zip((24, 35, 47), ("#d55e00", "#0072b2", "black"), strict=True):
        measured, expected = (np.where(values[i] > 0.0, values[i], np.nan) for values in hertz)
        panels[2].plot(gains, measured, ".", color=colour, label=f"half gap {gaps[i]:.2g} rad")
        panels[2].plot(gains, expected, color=colour)
    panels[2].set(title="frequency", xlabel="position gain (1/s)", ylabel="Hz (points simulated, lines predicted)")
    panels[2].legend(frameon=False)
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    result = jaxbl.sweep(STUDY)
    columns = "load.limit_cycle_amplitude", "load.limit_cycle_frequency"
    frame = result.frame
    predicted = [
        predict(jaxbl.config.with_values(result.config, dict(zip(result.config.axis_paths, row, strict=True))))
        for row in frame[result.config.axis_paths].to_numpy()
    ]
    amplitude, frequency = np.array(predicted).T
    exists = frame[columns[1]].to_numpy() > 0.0
    both = exists & (amplitude > 0.0)
    print(f"{len(frame)} loops; a cycle in {exists.sum()}, predicted in {(amplitude > 0).sum()}, in both {both.sum()}")
    for name, column, values in zip(("amplitude", "frequency"), columns, (amplitude, frequency), strict=True):
        errors = np.abs(values[both] / frame[column].to_numpy()[both] - 1.0)
        print(f"{name}: off by {np.median(errors):.1%} in the median, {np.quantile(errors, 0.95):.1%} in 95 %")
    if arguments.figure:
        draw(frame, amplitude, frequency, arguments.figure)


if __name__ == "__main__":
    main()
