"""Trajectory fit: parameters of an experiment from a record, through the differentiable simulator.

Output error on windows, each with a free initial state (multiple shooting), so that integrating plants and records made in
closed loop are handled alike. Initial states are eliminated within each window by Gauss-Newton, and what they could explain
is projected out of the residuals: variable projection with Kaufman's derivative. Levenberg-Marquardt (optimistix) then
sees the parameters alone, for many starts at once.
References: G. Golub, V. Pereyra, Separable nonlinear least squares, Inverse Problems 19 (2003); L. Kaufman, BIT 15 (1975);
H. G. Bock, Recent advances in parameter identification techniques for ODE (1983).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jaxbl.chain import Experiment, PlantState, plant_trajectory

from .compilation import jit
from .free_parameters import PRIOR_DEVIATION, FreeParameter, set_free_parameters

Residuals = Float[Array, "windows samples sides"]
"""Of positions over the noise."""
Theta = Float[Array, " parameters"]
"""Coordinates of the free parameters."""
_Slopes = tuple[Array, PlantState, Array]
"""Residuals, initial states, derivatives of the residuals by theta."""
_INNER, _OUTER = 2, 12
"""Initial states tried for a window at each step of the fit; and where they are sought anew."""
RIDGE = 1e-10
"""Least damping of a search for initial states, over the columns' squares: above rounding, below what it changes."""
INFLUENCE = 1e-20
"""Of a state, over that of the one with the most: what is below is none (an effect that does nothing)."""
_ENOUGH = 2e-3
"""A fit has ended where a step takes less than this off the sum of squares, in units of the residuals' variance."""
_MOST_REJECTED = 12
"""Steps in a row that make the fit worse, after which no better one is expected: damping has grown 4^12 times."""
_RTOL, _ATOL = 1e-6, 1e-4
"""Changes of theta (relative changes of the numbers) and of residuals (over the noise) below which a fit has converged."""
_AT_ONCE = 8
"""Fits that an accelerator does at once."""
_GAINED = 1.0
"""Residuals' variances that new initial states must gain in a window for the solver to start again."""


class Windows(eqx.Module):
    """A record cut into windows of equal length.

    Attributes:
        torque: input in N m, shape (windows, samples).
        measured: positions of each side in rad, shape (windows, samples).
        time: of each window's first sample, s, shape (windows,).
        start: a guess of the state at each window's first sample, leaves of shape (windows,).
        noise: standard deviation of each side's readings (of its prediction errors, with a gain), rad.
        at_rest: whether a window begins at rest: velocities as guessed, not fitted; shape (windows,).
        finer: what finer plant steps than the experiment's add to the simulated positions, over the noise
            (:mod:`.plant_steps`).
        gain: of the predictor (:func:`jaxbl.chain.plant_trajectory`) of each side, shape (2,);
            None: free runs, output error.
    """

    torque: Float[Array, "windows samples"]
    measured: dict[str, Float[Array, "windows samples"]]
    time: Float[Array, " windows"]
    start: PlantState
    noise: dict[str, Float[Array, ""]]
    at_rest: Bool[Array, " windows"]
    finer: Residuals
    gain: dict[str, Float[Array, " 2"]] | None = None

    def only(self, places: np.ndarray) -> "Windows":
        """Some of the windows."""
        # by NumPy: without a compiled program for each length
        columns, common = eqx.partition(self, _IN_COLUMNS)
        return eqx.combine(jax.tree.map(lambda column: np.asarray(column)[places], columns), common)

    @staticmethod
    def join(parts: Sequence["Windows"]) -> "Windows":
        """Windows of several parts of a record, with the noise and gain of the first."""
        columns, common = zip(*(eqx.partition(part, _IN_COLUMNS) for part in parts), strict=True)
        return eqx.combine(jax.tree.map(lambda *pieces: np.concatenate(pieces), *columns), common[0])


_IN_COLUMNS = Windows(True, True, True, True, False, True, True, False)  # type: ignore[arg-type]
"""What has a row a window."""
_MAPPED = jax.tree.map(lambda has_rows: 0 if has_rows else None, _IN_COLUMNS)


