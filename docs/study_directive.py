"""A directive for the gallery: a study as it is written, and the figures that its report draws of it.

    ```{study} name
    :command: sweep
    :figures: 1
    title = "..."
    ```

`command` is that of jaxbl which runs it; `figures` are those shown, by their names, all if left out. Results are kept in
`.cache/gallery/NAME`, and drawn anew once the study or the package has changed.
"""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).parents[1]
CACHE = ROOT / ".cache" / "gallery"


def read_package() -> bytes:
    """Return the source of the package."""
    return b"".join(file.read_bytes() for file in sorted((ROOT / "jaxbl").rglob("*.py")))


def draw_study(name: str, command: str, text: str) -> list[Path]:
    """Return figures of a study's report, and draw them if they are not there.

    Raises:
        RuntimeError: the command failed.
    """
    out, study, known = CACHE / name, CACHE / f"{name}.toml", CACHE / f"{name}.txt"
    state = hashlib.sha256(read_package() + text.encode() + command.encode()).hexdigest()
    if not known.exists() or known.read_text(encoding="utf-8") != state:
        CACHE.mkdir(parents=True, exist_ok=True)
        study.write_text(text, encoding="utf-8")
        words = [sys.executable, "-m", "jaxbl", command, str(study), "--out", str(out), "--overwrite"]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{name}: {done.stderr.strip()}")
        known.write_text(state, encoding="utf-8")
    return sorted((out / "figures").glob("*.png"))


class Study(SphinxDirective):
    """The directive."""

    required_arguments = 1
    has_content = True
    option_spec = {"command": directives.unchanged_required, "figures": directives.unchanged}  # noqa: RUF012

    def run(self):
        """The figures, and the study below them."""
        self.env.note_reread()  # figures follow from the package, too
        name, command, text = self.arguments[0], self.options["command"], "\n".join(self.content) + "\n"
        try:
            files = draw_study(name, command, text)
        except RuntimeError as error:
            return [self.state.document.reporter.warning(str(error), line=self.lineno)]
        wanted = self.options.get("figures", "").split() or [file.stem for file in files]
        shown = [file for stem in wanted for file in files if file.stem == stem]
        if len(shown) != len(wanted):
            text = f"{name}: not all of {wanted} are figures: {[file.stem for file in files]}"
            return [self.state.document.reporter.warning(text, line=self.lineno)]
        page = Path(self.env.doc2path(self.env.docname)).parent
        images = [nodes.image(uri=os.path.relpath(file, page), alt=f"{name}, {file.stem}") for file in shown]
        return [*images, nodes.literal_block(text, text, language="toml")]


def setup(app):
    """Called by Sphinx."""
    app.add_directive("study", Study)
    return {"parallel_read_safe": True}
