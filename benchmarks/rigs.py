"""Transmissions on simulated test rigs: how near are stiffness, gap, friction and hysteresis, and do the intervals hold?

Each rig has a stiffness, and with even odds each of a gap, damping, dry friction, hysteresis (Bouc-Wen, by small steps of
its differential equation) and friction under load, of 3 to 20 % of the largest torque; a displacement of triangles, sines
or a multisine; noise on both channels, that of the torque correlated over 20 samples.

    python benchmarks/rigs.py --seed 1 --count 20
"""

import argparse
import time

import numpy as np

from jaxbl.records.element import RigLog, fit_element

PERIOD = 5e-3


def simulate(random: np.random.Generator) -> tuple[dict[str, float], np.ndarray, np.ndarray, float]:
    """True numbers, measured displacement and torque (40 s at 200 Hz), noise of the displacement."""
    fine, count = 50, 8000
    t = PERIOD / fine * np.arange(fine * count)
    scale, stiffness = 10.0 ** random.uniform(-3.0, 0.0), 10.0 ** random.uniform(1.0, 5.0)
    kind, rate = random.choice(["triangle", "sine", "multisine"]), random.uniform(0.1, 0.5)
    if kind == "triangle":
        x = scale * (2.0 / np.pi) * np.arcsin(np.sin(2.0 * np.pi * rate * t)) * (0.4 + 0.6 * t / t[-1])
    elif kind == "sine":
        x = scale * np.sin(2.0 * np.pi * rate * t) * (0.4 + 0.6 * t / t[-1])
    else:
        phases = random.uniform(0.0, 2.0 * np.pi, 4)
        waves = [np.sin(2.0 * np.pi * rate * k * t + p) / k for k, p in zip((1, 2, 3, 5), phases, strict=True)]
        x = scale * np.sum(waves, axis=0) / 1.5
    truth = {"stiffness": stiffness, "offset": 0.0}
    deflection = x
    if random.random() < 0.5:
        truth |= {"half_gap": random.uniform(0.05, 0.4) * scale, "centre": random.uniform(-0.2, 0.2) * scale}
        deflection = x - truth["centre"]
        deflection = deflection - np.clip(deflection, -truth["half_gap"], truth["half_gap"])
    top = stiffness * np.abs(deflection).max()
    truth["offset"] = random.uniform(-0.1, 0.1) * top
    u = stiffness * deflection + truth["offset"]
    speed = np.gradient(x, t)
    direction = np.sign(speed)
    size = {name: random.uniform(0.03, 0.2) * top for name in ("damping", "dry_friction", "hysteresis")}
    if random.random() < 0.5:
        truth["damping"] = size["damping"] / np.abs(speed).max()
        u = u + truth["damping"] * np.gradient(deflection, t)
    if random.random() < 0.5:
        truth["dry_friction"] = size["dry_friction"]
        u = u + size["dry_friction"] * direction
    if random.random() < 0.5:
        truth |= {"hysteresis": size["hysteresis"], "length": random.uniform(0.02, 0.3) * scale}
        h, steps = np.zeros(len(t)), np.diff(deflection) / truth["length"]
        for i, step in enumerate(steps):
            grows = h[i] * step > 0.0
            h[i + 1] = h[i] + step * (1.0 - h[i] ** 2 if grows else 1.0)
        u = u + size["hysteresis"] * h
    if random.random() < 0.5:
        truth["friction_coefficient"] = random.uniform(0.03, 0.15)
        u = u + truth["friction_coefficient"] * stiffness * np.abs(deflection) * direction
    noise = 1e-4 * scale
    x, u = x[::fine] + noise * random.standard_normal(count), u[::fine]
    disturbance = np.convolve(random.standard_normal(count + 19), np.ones(20) / np.sqrt(20.0), "valid")
    u = u + random.uniform(0.002, 0.01) * top * (0.7 * disturbance + 0.7 * random.standard_normal(count))
    return truth, x, u, noise


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--each", action="store_true", help="print each rig")
    asked = parser.parse_args()
    errors: dict[str, list[float]] = {}
    covered: dict[str, list[bool]] = {}
    missed, false, seconds = [], [], []
    for i in range(asked.count):
        truth, x, u, noise = simulate(np.random.default_rng([asked.seed, i]))
        start = time.perf_counter()
        fit = fit_element(RigLog(x, u, [slice(0, len(x))], PERIOD, noise))
        seconds.append(time.perf_counter() - start)
        assert fit is not None
        missed += [f"{i} {name}" for name in truth if name not in fit.numbers]
        # without a gap the centre stands for the offset
        false += [f"{i} {name}" for name in fit.numbers if name not in truth and name != "centre"]
        names = [name for name in truth if name in fit.numbers]
        if "centre" not in truth and "centre" in fit.numbers:
            names.remove("offset")
        for name in names:
            estimate = fit.numbers[name]
            if name not in ("offset", "centre"):
                errors.setdefault(name, []).append(100.0 * abs(estimate.value / truth[name] - 1.0))
            covered.setdefault(name, []).append(estimate.interval[0] <= truth[name] <= estimate.interval[1])
        if asked.each:
            texts = [f"{n} {truth[n]:.4g}: {fit.numbers[n].value:.4g} ± {fit.numbers[n].error:.2g}" for n in names]
            print(f"{i} ({seconds[-1]:.1f} s, left {100 * fit.share:.2g} %): " + "; ".join(texts), flush=True)
    print("| number | rigs | error, median % | largest % | truth within 95 % |\n|---|---:|---:|---:|---:|")
    for name, inside in covered.items():
        off = errors.get(name)
        text = "| | " if off is None else f"| {np.median(off):.2g} | {max(off):.2g} "
        print(f"| {name} | {len(inside)} {text}| {sum(inside)} of {len(inside)} |")
    total = [estimate for inside in covered.values() for estimate in inside]
    print(f"\n{sum(total)} of {len(total)} intervals hold ({100 * np.mean(total):.0f} %).")
    print(f"Not found: {', '.join(missed) or 'none'}. Found though not there: {', '.join(false) or 'none'}.")
    print(f"{np.median(seconds):.1f} s a rig, at most {max(seconds):.1f} s.")


if __name__ == "__main__":
    main()
