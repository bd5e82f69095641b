"""Results that several files of tests read, made once a worker. A test that writes into a folder of them takes a copy."""

from collections import Counter
from pathlib import Path

import pytest
from small_study import ALPHA, LAMBDA, listed, rigid

SHARED = ("verified",)
"""Names of the fixtures; a file of tests reads one of them at most."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """One worker runs a file as a whole, and all files that read the same shared result. Those with many slow tests come
    first, so that workers end together."""
    groups: dict[Path, str] = {}
    for item in items:
        shared = [name for name in SHARED if name in getattr(item, "fixturenames", ())]
        if shared:
            groups[item.path] = shared[0]
    for item in items:
        item.add_marker(pytest.mark.xdist_group(groups.get(item.path, str(item.path.relative_to(Path(__file__).parent)))))
    slow = Counter(_group(item) for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: (-slow[_group(item)], _group(item)))


def _group(item: pytest.Item) -> str:
    mark = item.get_closest_marker("xdist_group")
    assert mark is not None
    return mark.args[0]


GAINS = [listed(LAMBDA, 0.05, 5.0, 12.0), listed(ALPHA, 1.8, 8.0)]
INPUTS = [listed("excitation.amplitude", 0.02, 0.1, zip="input"), listed("excitation.frequency", 2.0, 5.0, zip="input")]
ATLAS = {
    "q": 0.3,
    "alpha_ratio": {"start": 1.05, "stop": 12.0, "num": 7},
    "lambda_ratio": {"start": 0.05, "stop": 12.0, "num": 9},
    "damping": [0.3],
    "marks": [{"name": "small gains", "lambda": 0.005, "alpha": 1.8}, {"name": "good gains", "lambda": 6.0, "alpha": 9.0}],
}
VERIFIED = rigid(
    {
        "observer.discretisation": "explicit",
        "observer.motor.velocity_error": 0.5,
        "encoders.noise": 3e-5,
        "run.duration": 0.192,
    },
    # forward Euler at so long a period fails with large gains
    axes=[*INPUTS, *GAINS, listed("run.sample_period", 1e-3, 16e-3)],
    sweep={"seeds": 2},
    verify=ATLAS,
)


@pytest.fixture(scope="session")
def verified(tmp_path_factory):
    """The verdict on `VERIFIED`, and its folder."""
    from jaxbl.gains.verify import verify

    folder = tmp_path_factory.mktemp("verified")
    return verify(VERIFIED, folder), folder