class Fit(eqx.Module):
    """Result of a fit from one start.

    Attributes:
        theta: shape (parameters,).
        start: initial state of each window, leaves of shape (windows,).
        residual: measured minus simulated position over the noise, shape (windows, samples, sides).
        jacobian: its derivative by theta, what initial states could explain projected out;
            shape (windows, samples, sides, parameters).
        cost: half the sum of squared residuals.
        converged: whether the solver met its tolerance.
    """

    theta: Theta
    start: PlantState
    residual: Residuals
    jacobian: Float[Array, "windows samples sides parameters"]
    cost: Float[Array, ""]
    converged: Array

    def only(self, places: np.ndarray) -> "Fit":
        """Some of the numbers; the others were held."""
        theta, jacobian = (jnp.asarray(np.asarray(x)[..., places]) for x in (self.theta, self.jacobian))
        return replace(self, theta=theta, jacobian=jacobian)


@eqx.filter_jit
def _residual(experiment: Experiment, start: PlantState, window: Windows) -> Float[Array, "samples sides"]:
    simulated = plant_trajectory(experiment, start, window.torque, window.time, window.measured, window.gain).position
    sides = [(window.measured[side] - simulated[side]) / window.noise[side] for side in experiment.sides]
    return jnp.stack(sides, axis=-1) - window.finer


def _differentiate(function: Callable[[Array], Array], point: Array) -> tuple[Array, Array]:
    """Derivative and value of a function, by one run of it."""

    def twice(point: Array) -> tuple[Array, Array]:
        value = function(point)
        return value, value

    return jax.jacfwd(twice, has_aux=True)(point)


class _Eliminated(NamedTuple):
    """The initial state of a window, the residuals from there, shape (samples, sides), and what that state can explain."""

    start: PlantState
    residual: Array
    basis: Array


class _Inner(NamedTuple):
    """Search of one window's initial state: the best so far, with residual and slope there, and the next to be tried."""

    start: Array
    value: Array
    slope: Array
    cost: Array
    damping: Array
    following: Array


def _eliminate(experiment: Experiment, window: Windows, passes: int, at_rest: bool) -> _Eliminated:
    """Initial state of one window by damped Gauss-Newton, and an orthonormal basis of what it can explain.

    The best of all states tried counts: at a hard gap, or where dry friction holds, a full step often makes things worse.
    With `at_rest`, standstill is tried as well.
    """
    guess, unravel = ravel_pytree(window.start)
    standing = jax.tree.map(jnp.zeros_like, window.start.velocity)
    still, _ = ravel_pytree(PlantState(window.start.position, standing, window.start.effects))
    free = jax.tree.map(jnp.ones_like, window.start)
    moving = jax.tree.map(lambda leaf: jnp.where(window.at_rest, 0.0, leaf), free.velocity)
    # others follow from numbers that are still to be found
    effects = tuple(
        jax.tree.map(jnp.zeros_like, state) if effect.state_from_input else state
        for effect, state in zip(experiment.effects, free.effects, strict=True)
    )
    fitted, _ = ravel_pytree(PlantState(free.position, moving, effects))

    def residual(start: Array) -> Array:
        return _residual(experiment, unravel(start), window).ravel()

    def attempt(i: Array, best: _Inner) -> _Inner:
        slope, value = _differentiate(residual, best.following)
        slope = slope * fitted[None, :]
        cost = jnp.sum(value**2)
        better = (cost < best.cost) | ~jnp.isfinite(best.cost)
        start, value, slope, cost = jax.tree.map(
            partial(jnp.where, better), (best.following, value, slope, cost), (best.start, best.value, best.slope, best.cost)
        )
        damping = jnp.where(better, jnp.maximum(0.01 * best.damping, RIDGE), jnp.maximum(30.0 * best.damping, 1e-2))
        size = jnp.sqrt(jnp.sum(slope**2, axis=0))
        # a state without influence stays where it is
        size = jnp.where(size > INFLUENCE * jnp.max(size), size, jnp.inf)
        unit = slope / size[None, :]
        change = jnp.linalg.solve(unit.T @ unit + damping * jnp.eye(len(start)), unit.T @ value)
        following = start - change / size
        if at_rest:
            # from there nothing leads back: a side that friction holds does not feel a little velocity
            middle = passes // 2
            following, damping = jnp.where(i == middle, still, following), jnp.where(i == middle, RIDGE, damping)
        return _Inner(start, value, slope, cost, damping, following)

    none = jnp.zeros(window.torque.shape[0] * len(experiment.sides))
    first = _Inner(guess, none, jnp.zeros((len(none), len(guess))), jnp.asarray(jnp.inf), jnp.asarray(RIDGE), guess)
    best = jax.lax.fori_loop(0, passes, attempt, first)
    size = jnp.sqrt(jnp.sum(best.slope**2, axis=0))
    influential = size > INFLUENCE * jnp.max(size)
    basis, _ = jnp.linalg.qr(best.slope / jnp.where(influential, size, jnp.inf)[None, :])
    # of a column of zeros the decomposition makes any direction
    basis = jnp.where(influential[None, :], basis, 0.0)
    return _Eliminated(unravel(best.start), best.value.reshape(-1, len(experiment.sides)), basis)


