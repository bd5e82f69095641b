"""Which time stepping for the drive: cost per accuracy of five schemes on the paper's plant.

All schemes take their forces from the package's own `Plant`; Moreau's midpoint is the package's own `Plant.advance`. The
input is the paper's sine (0.1 N m, 0.16 Hz) held over samples of 1 ms, as a drive does it, so a step never exceeds 1 ms.
Three plants: the smooth law (3); the same with Coulomb friction on the motor, which sticks around the reversals; a hard
dead zone of equal half gap. Errors are the largest over all samples of |theta_e| and N_0 |theta_s| against SciPy's DOP853
(rtol 1e-12), restarted at every sample, with located stops and break-aways under friction.

Cost is wall time per lane-step of a batch, compiled beforehand, schemes in turn over several rounds, the least of each.
Relative cost is per simulated second: cost per step, measured at 10 steps a sample, times steps; Moreau's midpoint at that
default is 1. Compare within one run. `tanh(v/0.001)`: dry friction made smooth over 0.001 rad/s; creep: of a block at half
its break-away torque.

    python benchmarks/integrators.py
    python benchmarks/integrators.py --out results/integrators    # also integrators.png
"""

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

jax.config.update("jax_enable_x64", True)

from jaxbl.drive import DeadZone, Initial, Plant, PlantState, Rigid, SigmoidBacklash, TwoInertia, as_arrays  # noqa: E402
from jaxbl.drive.effects import CoulombFriction, Motion  # noqa: E402

PERIOD = 1e-3
DEFAULT_SUBSTEPS = 10
FRICTION = 0.03
HALF_GAP = 0.08


# Schemes: (plant, state, torque, time, step, smoothing) -> state. `smoothing` is the velocity over which the others turn
# dry friction into a tanh; Moreau's midpoint takes it as it is.


def accelerations(plant, position, velocity, torque, smoothing):
    """Acceleration of each side in rad/s^2, dry friction regularised."""
    states = tuple(effect.init() for effect in plant.effects)
    transmitted, ratio = (0.0, 0.0) if plant.transmission is None else plant.transmitted_torque(position, velocity, states)
    result = {}
    for side in plant.drive.sides:
        motion = Motion(0.0, position[side], velocity[side])
        total = torque - transmitted if side == "motor" else ratio * transmitted
        total = total - plant.drive.viscous(side) * velocity[side]
        for effect, state in zip(plant.effects, states, strict=True):
            if effect.place == side:
                total = total - effect.dry_friction(state, motion) * jnp.tanh(velocity[side] / smoothing)
        result[side] = total / plant.inertia(side)
    return result


def add(state, rates, step):
    """state + step * rates, over both sides."""
    return jax.tree.map(lambda x, dx: x + step * dx, state, rates)


def euler(plant, state, torque, time, step, smoothing):
    kick = accelerations(plant, state.position, state.velocity, torque, smoothing)
    return PlantState(add(state.position, state.velocity, step), add(state.velocity, kick, step), state.effects)


def semi_implicit_euler(plant, state, torque, time, step, smoothing):
    velocity = add(state.velocity, accelerations(plant, state.position, state.velocity, torque, smoothing), step)
    return PlantState(add(state.position, velocity, step), velocity, state.effects)


def moreau_midpoint(plant, state, torque, time, step, smoothing):
    return plant.advance(state, torque, time, step)


def rates(plant, y, torque, smoothing):
    return y[1], accelerations(plant, y[0], y[1], torque, smoothing)


def heun(plant, state, torque, time, step, smoothing):
    y = (state.position, state.velocity)
    k1 = rates(plant, y, torque, smoothing)
    k2 = rates(plant, add(y, k1, step), torque, smoothing)
    return PlantState(*add(add(y, k1, 0.5 * step), k2, 0.5 * step), state.effects)


