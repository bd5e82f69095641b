"""The adversary: what it finds is real, at least what short brute force finds, and above a bound that is too small."""

import functools
import itertools

import jax
import numpy as np
import pytest
from error_steps import step_errors

from jaxbl.gains import adversary
from jaxbl.gains.adversary import explore_errors, search_violations
from jaxbl.gains.invariant_set import ErrorSystem, prove

SYSTEMS = [
    ErrorSystem(True, 1.5, 1.1, 0.0),
    ErrorSystem(True, 1.5, 1.1, 5.0),
    ErrorSystem(False, 1.5, 1.1, 0.0),
    ErrorSystem(False, 2.0, 4.0, 5.0, 1.0),
]
RATIOS = dict(zip(SYSTEMS, (1.17, 1.06, 1.12, 1.2), strict=True))
"""Largest ratio of the proven bound to the worst error that was found."""


@pytest.fixture(autouse=True, scope="module")
def _few_lanes():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adversary, "_LANES", 1 << 12)
        yield


@functools.cache
def prove_and_search(system):
    """A proof from the largest noise, and the result of a search for errors above it."""
    proof = prove(system, system.noise, 0.0)
    return proof, search_violations(system, system.noise, 0.0, proof, proof.bounds[-1], 1)


@pytest.mark.parametrize("system", SYSTEMS, ids=str)
def test_the_way_that_is_found_leads_there(system):
    with jax.enable_x64(True):
        result, way = explore_errors(system)
    e, g, errors = np.zeros(1), np.zeros(1), []
    for noise, mean, moment, nominal in zip(*way, strict=True):
        assert abs(noise) <= system.noise
        assert abs(moment - 0.5 * mean) <= 0.25 * (1.0 - mean**2) + 1e-15
        e, g, error = step_errors(system, e, g, noise, mean, moment, system.push * nominal)
        errors.append(float(error[0]))
    assert errors[-1] == pytest.approx(result.worst, rel=1e-9)
    assert result.state_count > 10


@pytest.mark.parametrize("system", SYSTEMS, ids=str)
def test_search_finds_at_least_what_all_sequences_of_a_short_horizon_show(system):
    choices = np.array(list(itertools.product((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0)[: 1 + (system.push > 0)])))
    noise, mean, nominal = choices.T
    moment = 0.5 * mean
    e, g, largest = np.zeros(1), np.zeros(1), 0.0
    for _ in range(5):
        count = len(choices)
        e, g, error = step_errors(
            system, np.repeat(e, count), np.repeat(g, count),
            *(np.tile(x, len(e)) for x in (system.noise * noise, mean, moment, system.push * nominal)),
        )  # fmt: skip
        largest = max(largest, error.max())
    proof, result = prove_and_search(system)
    assert result.worst >= largest
    assert result.violations == 0
    assert proof.bounds[-1] <= RATIOS[system] * result.worst


@pytest.mark.parametrize("system", SYSTEMS, ids=str)
def test_a_bound_that_is_too_small_is_found_out(system):
    proof, result = prove_and_search(system)
    low_proof = proof._replace(bounds=proof.bounds / (1.01 * proof.bounds[-1] / result.worst))
    refuted = search_violations(system, system.noise, 0.0, low_proof, low_proof.bounds[-1], 1)
    assert refuted.violations > 0


def test_runs_from_the_start_are_held_against_the_bound_of_each_sample():
    system = ErrorSystem(True, 1.5, 1.1, 1.0)
    proof = prove(system, 1.0, 50.0)
    settled_bound = 1.05 * proof.bounds[-1]
    result = search_violations(system, 1.0, 50.0, proof, settled_bound, 1)
    settling_sample = int((proof.bounds <= settled_bound).argmax())
    assert 0.85 * settling_sample <= result.latest + 1 <= settling_sample
    # half the time: the worst errors do not fall so fast
    sparse_proof = proof._replace(bounds=proof.bounds[::2])
    assert search_violations(system, 1.0, 50.0, sparse_proof, settled_bound, 1).violations > 0


def test_the_same_seed_finds_the_same():
    system = SYSTEMS[1]
    proof, _ = prove_and_search(system)
    first, other = (search_violations(system, system.noise, 0.0, proof, 1.0, 10_000, seed=3) for _ in range(2))
    assert first == other and first.runs >= 10_000