def _without(basis: Array, values: Array) -> Array:
    """Return the part of values, shape (samples, sides, ...), outside a basis of shape (samples times sides, states)."""
    flat = values.reshape(basis.shape[0], -1)
    return (flat - basis @ (basis.T @ flat)).reshape(values.shape)


def projected_residual(
    experiment: Experiment, windows: Windows, passes: int = _OUTER, at_rest: bool = True
) -> tuple[Residuals, PlantState]:
    """Residuals over the noise without what the windows' initial states could explain, and those states.

    Of each window's initial state `passes` values are tried, with `at_rest` standstill among them.
    """

    def project(window: Windows) -> tuple[Array, PlantState]:
        start = _eliminate(experiment, window, passes, at_rest)
        return _without(start.basis, start.residual), start.start

    return jax.vmap(project, in_axes=(_MAPPED,))(windows)


def _differentiate_windows(experiment: Experiment, free: Sequence[FreeParameter], windows: Windows, theta: Theta) -> _Slopes:
    """Projected residuals, initial states, and Kaufman's derivative of the residuals by theta."""

    def differentiate_window(window: Windows) -> _Slopes:
        window_start = _eliminate(set_free_parameters(experiment, free, theta), window, _INNER, False)

        def residual(theta: Array) -> Array:
            return _residual(set_free_parameters(experiment, free, theta), window_start.start, window)

        slope, value = _differentiate(residual, theta)
        return _without(window_start.basis, value), window_start.start, _without(window_start.basis, slope)

    return jax.vmap(differentiate_window, in_axes=(_MAPPED,))(windows)


class _Point(NamedTuple):
    """Least squares at given numbers.

    Attributes:
        residual: shape (residuals,).
        jacobian: its derivative by theta, shape (residuals, parameters).
        start: the windows' initial states there.
        squares: sum of squared residuals of each window, shape (windows,).
        whole: of :func:`_differentiate_windows`.
    """

    residual: Array
    jacobian: Array
    start: PlantState
    squares: Array
    slopes: _Slopes

    @property
    def cost(self) -> Array:
        """Sum of squared residuals."""
        return jnp.sum(self.residual**2)

    @property
    def info(self) -> Any:
        """Residuals and derivative as the solver's parts take them."""
        import lineax
        import optimistix

        return optimistix.FunctionInfo.ResidualJac(self.residual, lineax.MatrixLinearOperator(self.jacobian))


def _reduce(
    experiment: Experiment,
    free: Sequence[FreeParameter],
    windows: Windows,
    theta: Theta,
    moving: Array,
) -> _Point:
    """Reduce all residuals to one more than there are numbers, with the same cost, gradient and normal matrix.

    All columns of the derivative in one run, nothing kept along the trajectories, no decomposition of tall matrices.
    `moving` is 1 for numbers that are fitted, 0 for those that are held; shape (parameters,).
    """
    value, start, slope = _differentiate_windows(experiment, free, windows, theta)
    squares = jnp.sum(value**2, axis=(1, 2))
    total = jnp.sum(squares) + jnp.sum((theta / PRIOR_DEVIATION) ** 2)
    normal = jnp.outer(moving, moving) * jnp.einsum("wtsp,wtsq->pq", slope, slope) + jnp.diag(moving / PRIOR_DEVIATION**2)
    towards = moving * (jnp.einsum("wtsp,wts->p", slope, value) + theta / PRIOR_DEVIATION**2)
    size = jnp.sqrt(jnp.diag(normal)) + (1.0 - moving)
    root = jnp.linalg.cholesky(normal / jnp.outer(size, size) + jnp.diag(1.0 - moving))
    projected = jax.scipy.linalg.solve_triangular(root, towards / size, lower=True)
    remainder = jnp.sqrt(jnp.maximum(total - jnp.sum(projected**2), 0.0))
    derivative = jnp.concatenate([root.T * (size * moving)[None, :], jnp.zeros((1, len(theta)))])
    return _Point(jnp.concatenate([projected, remainder[None]]), derivative, start, squares, (value, start, slope))


class _Solved(NamedTuple):
    theta: Array
    point: _Point
    steps: Array
    converged: Array