def rk4(plant, state, torque, time, step, smoothing):
    y = (state.position, state.velocity)
    k1 = rates(plant, y, torque, smoothing)
    k2 = rates(plant, add(y, k1, 0.5 * step), torque, smoothing)
    k3 = rates(plant, add(y, k2, 0.5 * step), torque, smoothing)
    k4 = rates(plant, add(y, k3, step), torque, smoothing)
    for k, weight in ((k1, 1.0), (k2, 2.0), (k3, 2.0), (k4, 1.0)):
        y = add(y, k, step * weight / 6.0)
    return PlantState(*y, state.effects)


class Scheme(NamedTuple):
    """A time step, its evaluations of the transmission law, and the velocity (rad/s) that smooths dry friction."""

    name: str
    step: object
    evaluations: int
    smoothing: float = 1.0


SMOOTH_SCHEMES = (
    Scheme("Moreau midpoint", moreau_midpoint, 1),
    Scheme("explicit Euler", euler, 1),
    Scheme("semi-implicit Euler", semi_implicit_euler, 1),
    Scheme("Heun", heun, 2),
    Scheme("RK4", rk4, 4),
)
FRICTION_SCHEMES = (
    Scheme("Moreau midpoint", moreau_midpoint, 1),
    *(Scheme(f"semi-impl. Euler, tanh(v/{eps:g})", semi_implicit_euler, 1, eps) for eps in (1e-3, 1e-5)),
    *(Scheme(f"RK4, tanh(v/{eps:g})", rk4, 4, eps) for eps in (1e-2, 1e-3, 1e-4, 1e-5)),
)


class Problem(NamedTuple):
    """A plant, the same in NumPy (law, Coulomb friction of the motor), and what is compared on it."""

    title: str
    plant: Plant
    law: object
    friction: float
    schemes: tuple[Scheme, ...]


def problems() -> tuple[Problem, ...]:
    drive = TwoInertia(motor_inertia=0.05, motor_viscous=0.15, load_inertia=7.0, load_viscous=16.0, gear_ratio=5.0)
    sigmoid = SigmoidBacklash(stiffness=1.0, dead_zone=0.02, slope=20.0)
    coulomb = (CoulombFriction(side="motor", torque=FRICTION),)
    hard = DeadZone(stiffness=1.0, half_gap=HALF_GAP)

    def smooth(z):
        return z - 0.08 * np.tanh(10.0 * z)

    def gap(z):
        return z - min(max(z, -HALF_GAP), HALF_GAP)

    return (
        Problem("Smooth law (3)", Plant(drive, sigmoid), smooth, 0.0, SMOOTH_SCHEMES),
        Problem(
            "Law (3), Coulomb friction on the motor", Plant(drive, sigmoid, coulomb), smooth, FRICTION, FRICTION_SCHEMES
        ),
        Problem("Hard dead zone", Plant(drive, hard), gap, 0.0, SMOOTH_SCHEMES),
    )


def inputs(samples: int) -> np.ndarray:
    return 0.1 * np.sin(2.0 * np.pi * 0.16 * PERIOD * np.arange(samples))


def reference(problem: Problem, samples: int) -> np.ndarray:
    """(theta_e, theta_s) at every sample after the first, by SciPy, from rest; equations written out anew."""
    level = problem.friction

    def net(y, u):
        """Torque on the motor less friction."""
        return u - problem.law(y[0] - 5.0 * y[1]) - 0.15 * y[2]

    def right_side(t, y, u, direction):
        load = (5.0 * problem.law(y[0] - 5.0 * y[1]) - 16.0 * y[3]) / 7.0
        if level and direction == 0.0:
            return [0.0, y[3], 0.0, load]
        return [y[2], y[3], (net(y, u) - direction * level) / 0.05, load]

    def leaves(t, y, u, direction):
        """Falls through zero where sliding stops, or sticking breaks away."""
        return direction * y[2] if direction else breakaway - abs(net(y, u))

    leaves.terminal, leaves.direction = True, -1.0
    breakaway = level * (1.0 + 1e-12)  # so that rounding does not break away
    y, direction, positions = np.zeros(4), 0.0, []
    for u in inputs(samples):
        start = 0.0
        while start < PERIOD:
            if level and direction == 0.0 and abs(net(y, u)) > breakaway:
                direction = np.sign(net(y, u))
            settings = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14}
            solution = solve_ivp(right_side, (start, PERIOD), y, first_step=PERIOD - start, args=(u, direction), **settings)
            if level and leaves(PERIOD, solution.y[:, -1], u, direction) < 0.0:
                solution = solve_ivp(right_side, (start, PERIOD), y, events=leaves, args=(u, direction), **settings)
                end = solution.y[:, -1]
                if solution.t[-1] == start:  # it would turn back at once: it sticks
                    direction = 0.0
                    solution = solve_ivp(right_side, (start, PERIOD), y, args=(u, direction), **settings)
                elif direction:
                    end[2] = 0.0
                    direction = np.sign(net(end, u)) if abs(net(end, u)) > breakaway else 0.0
                else:
                    direction = np.sign(net(end, u))
            y, start = solution.y[:, -1], solution.t[-1]
        positions.append(y[:2])
    return np.array(positions)


