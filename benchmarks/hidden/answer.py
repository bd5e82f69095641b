"""Diagnose saved cases with whatever `jaxbl` is first on the path: `python benchmarks/hidden/answer.py OUT CASE...`.

Each CASE is a folder with log*.csv, holdout*.csv and model.toml; OUT/NAME.json is its answer, written when it is whole, and
a case that has one is left out. Nothing of the bench is imported, so that an older commit answers the same way.
"""

import importlib
import json
import sys
import time
import tomllib
import traceback
from pathlib import Path
from typing import Any


def answer_case(folder: Path) -> dict[str, Any]:
    """What `jaxbl.diagnose` says of a case, and its processor time in s; of a failure, which kind of it and its words."""
    import jaxbl
    from jaxbl.errors import InputError

    start, answer = (time.process_time(), time.perf_counter()), {}
    try:
        logs, held = (sorted(folder.glob(f"{stem}*.csv")) for stem in ("log", "holdout"))
        diagnosis = jaxbl.diagnose(logs if len(logs) > 1 else logs[0], folder / "model.toml", holdout=held or None)
        summary = diagnosis.summary
        answer = {key: summary.get(key) for key in ("verdict", "explained_share", "notes", "warnings", "gap", "parameters")}
        answer["findings"] = [
            {key: finding.get(key) for key in ("effect", "confidence", "parameters", "alternatives")}
            for finding in summary["findings"]
        ]
        if hasattr(jaxbl, "describe"):
            lines = jaxbl.describe(diagnosis).sentences
        else:
            lines = importlib.import_module("jaxbl.report.diagnose").diagnosis_lines(summary)
        answer |= {"lines": list(lines), "model": tomllib.loads(diagnosis.model.to_toml())}
    except InputError as error:
        answer = {"failure": "refused", "error": str(error).replace(f"{folder}/", "")}
    except Exception:
        answer = {"failure": "traceback", "error": traceback.format_exc()}
    answer["seconds"] = time.process_time() - start[0]
    answer["elapsed"] = time.perf_counter() - start[1]
    return answer


def main() -> None:
    out, *folders = map(Path, sys.argv[1:])
    out.mkdir(parents=True, exist_ok=True)
    for folder in folders:
        target = out / f"{folder.name}.json"
        if target.exists():
            continue
        try:
            from jaxbl.workers import clear_programs_if_needed

            clear_programs_if_needed()
        except ImportError:
            pass
        draft = target.with_suffix(".draft")
        draft.write_text(json.dumps(answer_case(folder), indent=1), encoding="utf-8")
        draft.replace(target)
        print(f"{folder.name} answered", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
