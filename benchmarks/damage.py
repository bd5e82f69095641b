"""What kills, flipped bits and interrupts leave of the results of each command: after one more call the same bytes, or one
line that refuses them.

    python benchmarks/damage.py FOLDER [--commands sweep,identify] [--kills 20] [--flips 100] [--interrupts 20]

Each trial has a seed of its own and a line in FOLDER/trials.jsonl: a run that is ended goes on where it stopped.
"""

import argparse
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

CONTEXT = multiprocessing.get_context("forkserver" if sys.platform != "win32" else "spawn")
_MODULES = ["jaxbl.cli", "jaxbl.report.results", "jaxbl.batch", "jaxbl.report.explorer.study", "jaxbl.report.explorer.log"]
RIG = '[log]\nkind = "element"\ntheta_e = { column = "x", unit = "mm" }\nu = "force"\n'
STUDY = """title = "damage"
drive = { kind = "rigid", motor_inertia = 0.05, motor_viscous = 0.15 }
excitation = { kind = "sine", amplitude = 0.1, frequency = 2.0 }
encoders = { noise = 3e-5 }
run = { duration = 0.192, substeps = 1 }
sweep = { seeds = 2, chunk = 2 }
[observer]
motor = { lambda = 4.0, alpha = 9.0, velocity_error = 0.5 }
"""
GAINS = """[[axes]]
path = "observer.motor.lambda"
values = [0.05, 5.0, 12.0]
[[axes]]
path = "observer.motor.alpha"
values = [1.8, 8.0]
"""
GAP = """transmission = { law = "sigmoid_backlash", stiffness = 1.0, dead_zone = 0.02, slope = 20.0 }
excitation = { kind = "multisine", amplitude = 5.0, frequency = 0.7 }
encoders = { noise = 1e-4 }
run = { duration = 2.0, substeps = 5 }
[observer]
motor = { lambda = 20.0, alpha = 400.0 }
load = { lambda = 3.0, alpha = 20.0 }
[drive]
kind = "two_inertia"
motor_inertia = 0.05
motor_viscous = 0.15
load_inertia = 7.0
load_viscous = 16.0
gear_ratio = 5.0
"""
VERIFY = """[verify]
alpha_ratio = { start = 1.05, stop = 12.0, num = 5 }
lambda_ratio = { start = 0.05, stop = 12.0, num = 5 }
damping = [0.3]
"""
TUNE = "[tune]\nnum = 3\nrefine = 1\n"


class Command(NamedTuple):
    """A command: its words, its folder, whether it takes --overwrite, and whether it goes on where it stopped."""

    words: str
    folder: str
    overwrites: bool = True
    goes_on: bool = False


COMMANDS = {
    "simulate": Command("simulate study.toml --out OUT", "OUT"),
    "sweep": Command("sweep map.toml --out OUT", "OUT", goes_on=True),
    "verify": Command("verify verify.toml --out OUT", "OUT", goes_on=True),
    "tune": Command("tune tune.toml --out OUT", "OUT", goes_on=True),
    "inspect": Command("inspect axis.csv --out OUT", "OUT"),
    "identify": Command("identify rig.csv --model rig.toml --out OUT", "OUT"),
    "diagnose": Command("diagnose axis.csv --model axis.toml --out OUT", "OUT"),
    "batch": Command("diagnose --batch logs --model axis.toml --jobs 1 --out OUT", "OUT", goes_on=True),
    "watch": Command("watch gap/trace.parquet --model gap.toml --window 0.5 --every 0.2 --out OUT", "OUT"),
    "export": Command("export study.toml --out OUT", "OUT", overwrites=False),
    "explore": Command("explore before --static OUT", "OUT", overwrites=False),
    "compare": Command("compare before after --out OUT", "OUT", overwrites=False),
}