def positions(problem: Problem, scheme: Scheme, samples: int, substeps: int) -> np.ndarray:
    """(theta_e, theta_s) at every sample after the first."""
    plant = as_arrays(problem.plant, jnp.float64)
    torques = jnp.asarray(inputs(samples))

    @jax.jit
    def run(substeps):
        step = PERIOD / substeps

        def sample(state, torque):
            state = jax.lax.fori_loop(
                0, substeps, lambda i, s: scheme.step(plant, s, torque, i * step, step, scheme.smoothing), state
            )
            return state, jnp.stack([state.position["motor"], state.position["load"]])

        return jax.lax.scan(sample, plant.init(as_arrays(Initial(), jnp.float64)), torques)[1]

    return np.asarray(run(jnp.asarray(substeps)))


def creep(scheme: Scheme, substeps: int) -> float:
    """Angle in rad by which a block (the motor alone) creeps in 10 s under half the break-away torque."""
    plant = as_arrays(Plant(Rigid(0.05, 0.0), None, (CoulombFriction(side="motor", torque=FRICTION),)), jnp.float64)
    step = PERIOD / substeps
    state = jax.jit(
        lambda torque: jax.lax.fori_loop(
            0,
            round(10.0 / step),
            lambda i, state: scheme.step(plant, state, torque, i * step, step, scheme.smoothing),
            plant.init(as_arrays(Initial(), jnp.float64)),
        )
    )(0.5 * FRICTION)
    return float(jnp.abs(state.position["motor"]))


def costs(problem: Problem, lanes: int, samples: int, rounds: int) -> list[float]:
    """Wall time in s per lane-step of each scheme."""
    plant = as_arrays(problem.plant, jnp.float64)
    batch = eqx.tree_at(lambda p: p.transmission.stiffness, plant, jnp.linspace(0.5, 1.5, lanes))
    axes = jax.tree.map(lambda leaf: 0 if leaf.ndim else None, batch)
    torques = jnp.asarray(inputs(samples))
    step = PERIOD / DEFAULT_SUBSTEPS

    def compile_runs(scheme):
        def lane(plant):
            def sample(state, torque):
                # rolled: unrolled, XLA's fusion evaluates the law over again, more so for some schemes than for others
                state = jax.lax.fori_loop(
                    0,
                    DEFAULT_SUBSTEPS,
                    lambda i, state: scheme.step(plant, state, torque, i * step, step, scheme.smoothing),
                    state,
                )
                return state, None

            return jax.lax.scan(sample, plant.init(as_arrays(Initial(), jnp.float64)), torques)[0]

        return jax.jit(jax.vmap(lane, (axes,))).lower(batch).compile()

    runs = [compile_runs(scheme) for scheme in problem.schemes]
    least = [float("inf")] * len(runs)
    for _ in range(rounds + 1):  # the first one warms up
        for i, run in enumerate(runs):
            start = time.perf_counter()
            jax.block_until_ready(run(batch))
            least[i] = min(least[i], time.perf_counter() - start)
    return [seconds / (lanes * samples * DEFAULT_SUBSTEPS) for seconds in least]


