"""Kills, flipped bits and interrupts, as in `benchmarks/damage.py`: some of some commands; `make test-long` has all."""

import signal
import subprocess
import sys
import time

import damage
import pytest

pytestmark = pytest.mark.long
GOOD = {
    "kill": {"equal"},
    "flip": {"equal", "refused", "refused, equal with --overwrite"},
    # it had ended already, or had left all of what was found
    "interrupt": {"nothing left", "equal"},
}


def test_results_are_whole_or_refused(tmp_path, repeats):
    names = repeats(["sweep", "identify", "export"], list(damage.COMMANDS))
    counts = {"kill": repeats(1, 20), "flip": repeats(2, 100), "interrupt": repeats(1, 20)}
    trials = list(damage.run_trials(tmp_path, names, counts))
    assert len(trials) == len(names) * sum(counts.values())
    assert [trial for trial in trials if trial["outcome"] not in GOOD[trial["kind"]]] == []
    # a second call goes on where the first one ended, and has nothing to do
    assert list(damage.run_trials(tmp_path, names, counts)) == trials


def test_an_interrupt_of_the_program_leaves_nothing(tmp_path, default_interrupt, repeats):
    """From its first moment on, while modules are loaded, too."""
    (tmp_path / "study.toml").write_text(damage.STUDY)
    words = [sys.executable, "-m", "jaxbl", "simulate", "study.toml", "--out", "out"]
    options = {"cwd": tmp_path, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    start = time.monotonic()
    subprocess.run(words, check=True, **options)
    seconds, count = time.monotonic() - start, repeats(3, 60)
    for number in range(count):
        folder = f"out{number}"
        process = subprocess.Popen([*words[:-1], folder], **options)
        # before the program's own first line Python itself is interrupted
        time.sleep(0.2 + (number + 0.5) / count * seconds)
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate()
        assert "Traceback" not in output and "ignored" not in output, output
        # the last: after its last line, as Python ends
        assert process.returncode in (0, 130, -signal.SIGINT), output
        assert (tmp_path / folder).exists() == (process.returncode != 130) and not list(tmp_path.rglob(".*")), output
