"""Settings of Sphinx: `python -m sphinx -W -b html docs site` builds the documentation, without a network."""

import json
import re
from base64 import b64decode
from pathlib import Path
from shutil import rmtree

import servoctl

project, author, version = "servoctl", "servoctl contributors", servoctl.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
html_theme, html_title, html_copy_source = "furo", "servoctl", False
html_show_copyright = False
html_static_path, html_css_files = ["static"], ["site.css"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "none"  # docstrings have them, with shapes and units
napoleon_google_docstring = napoleon_use_rtype = False
default_role = "py:obj"
suppress_warnings = ["ref.python"]  # a shape such as (n,) is taken for a name, and several classes have an n
HERE = Path(__file__).parent
CODE = r"(::\n\n(?:    .*\n|\n)+)"


def sections(app, what, name, thing, options, lines):
    """Long tables of parameters in the sections of numpydoc; a bar is a norm, and no substitution.

    What precedes a colon in the first line of a property is no type.
    """
    if what in ("attribute", "property"):
        lines[0] = lines[0].replace(": ", " - ")
    text = re.sub(r"^Main arguments\n\n", "", "\n".join(lines), flags=re.M)
    text = re.sub(r"^Other arguments$", "\nOther Parameters\n----------------", text, flags=re.M)
    parts = re.split(CODE, text)
    parts[::2] = [part.replace("|", r"\|") for part in parts[::2]]
    lines[:] = "".join(parts).split("\n")


def outside(app, docname, source):
    """Pages of the repository that are no pages of the site are files to download."""
    if "/" not in docname:
        source[0] = re.sub(r"\]\((\.\./[^)]*\.md)\)", r"](path:\1)", source[0])


def as_page(notebook, folder):
    """The cells of a notebook with their stored outputs as a page; pictures are written to a folder."""
    parts = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {"text/plain": output.get("text", ())})
            if "image/png" in data:
                picture = folder / f"{notebook.stem}_{len(parts)}.png"
                picture.write_bytes(b64decode("".join(data["image/png"])))
                parts.append(f"![Output of the cell above]({picture.name})")
            elif printed := "".join(data.get("text/plain", ())):
                parts.append(f"```text\n{printed.rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


def notebooks(app):
    """Write the notebooks as pages, in a folder that is no part of the repository."""
    folder = HERE / "notebooks"
    rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        (folder / f"{notebook.stem}.md").write_text(as_page(notebook, folder), encoding="utf-8")


def setup(app):
    """Connect these functions to Sphinx, that of docstrings before napoleon's."""
    app.connect("builder-inited", notebooks)
    app.connect("autodoc-process-docstring", sections, priority=1)
    app.connect("source-read", outside)