class Row(NamedTuple):
    """One scheme at one step."""

    scheme: Scheme
    substeps: int
    evaluations: float
    cost: float
    error: float
    creep: float | None


def measure(problem: Problem, options: argparse.Namespace) -> list[Row]:
    samples = round(options.duration / PERIOD)
    expected = reference(problem, samples)
    per_step = costs(problem, options.lanes, options.cost_samples, options.rounds)
    default = per_step[[s.name for s in problem.schemes].index("Moreau midpoint")] * DEFAULT_SUBSTEPS
    rows = []
    for scheme, cost in zip(problem.schemes, per_step, strict=True):
        for substeps in options.substeps:
            error = np.abs(positions(problem, scheme, samples, substeps) - expected) * [1.0, 5.0]
            rows.append(
                Row(
                    scheme,
                    substeps,
                    scheme.evaluations * substeps / PERIOD,
                    cost * substeps / default,
                    float(error.max()) if np.isfinite(error).all() else float("inf"),
                    creep(scheme, substeps) if problem.friction else None,
                )
            )
    stuck = ""
    if problem.friction:
        stuck = f"; the motor rests in {np.mean(np.diff(expected[:, 0]) == 0.0):.0%} of the samples"
    print(f"\n{problem.title} ({options.duration:g} s; largest angle {np.abs(expected[:, 0]).max():.3g} rad{stuck})")
    print(f"Moreau midpoint: {default / DEFAULT_SUBSTEPS * 1e9:.2f} ns per lane-step, float64")
    print(table(rows))
    return rows


def table(rows: list[Row]) -> str:
    """The rows in Markdown."""
    head = ["scheme", "step (µs)", "law evaluations/s", "relative cost", "max error (rad)"]
    cells = [
        [r.scheme.name, f"{1e6 * PERIOD / r.substeps:g}", f"{r.evaluations:g}", f"{r.cost:.2f}", f"{r.error:.1e}"]
        for r in rows
    ]
    if rows[0].creep is not None:
        head.append("creep in 10 s (rad)")
        for row, cell in zip(rows, cells, strict=True):
            cell.append("0" if row.creep == 0.0 else f"{row.creep:.1e}")
    widths = [max(len(line[i]) for line in [head, *cells]) for i in range(len(head))]
    lines = [head, ["-" * (widths[0])] + ["-" * (w - 1) + ":" for w in widths[1:]], *cells]
    return "\n".join(
        "| "
        + " | ".join([line[0].ljust(widths[0])] + [c.rjust(w) for c, w in zip(line[1:], widths[1:], strict=True)])
        + " |"
        for line in lines
    )


def plot(results: list[tuple[Problem, list[Row]]], path: Path) -> None:
    """Error over cost, one panel a problem."""
    import matplotlib.pyplot as plt

    from jaxbl.report.drawing import save_canvas, style
    from jaxbl.report.panels import COLOURS

    with style():
        figure, axes = plt.subplots(1, len(results), figsize=(4.3 * len(results), 4.4))
        for axis, (problem, rows) in zip(axes, results, strict=True):
            for i, scheme in enumerate(problem.schemes):
                points = [(r.cost, r.error) for r in rows if r.scheme == scheme and r.error < 1.0]
                if points:
                    axis.plot(*zip(*points, strict=True), "osD^vP*"[i], ls="-", color=COLOURS[i], ms=4, label=scheme.name)
            axis.set(xscale="log", yscale="log", title=problem.title, xlabel="cost per simulated second (1: the default)")
            axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
        axes[0].set_ylabel("largest position error (rad)")
        print("\nfigure:", save_canvas(figure, path))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=12.5, help="simulated seconds; two periods of the input")
    parser.add_argument("--substeps", type=int, nargs="+", default=[1, 2, 5, 10, 20, 50], help="steps per sample of 1 ms")
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--cost-samples", type=int, default=100, help="samples of one timed run")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--out", type=Path, help="folder for integrators.png")
    options = parser.parse_args()
    results = [(problem, measure(problem, options)) for problem in problems()]
    if options.out is not None:
        plot(results, options.out / "integrators.png")


if __name__ == "__main__":
    main()
