"""Sets that the error of a super-twisting observer cannot leave: the proofs behind certificates.

Error of the observer (:mod:`jaxbl.observer.super_twisting`) at a sample, before the measurement: position e and velocity g,
in units of f⁺ T² and f⁺ T. Noise n and missing acceleration w, |n| <= N and |w(t)| <= 1, are chosen by an adversary. With
b = e + n and z = g - u

    e⁺ = e + phi(b) + g + q,   g⁺ = z + m

where m is the mean of w over the period and q = ∫ (1 - s) w(s) ds, so that |q - m / 2| <= (1 - m²) / 4: both for w = ±1 with
one switch. Implicit: u = clip(b, -a, a) and phi = -2 b within the sliding set, phi = ∓(l sqrt(r) + 2 a) outside, with
r + l sqrt(r) + a = |b|. Explicit: u = a sign b and phi = -l sqrt|b| sign b.

A set is a stack of rows: row k holds all g in [k, k + 1] dg and all e between bounds. At fixed b, e⁺ grows with e, so that a
row's largest e⁺ follows from its upper bound in closed form; the lower ones are the mirror image. The image of a set is
bounded by rows again, rounded outward: whatever the adversary does, the error lies in the image one sample later. An image
inside of its set proves that the set is never left. The derivation is in docs/theory_appendix.md.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbl.errors import NoResult

_COARSE_ROWS = 1_000
"""Number of rows at first; lower ones follow as the set shrinks."""
_FINEST_HEIGHT = 0.01
"""Height of the last rows over sqrt(1 + N): the proven bound is then within some per cent of its limit."""
_FINER_ROWS_COST = 0.02
"""What rows of half the height may be worth of alpha - f⁺."""
_LATTICE = 0.25
"""Bounds of e are rounded up to multiples of this part of dg: sets are then finitely many, and images come to rest."""
_SLACK, _ULPS = 1e-9, 16.0 * np.finfo(float).eps
"""Allowance for rounding errors: parts of the lattice, and of the numbers that are added up."""
_MOST_SAMPLES = 100_000
_TAIL_SAMPLES, _TAIL_RATIO = 2_000, 1.001
"""A set that still shrinks is accepted if its bound was at most this ratio larger so many samples before."""
_MOST_SWING = 1e5
"""Most that is added to the reach of the start for the chatter of forward Euler, f⁺ T: what memory allows."""
_GROUP_HEIGHT = 0.02
"""Change of u over sqrt(1 + N) that counts as one within the sliding set."""


class ErrorSystem(NamedTuple):
    """The normalised error system: T = 1, f⁺ = 1.

    Attributes:
        implicit: backward Euler, else forward Euler.
        lambda_: lambda / sqrt(f⁺).
        alpha: alpha / f⁺.
        noise: N / (f⁺ T²).
        push: bound of the nominal acceleration over f⁺, which forward Euler leaves out of the position; else 0.
    """

    implicit: bool
    lambda_: float
    alpha: float
    noise: float
    push: float = 0.0


class Proof(NamedTuple):
    """Proven bounds of the velocity error.

    Attributes:
        bounds: of the error of the velocity estimate at sample k, f⁺ T; at later samples the last one.
        row: height dg of the rows, f⁺ T.
    """

    bounds: Float[np.ndarray, " samples"]
    row: float


class _OutOfRows(Exception):
    """A set needs more rows than there are."""


class _Rows:
    """Rows of a height that divides alpha, and the image of a set; a set is the upper bounds of e, -inf where empty."""

    def __init__(self, system: ErrorSystem, height: float, reach: float):
        self.system, self.height = system, height
        # alpha is a whole number of rows, and f⁺ rounded up to one: by little of what alpha exceeds it
        least_rows = max(2, math.ceil(system.alpha / height))
        margin = max(system.alpha - 1.0, 1e-9)
        costs = {
            i: (math.ceil(i / system.alpha) * system.alpha / i - 1.0) / margin + _FINER_ROWS_COST * i / least_rows
            for i in range(least_rows, 16 * least_rows)
        }
        self.alpha = min(costs, key=costs.__getitem__)
        self.dg = system.alpha / self.alpha
        self.push = math.ceil(1.0 / self.dg)
        self.half_count = math.ceil(reach / self.dg) + self.alpha + self.push
        self.lattice = _LATTICE * self.dg
        push_height = self.push * self.dg
        mean = np.minimum(push_height, (np.arange(-self.push, self.push + 1) + 1) * self.dg)
        self.largest_moments = 0.5 * mean + 0.25 * (push_height - mean * mean / push_height) + 0.5 * system.push
        """Largest q of the m that lead so many rows up."""
        self.group = max(1, int(_GROUP_HEIGHT * math.sqrt(1.0 + system.noise) / self.dg))

    def fill_box(self, position: float, velocity: float) -> np.ndarray:
        upper, rows = np.full(2 * self.half_count, -np.inf), max(1, math.ceil(velocity / self.dg))
        if rows > self.half_count:
            raise _OutOfRows
        upper[self.half_count - rows : self.half_count + rows] = position
        return self._round_up(upper)

    def cover_set(self, other: "_Rows", upper: np.ndarray) -> np.ndarray:
        """Cover a set of other rows by these rows."""
        below = np.arange(-self.half_count, self.half_count) * self.dg / other.dg
        # a row touches the other ones from that of its lower end to that of its upper end
        ends = [np.floor(below - _SLACK), np.ceil(below + self.dg / other.dg + _SLACK) - 1.0]
        covered = np.full(2 * self.half_count, -np.inf)
        for k in range(math.ceil(self.dg / other.dg) + 2):
            row = np.minimum(ends[0] + k, ends[1]).astype(int) + other.half_count
            inside = (row >= 0) & (row < len(upper))
            np.maximum(covered, np.where(inside, upper[np.clip(row, 0, len(upper) - 1)], -np.inf), out=covered)
        return self._round_up(covered)

    def _round_up(self, upper: np.ndarray, size: float = 0.0) -> np.ndarray:
        """Round bounds up to the lattice. `size` is that of their terms, if these are larger."""
        size = max(size, float(np.abs(upper[upper > -np.inf]).max(initial=0.0)))
        return np.ceil(upper / self.lattice + _SLACK + _ULPS * size / self.lattice) * self.lattice

    @np.errstate(invalid="ignore")  # empty rows
    def map_set(self, upper: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the set one sample later, and the bound of the velocity estimate's error at this sample."""
        filled_rows = np.flatnonzero(upper > -np.inf)
        first, last = filled_rows[0], filled_rows[-1] + 1
        margin = self.alpha + self.push
        if first < margin or last + margin > len(upper):
            raise _OutOfRows
        rows = np.arange(first, last) - self.half_count
        corrected = self._correct_errors(upper[first:last], rows)
        reached_rows = np.flatnonzero(corrected > -np.inf)
        top = rows[0] - self.alpha + reached_rows[-1] + 1 if self.system.implicit else rows[-1] + 1
        pushed = np.full(len(corrected) + 2 * self.push, -np.inf)
        for shift, moment in enumerate(self.largest_moments):
            target = pushed[shift : shift + len(corrected)]
            np.maximum(target, corrected + moment, out=target)
        largest_innovation = float(np.abs(upper[filled_rows]).max()) + self.system.noise
        largest_root, top_row = math.sqrt(largest_innovation), (last - self.half_count) * self.dg
        size = largest_innovation + self.system.lambda_ * largest_root + 2.0 * self.system.alpha + top_row
        size += float(self.largest_moments[-1])
        new = np.full(len(upper), -np.inf)
        new[first - margin : last + margin] = self._round_up(pushed, size)
        return new, float(top * self.dg)

    def _correct_errors(self, high: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the largest e + phi(b) + g in the rows of z, which are `alpha` more on both sides.

        The lower bounds are minus the mirror image of `high`.
        """
        a, noise, lambda_, n, i = self.system.alpha, self.system.noise, self.system.lambda_, len(high), self.alpha
        new = np.full(n + 2 * i, -np.inf)
        # b of this row: from the least e and noise to the largest
        least, most = -high[::-1] - noise, high + noise

        def raise_bound(sign: int, there: np.ndarray, b: np.ndarray, phi: np.ndarray) -> None:
            """Raise bounds where b of this sign is `there`: u = a sign b leads i rows down or up."""
            part = new[i - sign * i : i - sign * i + n]
            bound = np.minimum(high, b + noise) + phi + (rows + 1) * self.dg
            np.maximum(part, np.where(there, bound, -np.inf), out=part)

        if self.system.implicit:
            # e + phi(b) grows with b while e is b + N, and falls where e is the bound itself
            for sign, low, up in ((1, a, np.inf), (-1, -np.inf, -a)):
                b = np.clip(high - noise, np.clip(least, low, up), np.clip(most, low, up))
                beyond = np.maximum(sign * b - a, 0.0)
                # r + l sqrt(r) = beyond
                root = 2.0 * beyond / np.maximum(lambda_ + np.sqrt(lambda_**2 + 4.0 * beyond), np.finfo(float).tiny)
                raise_bound(sign, (most >= low) & (least <= up), b, -sign * (lambda_ * root + 2.0 * a))
            self._add_sliding_set(new, high, rows)
            return new
        # convex in b > 0 while e is b + N: largest at an end
        for b in (np.maximum(least, 0.0), np.clip(high - noise, np.maximum(least, 0.0), np.maximum(most, 0.0))):
            raise_bound(1, most >= 0.0, b, -lambda_ * np.sqrt(b))
        # concave in b < 0, largest at -lambda² / 4
        b = np.clip(np.minimum(high - noise, -0.25 * lambda_**2), np.minimum(least, 0.0), np.minimum(most, 0.0))
        raise_bound(-1, least <= 0.0, b, lambda_ * np.sqrt(-b))
        raise_bound(0, (least <= 0.0) & (most >= 0.0), np.zeros(n), np.zeros(n))
        return new

    def _add_sliding_set(self, new: np.ndarray, high: np.ndarray, rows: np.ndarray) -> None:
        """Add the sliding set: b = g - z, e + phi(b) + g = e - b + z, and e - b is at most N and the bound less b."""
        a, noise, n, i, c = self.system.alpha, self.system.noise, len(high), self.alpha, self.group
        least, most, base = -high[::-1] - noise, high + noise, high - rows * self.dg
        z = (rows[0] - i + 1 + np.arange(n + 2 * i)) * self.dg
        # so many rows down at once: none, and groups that mirror each other, as rows do
        starts = range(1, i + 1, c)
        groups = [
            (0, 1),
            *((rows_down, min(c, i - rows_down + 1)) for rows_down in starts),
            *((-min(rows_down + c - 1, i), min(c, i - rows_down + 1)) for rows_down in starts),
        ]
        for rows_down, group_size in groups:
            low, up = max((rows_down - 1) * self.dg, -a), min((rows_down + group_size) * self.dg, a)
            spread = np.full(n + group_size - 1, -np.inf)
            spread[group_size - 1 :] = np.where((most >= low) & (least <= up), base, -np.inf)
            width = 1
            while width < group_size:
                step = min(width, group_size - width)
                spread[:-step] = np.maximum(spread[:-step], spread[step:])
                width += step
            target = slice(i - rows_down - group_size + 1, i - rows_down + n)
            np.maximum(new[target], np.minimum(noise, spread + z[target]) + z[target], out=new[target])


def prove(system: ErrorSystem, position: float, velocity: float, *, finest: float = _FINEST_HEIGHT) -> Proof:
    """Prove bounds of the velocity error at all samples, for all starting errors |e| <= position and |g| <= velocity.

    The starting set is mapped until it maps into itself. Units are f⁺ T² and f⁺ T.

    Args:
        system: the error system.
        position: largest position error at the start.
        velocity: largest velocity error at the start.
        finest: height of the rows over sqrt(1 + N); a bound that is twice as near takes about four times as long.

    Raises:
        NoResult: no invariant set was found.
    """
    reach = velocity + math.sqrt(2.0 * (system.alpha + 1.0) * position)
    reach += 10.0 * math.sqrt((system.alpha + 1.0) * (1.0 + system.noise + system.push)) + 4.0 * system.alpha
    height = finest * math.sqrt(1.0 + system.noise)
    # forward Euler with a large lambda swings to and fro by lambda² / 2
    swing = 0.0 if system.implicit else min(system.lambda_**2, _MOST_SWING)
    for reach_factor, extra_reach in ((1.0, 0.0), (4.0, swing)):
        try:
            return _shrink_to_invariant(
                system, height, (position, velocity), reach_factor * reach + extra_reach, _COARSE_ROWS * reach_factor**2
            )
        except _OutOfRows:
            continue
    raise NoResult("no set of errors was found that noise and disturbance cannot leave: the sets grow without end")


def _shrink_to_invariant(
    system: ErrorSystem, height: float, start: tuple[float, float], reach: float, coarsest: float
) -> Proof:
    rows = _Rows(system, max(height, reach / coarsest), reach)
    upper, bounds, inside_count = rows.fill_box(*start), [], 0
    earlier, earlier_sample = upper, 0
    for k in range(1, _MOST_SAMPLES + 1):
        new, bound = rows.map_set(upper)
        bounds.append(bound)
        # an image within its set: all later ones are, too, and bounds only fall; a set of before: bounds recur
        inside_count = inside_count + 1 if (new <= upper).all() else 0
        is_at_rest = inside_count > _TAIL_SAMPLES and bounds[-_TAIL_SAMPLES] <= _TAIL_RATIO * bound
        period = 0
        if inside_count and (is_at_rest or (new == upper).all()):
            period = 1
        elif (new == earlier).all():
            period = k - earlier_sample
        is_coarse = rows.height > height
        if period and not is_coarse:
            least = np.maximum.accumulate(np.array(bounds)[::-1])[::-1]
            return Proof(least[: k - period + 1], rows.dg)
        upper = new
        if is_coarse and (period or bound < 0.25 * coarsest * rows.height):
            # what is left is small: lower rows, down to those asked for
            finer = _Rows(system, max(height, 0.25 * rows.height), reach)
            upper, rows, inside_count = finer.cover_set(rows, upper), finer, 0
            earlier, earlier_sample = upper, k
        elif k >= 2 * earlier_sample:
            earlier, earlier_sample = upper, k
    raise NoResult(f"no set of errors came to rest within {_MOST_SAMPLES} samples")
