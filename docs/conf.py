"""How Sphinx makes the site (`make site`): from the tree's root, of the pages as they are read there."""

import hashlib
import os
import re
import sys
from importlib.metadata import version as version_of
from pathlib import Path

from nbclient import NotebookClient
from sphinx.util import logging

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
# what tutorials and the gallery compile is kept as for the tests
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(HERE.parent / ".cache" / "jax" / sys.implementation.cache_tag))

project = "jaxbl"
author = "the jaxbl authors"
release = version_of("jaxbl")
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "study_directive"]
root_doc = f"{HERE.name}/index"
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/*.md",
]
exclude_patterns = ["**/.*", "results", "build", "dist", "docs/_build"]

# tutorials run where their page is read; what a command prints comes in pieces
NotebookClient.coalesce_streams = True
TUTORIALS = {"tutorial": "axis.toml", "log_tutorial": ""}
"""Pages, and the file that their TOML makes."""
nb_custom_formats = {
    f"{HERE.name}/{name}.md": ["page_notebook.read_page", {"name": name, "study": study}]
    for name, study in TUTORIALS.items()
}
os.environ["PYTHONSTARTUP"] = str(HERE / "command_line.py")
nb_output_stderr = "remove"  # progress
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 600
myst_heading_anchors = 4  # as GitHub makes them
default_role = "code"
autodoc_typehints = "none"  # units and shapes are in the text
autodoc_member_order = "bysource"
napoleon_use_ivar = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = f"jaxbl {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_extra_path = ["site"]  # the way from the site's root to its first page
html_copy_source = False
html_show_copyright = False


def read_docstring(app, what, name, it, options, lines):
    """Docstrings write sizes as |x|, which reStructuredText takes for a name, but in `code`."""
    for i, line in enumerate(lines):
        lines[i] = re.sub(r"(`[^`]*`)|\|", lambda match: match[1] or r"\|", line)
    if what in ("attribute", "data", "property"):
        # napoleon takes what stands before a colon in the first line for a type: here, an empty comment
        lines[:0] = ["..", ""]


def list_outdated_tutorials(app, env, added, changed, removed):
    """Run the tutorials anew once the package, or how their cells are run, has changed."""
    from study_directive import read_package

    package = hashlib.sha256(read_package() + (HERE / "command_line.py").read_bytes()).hexdigest()
    outdated = getattr(env, "tutorials_package", None) != package
    env.tutorials_package = package
    return [f"{HERE.name}/{name}" for name in TUTORIALS] if outdated else []


def warn_of_foreign_files(app, error):
    """Warn of pages that load something from another host."""
    loads = re.compile(
        r"""<(?:script|img|iframe|link)\b[^>]*?(?:src|href)=["']?(?:https?:)?//[^>]*>|@import|url\(["']?https?:"""
    )
    pages = [] if error else [file for kind in ("html", "css") for file in Path(app.outdir).rglob(f"*.{kind}")]
    for file in pages:
        if match := loads.search(file.read_text(encoding="utf-8")):
            logging.getLogger(__name__).warning(f"{file}: loads from another host: {match[0]}")


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", read_docstring, priority=400)  # before napoleon
    app.connect("env-get-outdated", list_outdated_tutorials)
    app.connect("build-finished", warn_of_foreign_files)


# names of attributes that several classes have, as of `position_error`: no link is made of them
suppress_warnings = ["ref.python"]
