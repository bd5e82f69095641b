"""Results that several files of tests read, made once a worker. A test that writes into a folder of them takes a copy."""

import pytest
from small_study import ALPHA, LAMBDA, listed_axis, rigid_study

GAINS = [listed_axis(LAMBDA, 0.05, 5.0, 12.0), listed_axis(ALPHA, 1.8, 8.0)]
INPUTS = [
    listed_axis("excitation.amplitude", 0.02, 0.1, zip="input"),
    listed_axis("excitation.frequency", 2.0, 5.0, zip="input"),
]
ATLAS = {
    "q": 0.3,
    "alpha_ratio": {"start": 1.05, "stop": 12.0, "num": 7},
    "lambda_ratio": {"start": 0.05, "stop": 12.0, "num": 9},
    "damping": [0.3],
    "marks": [{"name": "small gains", "lambda": 0.005, "alpha": 1.8}, {"name": "good gains", "lambda": 6.0, "alpha": 9.0}],
}
VERIFY_STUDY = rigid_study(
    {
        "observer.discretisation": "explicit",
        "observer.motor.velocity_error": 0.5,
        "encoders.noise": 3e-5,
        "run.duration": 0.192,
    },
    # forward Euler at so long a period fails with large gains
    axes=[*INPUTS, *GAINS, listed_axis("run.sample_period", 1e-3, 16e-3)],
    sweep={"seeds": 2},
    verify=ATLAS,
)


@pytest.fixture(scope="session")
def verified_study(tmp_path_factory):
    """The verdict on `VERIFY_STUDY`, and its folder."""
    from jaxbl.gains.verify import verify

    folder = tmp_path_factory.mktemp("verified")
    return verify(VERIFY_STUDY, folder), folder