def write_inputs(folder: Path) -> None:
    """Write studies, logs and the sweeps that other commands read."""
    import pandas as pd

    (folder / "logs").mkdir(parents=True, exist_ok=True)
    texts = {
        "study": STUDY,
        "map": STUDY + GAINS,
        "verify": STUDY + GAINS + VERIFY,
        "tune": STUDY + TUNE,
        "axis": STUDY,
        "gap": GAP,
    }
    for name, text in (texts | {"rig": RIG}).items():
        (folder / f"{name}.toml").write_text(text)
    t = 0.01 * np.arange(600)
    x = 0.02 * np.sin(2.0 * np.pi * 0.5 * t)
    force = 500.0 * (x - np.clip(x, -0.005, 0.005)) + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    pd.DataFrame({"t": t, "x": 1e3 * x, "force": force}).to_csv(folder / "rig.csv", index=False)
    t = np.arange(600) * 1e-3
    torque = np.cos(20.0 * t) + 0.15 * np.sin(20.0 * t)
    position = -0.05 * np.cos(20.0 * t) + 1e-5 * np.cos(1e6 * t)
    log = pd.DataFrame({"t": t, "u": torque, "theta_e": position})
    for file in ("axis.csv", "logs/first.csv", "logs/second.csv"):
        log.to_csv(folder / file, index=False)
    if not (folder / "gap").exists():
        code, text = call(folder, "simulate gap.toml --out gap")
        assert code in (0, 1), text
    for name, change in (("before", ""), ("after", "3e-5")):
        (folder / f"{name}.toml").write_text((STUDY + GAINS).replace(change or "\0", "1e-4"))
        if not (folder / name).exists():
            code, text = call(folder, f"sweep {name}.toml --out {name}")
            assert code == 0, text