def _zeros_of(function: Callable[..., _Point], *arguments: Any) -> _Point:
    """Zeros in the shapes of a result."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *arguments))


def _has_converged(new: tuple[Array, Array], old: tuple[Array, Array]) -> Array:
    """Return True if neither theta nor the residuals changed by more than the tolerances, absolute and relative."""
    within = [jnp.abs(a - b) < _ATOL + _RTOL * jnp.abs(a) for a, b in zip(new, old, strict=True)]
    return jnp.all(within[0]) & jnp.all(within[1])


def _solve(
    point: Callable[[Array, PlantState], _Point], theta: Array, guess: PlantState, most_steps: Array, count: int
) -> _Solved:
    """Levenberg-Marquardt: the initial states of the best numbers so far are the guess of the next.

    Damped steps and trust region are optimistix's; the loop is our own, as each step needs those states and ends by the
    residuals' variance. `point` is the least squares at a theta, from a guess of the initial states; the sum of squares is
    that of `count` residuals.
    """
    # a quarter of a second that a diagnosis does not need
    import lineax
    import optimistix as optx

    descent, region = optx.DampedNewtonDescent(linear_solver=lineax.QR()), optx.ClassicalTrustRegion()
    none = _zeros_of(point, theta, guess)

    def going(carry: Any) -> Array:
        *_, steps, _, ended = carry
        return (steps < most_steps) & ~ended

    def step(carry: Any) -> Any:
        theta, best, following, search, steps, rejected, _ = carry
        first = steps == 0
        new = point(following, jax.tree.map(partial(jnp.where, first), guess, best.start))
        size, accepted, searched, search = region.step(first, theta, following, best.info, new.info, search)
        met = accepted & _has_converged((following, new.residual), (theta, best.residual))
        # a change of this size is small beside what residuals of this size leave open, on any record
        small = accepted & ~first & (best.cost - new.cost < _ENOUGH * new.cost / count)
        rejected = jnp.where(accepted, 0, rejected + 1)
        theta, best = jax.tree.map(partial(jnp.where, accepted), (following, new), (theta, best))
        change, solved = descent.step(size, descent.query(theta, best.info, descent.init(theta, best.info)))
        failed = (searched != optx.RESULTS.successful) | (solved != optx.RESULTS.successful)
        ended = met | small | (rejected >= _MOST_REJECTED) | failed
        return theta, best, theta + change, search, steps + 1, rejected, ended

    zero = jnp.zeros((), int)
    start = theta, none, theta, region.init(theta, none.info), zero, zero, jnp.asarray(False)
    theta, best, _, _, steps, _, ended = jax.lax.while_loop(going, step, start)
    # where no step was asked for
    states = jax.tree.map(partial(jnp.where, steps == 0), guess, best.start)
    return _Solved(theta, best._replace(start=states), steps, ended & jnp.isfinite(best.cost))


def fit(
    experiment: Experiment,
    free: Sequence[FreeParameter],
    windows: Windows,
    theta: Theta,
    most_steps: int | Int[Array, ""] = 100,
    held: Bool[Array, " parameters"] | None = None,
    rounds: int | Int[Array, ""] = 3,
) -> Fit:
    """Fit from one start; `vmap` it over starts, or over records.

    A weak pull to the nominal values (a factor of e^3 each) keeps what a record does not show from running away.

    Args:
        experiment: with array leaves; its sample period is that of the record.
        free: what is fitted.
        windows: the record.
        theta: the start, shape (parameters,); zeros are the nominal values.
        most_steps: of the solver, each time.
        held: which numbers stay at the start; none if left out.
        rounds: how often at most the solver is started, again where initial states sought anew are better ones.
    """

    nominal = theta
    moving = jnp.ones(len(theta)) if held is None else jnp.where(held, 0.0, 1.0)

    def reduce_at(theta: Array, guess: PlantState) -> _Point:
        numbers = jnp.where(moving > 0.0, theta, nominal)
        return _reduce(experiment, free, replace(windows, start=guess), numbers, moving)

    count = windows.torque.size * len(windows.measured)

    def anew(theta: Array) -> tuple[Array, PlantState]:
        """Initial states that do not depend on those found before, and what is left over then in each window."""
        value, start = projected_residual(set_free_parameters(experiment, free, theta), windows)
        return jnp.sum(value**2, axis=(1, 2)), start

    def again(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        theta, guess, left, round, converged, _, last, _ = carry
        # a window's initial state may be the best of its neighbourhood only
        other, start = jax.lax.cond(last, lambda: (left, guess), lambda: anew(theta))
        gained = (round == 0) | jnp.any(left - other > _GAINED * jnp.sum(left) / count)
        better = (round == 0) | (other < left)
        guess = jax.tree.map(lambda new, old: jnp.where(better, new, old), start, guess)
        # the last time looks for initial states alone, and for what is left over with them: one step, which is not taken
        on = ~last & gained & (round < rounds)
        solution = _solve(reduce_at, theta, guess, jnp.where(on, most_steps, 1), count)
        theta = jnp.where((moving > 0.0) & on, solution.theta, theta)
        left, converged = jnp.where(on, solution.point.squares, left), jnp.where(on, solution.converged, converged)
        return theta, solution.point.start, left, round + 1, converged, solution.point.slopes, on & (rounds <= 1), on

    none = _zeros_of(reduce_at, theta, windows.start).slopes
    no, yes = jnp.asarray(False), jnp.asarray(True)
    first = theta, windows.start, jnp.zeros(len(windows.time)), jnp.zeros((), int), no, none, no, yes
    # all that simulates stands in the program once: it takes long to compile
    best, *_, converged, slopes, _, _ = jax.lax.while_loop(lambda carry: carry[-1], again, first)
    value, start, jacobian = slopes
    return Fit(best, start, value, jacobian, 0.5 * jnp.sum(value**2), converged)


_fit = jit(fit)
_batch = jit(eqx.filter_vmap(fit, in_axes=(None, None, None, 0, None, 0, None)))


def fits(
    experiment: Experiment,
    free: Sequence[FreeParameter],
    windows: Windows,
    thetas: np.ndarray,
    most_steps: int = 100,
    held: np.ndarray | None = None,
    rounds: int = 3,
) -> list[Fit]:
    """Fits from several starts, by one compiled program for all calls with a record of this shape and these numbers.

    Some at a time on an accelerator, one by one on a processor: that is no faster with many, and each of a batch would run
    as long as the slowest. Arguments as of :func:`fit`, starts and held numbers of shape (fits, parameters).
    """
    held = np.zeros(thetas.shape, bool) if held is None else held
    # numbers as arguments: other nominal ones need no other program
    numbers: Any = jax.tree.map(lambda number: np.asarray(number) if isinstance(number, float) else number, tuple(free))

    def run_fits(places: Any, program: Callable[..., Fit]) -> Fit:
        start, still = jnp.asarray(thetas[places]), jnp.asarray(held[places])
        return program(experiment, numbers, windows, start, jnp.asarray(most_steps), still, jnp.asarray(rounds))

    count = len(thetas)
    if jax.default_backend() == "cpu":
        return [run_fits(i, _fit) for i in range(count)]
    ends: list[Fit] = []
    for first in range(0, count, _AT_ONCE):
        # which bounds memory; the last ones are filled up
        batch = run_fits(np.minimum(first + np.arange(_AT_ONCE), count - 1), _batch)
        ends += [jax.tree.map(lambda x, i=i: x[i], batch) for i in range(min(_AT_ONCE, count - first))]
    return ends


def cut(
    torque: np.ndarray,
    measured: dict[str, np.ndarray],
    period: float,
    start: Any,
    noise: dict[str, float],
    samples: int,
    first: float = 0.0,
    at_rest: bool = False,
) -> Windows:
    """Cut part of a record into as many windows of so many samples as fit into it, shapes and units as of :class:`Windows`.

    `start` are the states at all samples, :class:`jaxbl.chain.PlantState` with leaves of shape (samples,); `first` is the
    time of the first sample, s; `at_rest` says whether the part begins at rest.
    """
    count = len(torque) // samples
    standing = np.arange(count) == (0 if at_rest else -1)
    start = jax.tree.map(lambda x: np.asarray(x)[: count * samples : samples], start)
    still = jax.tree.map(lambda x: np.where(standing, 0.0, x), start.velocity)

    def split(values: Any) -> Any:
        return np.asarray(values)[: count * samples].reshape(count, samples)

    return Windows(
        torque=split(torque),
        measured={side: split(values) for side, values in measured.items()},
        time=first + period * samples * np.arange(count),  # pyright: ignore[reportArgumentType]
        start=PlantState(start.position, still, start.effects),
        noise={side: np.asarray(value, float) for side, value in noise.items()},  # pyright: ignore[reportArgumentType]
        at_rest=standing,
        finer=np.zeros((count, samples, len(measured))),  # pyright: ignore[reportArgumentType]
    )
