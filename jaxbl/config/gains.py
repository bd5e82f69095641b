"""Tables of the commands that choose and judge observer gains: tune and verify."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from jaxbl.observer import OBSERVERS
from jaxbl.validation import suggest_word, table_error

from .experiment import ExcitationTable
from .sweep import AxisTable
from .tables import Table, check_distinct, declare_key


class _SpanTable(Table):
    """A table with `start` and `stop`, either of which may be left out where its class allows it."""

    @model_validator(mode="after")
    def _check_order(self) -> "_SpanTable":
        if self.start is not None and self.stop is not None and self.start >= self.stop:
            raise table_error(f"start {self.start} should be less than stop {self.stop}")
        return self


class AlphaRatioTable(_SpanTable):
    """Range of alpha / f⁺ that is searched, in equal ratios."""

    start: float = declare_key("least alpha / f⁺; no observer converges below 1", 1.1, gt=1.0, le=1e9)
    stop: float = declare_key("largest alpha / f⁺", 100.0, gt=1.0, le=1e9)


class LambdaRatioTable(_SpanTable):
    """Range of lambda / √f⁺ that is searched, in equal ratios."""

    start: float = declare_key("least lambda / √f⁺", 0.3, gt=0.0, le=1e9)
    stop: float = declare_key("largest lambda / √f⁺", 50.0, gt=0.0, le=1e9)


class GainPairTable(Table):
    """Gains of one observer."""

    lambda_: float = declare_key("gain lambda", unit="√rad/s", alias="lambda", ge=0.0)
    alpha: float = declare_key("gain alpha", unit="rad/s²", ge=0.0)


class LoopGainTable(_SpanTable):
    """A gain of a closed loop that is searched together with others."""

    path: str = declare_key("dotted path of the gain, e.g. controller.position_gain")
    start: float | None = declare_key("least value tried; left out: a tenth of the study's", None, gt=0.0)
    stop: float | None = declare_key("largest value tried; left out: ten times the study's", None, gt=0.0)


LOOP_OBJECTIVES = {"following": "following_rmse", "settling": "settling_time", "limit_cycle": "limit_cycle_amplitude"}
"""Objectives of a closed loop, and the metrics of the controlled side that they make least."""


class CompareTable(Table):
    """Other gains that tuned ones are compared with."""

    name: str = declare_key("how tables and figures call them", min_length=1, max_length=100)
    motor: GainPairTable = declare_key("gains of the motor observer")
    load: GainPairTable | None = declare_key("gains of the load observer; none on a rigid drive", None)


class SideCertificateTable(Table):
    """Assumptions of a certificate for one observer, and limits that its gains must provably keep."""

    noise: float | None = declare_key(
        "bound of the error of a reading; left out: half a count and five times the rms noise of [encoders]",
        None,
        unit="rad",
        ge=0.0,
    )
    f_plus: float | None = declare_key(
        "bound of the acceleration that the nominal model lacks; left out: the f⁺ that tune finds",
        None,
        unit="rad/s²",
        gt=0.0,
    )
    velocity_error: float | None = declare_key(
        "largest velocity error at the start; left out: that of tune's runs", None, unit="rad/s", ge=0.0
    )
    position_error: float | None = declare_key(
        "largest position error at the start; left out: the study's, at least that of a reading", None, unit="rad", ge=0.0
    )
    acceleration: float | None = declare_key(
        "bound of the nominal acceleration, for the explicit form; left out: largest of the pilot run, and f⁺",
        None,
        unit="rad/s²",
        ge=0.0,
    )
    accuracy: float | None = declare_key("velocity error that must provably not be exceeded", None, unit="rad/s", gt=0.0)
    reaching_time: float | None = declare_key("time after which that must hold", None, unit="s", gt=0.0)


class CertificateTable(Table):
    """Bounds that gains provably hold for all noise and disturbance within limits; super-twisting observers only."""

    motor: SideCertificateTable = Field(default_factory=SideCertificateTable)
    load: SideCertificateTable | None = declare_key("as motor; none on a rigid drive", None)
    runs: int = declare_key("adversarial runs that look for a counterexample", 1_000_000, ge=1, le=10**9)


TUNE_NAMES = ("tuned", "usual rule", "config")
"""What a comparison of gains always holds."""


class TuneTable(Table):
    """Settings of `jaxbl tune`. f⁺ is the bound that a pilot run of the study finds.

    Left out, `observers` is the study's own kind, super_twisting, whose lambda and alpha are searched on a map.
    """

    objective: Literal["velocity", "torque", "following", "settling", "limit_cycle"] = declare_key(
        "rms error of the observers over the last quarter of the run that is made least, worst over the seeds; or, of a "
        "closed loop, its rms following error, settling time or limit cycle",
        "velocity",
    )
    gains: list[LoopGainTable] = declare_key(
        "of an objective of the loop: [[tune.gains]], of controller and observers, that are searched together; left out: "
        "those of the observers",
        [],
        max_length=20,
    )
    longest_settling: float | None = declare_key(
        "of an objective of the loop: settling time allowed", None, unit="s", gt=0.0
    )
    largest_limit_cycle: float | None = declare_key(
        "of an objective of the loop: amplitude allowed of the limit cycle", None, unit="rad", gt=0.0
    )
    worst_over_uncertainty: bool = declare_key(
        "worst also over the corners of inertias and viscous frictions (1 ± uncertainty.relative)", False
    )
    margin_exact: float = declare_key(
        "least lambda over what the exact condition asks at the true f⁺ along each run", 1.1, ge=1.0
    )
    margin_alpha: float = declare_key("least alpha over the true f⁺ along each run", 1.1, gt=1.0)
    longest_convergence: float | None = declare_key(
        "convergence time allowed; left out: the first three quarters of the run", None, unit="s", gt=0.0
    )
    alpha_ratio: AlphaRatioTable = Field(default_factory=AlphaRatioTable)
    lambda_ratio: LambdaRatioTable = Field(default_factory=LambdaRatioTable)
    num: int = declare_key("values of each gain in the coarse map and in each zoom", 16, ge=3, le=1000)
    refine: int = declare_key("zooms around the best cell; each spans two cells of the last", 2, ge=0, le=10)
    holdout: ExcitationTable | None = declare_key(  # pyright: ignore[reportInvalidTypeForm]
        "a table as [excitation]: input that gains are compared on; left out: the study's, with other noise", None
    )
    compare: list[CompareTable] = declare_key("named gains to compare with", [], max_length=50)
    observers: list[str] = declare_key(
        "kinds of observer to choose from: each is tuned by the same search on the same runs; margins, "
        "alpha_ratio, lambda_ratio, num, compare and certificate do not apply",
        [],
        max_length=50,
    )
    trials: int = declare_key(
        "of observers: gains tried of each kind, over its whole range and in each zoom", 256, ge=8, le=65536
    )
    axes: list[AxisTable] = declare_key(
        "of observers: [[axes]] of a grid over which the best kind is mapped", [], max_length=10
    )
    certificate: CertificateTable | None = declare_key(
        "a table, which may be empty: prove bounds for the gains; left out: none", None
    )

    @model_validator(mode="after")
    def _consistent(self) -> "TuneTable":
        if self.alpha_ratio.stop < self.margin_alpha:
            raise table_error(
                f"alpha_ratio: stop {self.alpha_ratio.stop} is below margin_alpha {self.margin_alpha}; it should be above it"
            )
        self._check_observers()
        names = [other.name for other in self.compare]
        for i, name in enumerate(names):
            if name in names[:i] or name in TUNE_NAMES:
                raise table_error(f"compare[{i}].name: '{name}' is taken; choose another one")
        return self

    def _check_observers(self) -> None:
        """Kinds that exist, and keys that go with them."""
        changed = [
            name
            for name, field in type(self).model_fields.items()
            if getattr(self, name) != field.get_default(call_default_factory=True)
        ]
        in_loop = self.objective in LOOP_OBJECTIVES
        paths = [gain.path for gain in self.gains]
        check_distinct(paths, "gains[{i}].path: '{value}' is listed already; each gain may be listed once")
        for key in ("gains", "longest_settling", "largest_limit_cycle"):
            if key in changed and not in_loop:
                raise table_error(f"{key} needs an objective of the loop: {', '.join(LOOP_OBJECTIVES)}")
        if not self.observers:
            for key in ("axes",) if in_loop else ("trials", "axes"):
                if key in changed:
                    raise table_error(f"{key} needs observers, the kinds to choose from; add them, or leave {key} out")
        if not self.observers and not in_loop:
            return
        check_distinct(self.observers, "observers[{i}]: '{value}' is listed already; each kind may be listed once")
        for i, kind in enumerate(self.observers):
            if kind not in OBSERVERS:
                raise table_error(f"observers[{i}]: unknown kind '{kind}'; {suggest_word(kind, OBSERVERS)}")
        keys = "margin_exact", "margin_alpha", "alpha_ratio", "lambda_ratio", "num", "compare", "certificate"
        for key in (*keys, "observers", "longest_convergence") if in_loop else keys:
            if key in changed:
                other = f"objective = '{self.objective}'" if in_loop else "observers"
                raise table_error(f"{key} does not go with {other}; leave one of them out")
        for i, axis in enumerate(self.axes):
            if axis.path.partition(".")[0] in ("observer", "equivalent_control"):
                raise table_error(f"axes[{i}].path: '{axis.path}' is the observer's, which is searched; choose another path")
            if axis.values is None and axis.num is None:
                raise table_error(f"axes[{i}].num is missing; how many values should the axis have?")


class RangeTable(_SpanTable):
    """Values between two ends, evenly spaced on a log scale."""

    start: float = declare_key("first value", gt=0.0)
    stop: float = declare_key("last value", gt=0.0)
    num: int = declare_key("number of values", ge=2, le=8192)

    def values(self) -> np.ndarray:
        """The values, shape (num,)."""
        return np.geomspace(self.start, self.stop, self.num)


class MarkTable(GainPairTable):
    """A pair of gains to be marked in the atlas, run once on the study's drive."""

    name: str = declare_key("label", max_length=100)
    side: Literal["motor", "load"] = declare_key("observer that has these gains", "motor")


class VerifyTable(Table):
    """Settings of `jaxbl verify` besides the study's own points: the normalised error system, and marks."""

    q: float | None = declare_key("q of condition (32); left out: its limit q → 0", None, gt=0.0, lt=1.0)
    alpha_ratio: RangeTable = declare_key(
        "alpha / f_plus of the atlas", default_factory=lambda: RangeTable(start=1.02, stop=20.0, num=512)
    )
    lambda_ratio: RangeTable = declare_key(
        "lambda / √f_plus of the atlas", default_factory=lambda: RangeTable(start=0.002, stop=25.0, num=512)
    )
    damping: list[Annotated[float, Field(gt=0.0, le=1000.0)]] = declare_key(
        "dampings (friction / inertia × velocity error / f_plus) whose boundaries are simulated",
        [0.1, 0.3, 1.0],
        max_length=100,
    )
    marks: list[MarkTable] = declare_key("gains to be marked", [], max_length=100)

    @model_validator(mode="after")
    def _possible(self) -> "VerifyTable":
        if self.alpha_ratio.start <= 1.0:
            raise table_error(
                f"alpha_ratio.start {self.alpha_ratio.start} should exceed 1: no lambda converges where alpha is not above "
                "f_plus"
            )
        return self
