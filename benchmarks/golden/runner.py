"""Run the commands of one golden with the package on the path, and leave the results in the working folder.

    python runner.py NAME TREE

What a command prints, as one JSON object, is left beside its results; paths of this side are taken out of all text.
"""

import contextlib
import io
import json
import runpy
import shlex
import shutil
import sys
import time
import traceback
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from golden.table import GOLDENS

TEXT = (".json", ".toml", ".csv", ".c", ".h", ".st", ".xml")
COMPARED = (*TEXT, ".parquet")
"""Endings of files that are compared; pages and figures are not."""


def printed_by(arguments: list[str]) -> str:
    """Output of a command; a JSON object with the error if it fails otherwise than by an exit code."""
    sys.argv = ["jaxbl", *arguments]
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            runpy.run_module("jaxbl", run_name="__main__")
    except SystemExit:
        pass
    except BaseException as error:
        traceback.print_exc()
        return json.dumps({"failed": f"{type(error).__name__}: {error}"})
    return printed.getvalue()


def file_name(arguments: list[str], number: int) -> str:
    """Name of the file for what a command prints: that of its results."""
    if "--out" in arguments:
        return f"{arguments[arguments.index('--out') + 1]}.printed.json"
    return f"{number}_{arguments[0]}.printed.json"


def prune(folder: Path, replaced: dict[str, str]) -> None:
    """Remove what is not compared, unpack archives, and replace paths in text."""
    for archive in sorted(folder.rglob("*.fmu")):
        with zipfile.ZipFile(archive) as members:
            members.extractall(archive.with_suffix(".unpacked"))
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix not in COMPARED:
            path.unlink()
        elif path.is_file() and path.suffix in TEXT:
            text = path.read_text(encoding="utf-8")
            for old, new in replaced.items():
                text = text.replace(old, new)
            path.write_text(text, encoding="utf-8")


def main() -> None:
    name, tree = sys.argv[1:3]
    import jaxbl

    if Path(jaxbl.__file__).parents[1] != Path(tree):
        sys.exit(f"jaxbl is loaded from {jaxbl.__file__}, and should be from {tree}")
    golden, folder = GOLDENS[name], Path.cwd()
    for study, text in golden.studies.items():
        Path(study).write_text(text, encoding="utf-8")
    for number, command in enumerate(golden.commands):
        arguments = shlex.split(command)
        started = time.process_time()
        printed = printed_by([*arguments, *([] if arguments[0] == "schema" else ["--json"])])
        path = Path(file_name(arguments, number))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(printed, encoding="utf-8")
        print(f"{time.process_time() - started:6.1f} s  {command}", file=sys.stderr, flush=True)
    for study in golden.studies:
        Path(study).unlink()
    for link in ("sweeps", "recordings"):
        Path(link).unlink()
    for read in ("inputs", "programs"):
        shutil.rmtree(read, ignore_errors=True)
    prune(folder, {str(folder): "FOLDER", tree: "TREE"})


if __name__ == "__main__":
    main()
