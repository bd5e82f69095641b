"""Proven velocity bounds of super-twisting observers, the worst that 10^6 adversarial runs find, and the least possible.

    python benchmarks/certificates.py [RUNS]

Units: T = 1, f⁺ = 1. Noise N in T² f⁺. Starting velocity error 100 T f⁺.
"""

import sys
import time

from differentiation_bound import least_worst_error

from jaxbl.gains.certificate import certify

SIZES = (0.0, 1.0, 10.0, 100.0)
GAINS = ((1.5, 1.1), (2.0, 4.0))


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    print("| observer | λ, α | N | proven | found | proven / found | proven / least possible | reached, proven | found |"
          " without noise | violations | s |")  # fmt: skip
    print("|" + "---|" * 12)
    for form in ("implicit", "explicit"):
        for gains in GAINS:
            for noise in SIZES:
                begin = time.perf_counter()
                inputs = {"noise": noise, "f_plus": 1.0, "period": 1.0, "velocity_error": 100.0}
                certificate = certify(*gains, **inputs, discretisation=form, runs=runs)
                final, search = certificate["final_accuracy"], certificate["search"]
                cells = [
                    form, f"{gains[0]:g}, {gains[1]:g}", f"{noise:g}", f"{final:.3g}", f"{search['worst']:.3g}",
                    f"{search['ratio']:.3f}", f"{final / least_worst_error(noise, 1.0, 1.0):.2f}",
                    f"{certificate['reaching_time']:.0f}", f"{search['reaching_time']:.0f}",
                    f"{certificate['reaching_time_continuous']:.0f}", str(search["violations"]),
                    f"{time.perf_counter() - begin:.1f}",
                ]  # fmt: skip
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