def _begin(folder: Path, words: list[str]) -> None:
    """Run a command as the program does, in a process that has loaded its modules."""
    os.chdir(folder)
    output = os.open(folder / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    # a shell in the background has them ignored, and Python then takes no notice of them
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["jaxbl", *words]
    from jaxbl.__main__ import leave, program

    signal.signal(signal.SIGINT, leave)
    program()


def start(folder: Path, words: str) -> Any:
    """Start a command in a process of its own."""
    process = CONTEXT.Process(target=_begin, args=(folder, words.split()))
    process.start()
    return process


def call(folder: Path, words: str) -> tuple[int, str]:
    """Run a command. Returns its exit code and what it printed."""
    process = start(folder, words)
    process.join()
    return int(process.exitcode or 0), (folder / "output.txt").read_text(errors="replace")


def read_files(folder: Path) -> dict[str, bytes]:
    """All files of a folder with their bytes, pages without their remarks, if any: one tells how long compiling took."""
    files = {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
    remarks = rb"\s*<details><summary>Remarks.*?</details>"
    return {name: re.sub(remarks, b"", bytes_) if name == "report.html" else bytes_ for name, bytes_ in files.items()}


class Trials:
    """Trials of one command.

    Args:
        name: of the command.
        place: folder of its trials.
        inputs: folder with what it reads.
    """

    def __init__(self, name: str, place: Path, inputs: Path):
        self.command, self.place, self.inputs = COMMANDS[name], place, inputs
        self.whole = self.measure()

    def words(self, out: Path, *more: str) -> str:
        return " ".join([self.command.words.replace("OUT", str(out)), *more])

    def measure(self) -> dict[str, bytes]:
        """Run the command three times: to compile, for its time, and to see which files depend on when and where it ran."""
        runs = []
        for number in range(3):
            out = self.place / "OUT"
            shutil.rmtree(out, ignore_errors=True)
            begin = time.monotonic()
            code, text = call(self.inputs, self.words(out))
            self.seconds = time.monotonic() - begin
            assert code in (0, 1, 3), text
            self.code = code
            runs.append(read_files(out))
            if number == 2:
                shutil.rmtree(self.place / "whole", ignore_errors=True)
                shutil.copytree(out, self.place / "whole")
        assert runs[1].keys() == runs[2].keys()
        return {name: content for name, content in runs[2].items() if content == runs[1][name]}

    def finish(self, out: Path) -> str:
        """Call the command again, and say how the folder is then."""
        code, text = call(self.inputs, self.words(out))
        progress = " so far", " left"
        said = [line for line in text.splitlines() if line.startswith("jaxbl: ") and not line.endswith(progress)]
        if "Traceback" in text or "Exception ignored" in text:
            return f"TRACEBACK {text[-300:]}"
        if code == 2 and len(said) == 1:
            if not self.command.overwrites:
                return "refused"
            code, text = call(self.inputs, self.words(out, "--overwrite"))
            # those two have the words of the command
            said = self.compare(out, code, text, ignored=("report.html", "manifest.json"))
            return f"refused, {said} with --overwrite"
        return self.compare(out, code, text)

    def compare(self, out: Path, code: int, text: str, ignored: tuple[str, ...] = ()) -> str:
        """Say whether a folder has the bytes of one that was left alone."""
        if code != self.code:
            return f"CODE {code} {text[-300:]}"
        files = read_files(out)
        wrong = [name for name, content in self.whole.items() if files.get(name) != content and name not in ignored]
        left = [str(path.relative_to(out)) for path in out.rglob(".*")]
        return f"WRONG {wrong}" if wrong else f"LEFT {left}" if left else "equal"

    def kill(self, rng: random.Random) -> str:
        """Kill the command at a random moment, and call it again."""
        out = self.place / "OUT"
        shutil.rmtree(out, ignore_errors=True)
        process = start(self.inputs, self.words(out))
        process.join(rng.uniform(0.02, 1.0) * self.seconds)
        process.kill()
        process.join()
        return self.finish(out)

    def flip(self, rng: random.Random) -> str:
        """Flip a bit of a file, each file being as probable, and call the command again."""
        out = self.place / "OUT"
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(self.place / "whole", out)
        file = rng.choice([path for path in sorted(out.rglob("*")) if path.is_file() and path.stat().st_size])
        content = bytearray(file.read_bytes())
        bit = rng.randrange(8 * len(content))
        content[bit // 8] ^= 1 << bit % 8
        file.write_bytes(content)
        return self.finish(out)

    def interrupt(self, rng: random.Random) -> str:
        """Interrupt the command at a random moment."""
        out = self.place / "OUT"
        shutil.rmtree(out, ignore_errors=True)
        process = start(self.inputs, self.words(out))
        process.join(rng.uniform(0.02, 1.0) * self.seconds)
        if process.exitcode is None:
            # it may end just now
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGINT)
        process.join(60.0)
        if process.exitcode is None:
            process.kill()
            return "HANGS"
        text = (self.inputs / "output.txt").read_text(errors="replace")
        left = [str(path.relative_to(out)) for path in out.rglob("*") if path.name.startswith(".")]
        if process.exitcode != 130:
            return self.compare(out, process.exitcode, text)
        if "Traceback" in text or "Exception ignored" in text:
            return f"TRACEBACK {text[-600:]}"
        if out.exists() and not left and not self.command.goes_on and self.compare(out, self.code, "") != "equal":
            left = sorted(read_files(out)) or ["an empty folder"]
        return f"LEFT {left}" if left else "nothing left"


def run_trials(folder: Path, names: list[str], counts: dict[str, int]) -> Iterator[dict[str, str]]:
    """Run the trials that are not in `trials.jsonl` yet, and yield all."""
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    CONTEXT.set_forkserver_preload(_MODULES) if sys.platform != "win32" else None
    inputs, record = folder / "inputs", folder / "trials.jsonl"
    inputs.mkdir(exist_ok=True)
    write_inputs(inputs)
    done = {}
    for line in record.read_text().splitlines() if record.exists() else ():
        trial = json.loads(line)
        done[trial["command"], trial["kind"], trial["trial"]] = trial
    for name in names:
        trials = None
        for kind, count in counts.items():
            for number in range(count):
                if (name, kind, number) not in done:
                    place = folder / name
                    place.mkdir(exist_ok=True)
                    trials = trials or Trials(name, place, inputs)
                    outcome = getattr(trials, kind)(random.Random(f"{name} {kind} {number}"))
                    done[name, kind, number] = {"command": name, "kind": kind, "trial": number, "outcome": outcome}
                    with record.open("a") as file:
                        file.write(json.dumps(done[name, kind, number]) + "\n")
                yield done[name, kind, number]


def format_table(trials: list[dict[str, str]]) -> str:
    """A row for each command and kind of damage with the number of each outcome."""
    rows: dict[tuple[str, str], Counter[str]] = {}
    for trial in trials:
        rows.setdefault((trial["command"], trial["kind"]), Counter())[trial["outcome"].split("\n")[0][:150]] += 1
    lines = ["| command | damage | trials | outcomes |", "|---|---|---:|---|"]
    for (name, kind), outcomes in rows.items():
        said = "; ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common())
        lines.append(f"| {name} | {kind} | {outcomes.total()} | {said} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--commands", default=",".join(COMMANDS))
    for kind, count in (("kill", 20), ("flip", 100), ("interrupt", 20)):
        parser.add_argument(f"--{kind}s", type=int, default=count)
    given = parser.parse_args()
    counts = {kind: getattr(given, f"{kind}s") for kind in ("kill", "flip", "interrupt")}
    print(format_table(list(run_trials(given.folder, given.commands.split(","), counts))))


if __name__ == "__main__":
    main()
