"""Cost of exported code: lines, state, operations a step, instructions of a Cortex-M4, and time on this machine.

    python benchmarks/export.py

Needs gcc; instructions are counted where arm-none-eabi-gcc is: all of the step's function and of those that it calls (the
emulator has no clock of cycles), -O2, so that branches not taken count, too.
"""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import jaxbl
from jaxbl.config import read_config
from jaxbl.observer import OBSERVERS

_ARM = ("-std=c99", "-O2", "-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")
_TIMED = """
#include <stdio.h>
#include <time.h>
#include "drive.h"
int main(void)
{{ static drive_state s; drive_outputs o; {real} sum = 0; long i, n = 2000000; clock_t start;
  drive_init(&s, 0, 0); start = clock();
  for (i = 0; i < n; i++) {{ {real} x = ({real})(i % 1000) * ({real})1e-4;
    drive_step(&s, x, x, x * ({real})0.2, &o); sum += o.motor_torque_estimate; }}
  printf("%.1f\\n", (double)(clock() - start) / CLOCKS_PER_SEC / (double)n * 1e9); return sum == ({real})0; }}
"""
GAINS = {
    "lambda": 4.0, "alpha": 9.0, "bandwidth": 150.0, "position_noise": 1e-4, "disturbance_noise": 100.0,
    "time_constant": 0.004, "lipschitz": 50.0,
}  # fmt: skip


def run_command(*command: Any, folder: Path) -> str:
    return subprocess.run(list(map(str, command)), cwd=folder, check=True, capture_output=True, text=True).stdout


def row(kind: str, precision: str) -> list[str]:
    """A row of the table: both sides with the identifier, on the paper's drive."""
    study = read_config(Path(__file__).parent.parent / "sweeps" / "paper_table1.toml").to_dict()
    study["observer"] = {"kind": kind, "motor": GAINS, "load": GAINS}
    for table in ("axes", "figures", "verify", "tune", "notes"):
        study.pop(table, None)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "out"
        summary = jaxbl.export(study, folder, precision=precision, name="drive").summary
        lines = len((folder / "drive.c").read_text().splitlines())
        (folder / "timed.c").write_text(_TIMED.format(real=precision))
        run_command("gcc", "-std=c99", "-O2", "drive.c", "timed.c", "-lm", "-o", "timed", folder=folder)
        times = sorted(float(run_command("./timed", folder=folder)) for _ in range(5))
        count = size = "-"
        if shutil.which("arm-none-eabi-gcc"):
            run_command("arm-none-eabi-gcc", *_ARM, "-c", "drive.c", "-o", "drive.o", folder=folder)
            text = run_command("arm-none-eabi-objdump", "-d", "drive.o", folder=folder).split("<drive_init>:")
            init = text[1].partition("<drive_step>:")[0] if "<drive_step>:" in text[1] else ""
            instructions = sum(len(re.findall(r"^ +[0-9a-f]+:\t", part, re.MULTILINE)) for part in text)
            count = str(instructions - len(re.findall(r"^ +[0-9a-f]+:\t", init, re.MULTILINE)))
            size = run_command("arm-none-eabi-size", "drive.o", folder=folder).splitlines()[1].split()[0]
    return [kind, precision, str(lines), str(summary["state_bytes"]), str(summary["operations"]), count, size,
            f"{times[0]:.0f}"]  # fmt: skip


def main() -> None:
    head = ["kind", "numbers", "lines", "state, bytes", "operations", "M4 instructions", "M4 code, bytes", "ns a step here"]
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for kind in OBSERVERS:
        for precision in ("float", "double"):
            print("| " + " | ".join(row(kind, precision)) + " |", flush=True)


if __name__ == "__main__":
    main()
