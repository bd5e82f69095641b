"""A directive for the gallery: a study as it is written, and figures of its report.

    ```{study} name
    :command: sweep
    :figures: 1
    title = "..."
    ```

`command` is that of jaxbl which runs it, here by its function in Python: a process of its own would begin by importing and
compiling, and would draw the whole report. `figures` are those shown, by their names, all if left out. They are kept in
`.cache/gallery/NAME`, and drawn anew once the study or the package has changed.
"""

import hashlib
import os
import shutil
import tomllib
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.util.docutils import SphinxDirective

import jaxbl
from jaxbl.report.drawing import save

ROOT = Path(__file__).parents[1]
CACHE = ROOT / ".cache" / "gallery"


def read_package() -> bytes:
    """Return the source of the package."""
    return b"".join(file.read_bytes() for file in sorted((ROOT / "jaxbl").rglob("*.py")))


def draw_study(name: str, command: str, figures: list[str], text: str) -> list[Path]:
    """Return files of a study's figures, and draw them if they are not there.

    Raises:
        InputError: the study is wrong, or it has no figure of that name.
        NoResult: the command found nothing.
    """
    folder, known = CACHE / name, CACHE / f"{name}.txt"
    state = hashlib.sha256(read_package() + repr((command, figures, text)).encode()).hexdigest()
    if not known.exists() or known.read_text(encoding="utf-8") != state:
        run = jaxbl.run if command == "simulate" else getattr(jaxbl, command)
        drawings = jaxbl.draw(run(tomllib.loads(text)), *figures)
        shutil.rmtree(folder, ignore_errors=True)
        for i, drawn in enumerate(drawings):
            save(drawn, folder / f"{i:02}_{drawn.name}.png")
        known.write_text(state, encoding="utf-8")
    return sorted(folder.glob("*.png"))


class Study(SphinxDirective):
    """The directive."""

    required_arguments = 1
    has_content = True
    option_spec = {"command": directives.unchanged_required, "figures": directives.unchanged}  # noqa: RUF012

    def run(self):
        """The figures, and the study below them."""
        self.env.note_reread()  # figures follow from the package, too
        (name,), text = self.arguments, "\n".join(self.content) + "\n"
        try:
            files = draw_study(name, self.options["command"], self.options.get("figures", "").split(), text)
        except (jaxbl.InputError, jaxbl.NoResult) as error:
            return [self.state.document.reporter.warning(f"{name}: {error}", line=self.lineno)]
        page = Path(self.env.doc2path(self.env.docname)).parent
        images = [nodes.image(uri=os.path.relpath(file, page), alt=f"{name}, {file.stem[3:]}") for file in files]
        return [*images, nodes.literal_block(text, text, language="toml")]


def setup(app):
    """Called by Sphinx."""
    app.add_directive("study", Study)
    return {"parallel_read_safe": True}
