"""Settings of Sphinx: `python -m sphinx -W -b html docs site` builds the documentation, without a network."""

import inspect
import json
import re
from base64 import b64decode
from pathlib import Path
from shutil import rmtree

import servoctl

project, author, version = "servoctl", "servoctl contributors", servoctl.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
html_theme, html_title, html_copy_source = "furo", "servoctl", False
html_show_copyright, html_math_renderer = False, "mathml"
html_static_path, html_css_files = ["static"], ["site.css"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "signature"  # docstrings add shapes and units
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88  # characters: longer ones have a line for each parameter
napoleon_google_docstring = napoleon_use_rtype = False
default_role = "py:obj"
suppress_warnings = ["ref.python"]  # a shape such as (n,) is taken for a name, and several classes have an n
HERE = Path(__file__).parent
SOURCES = [*HERE.glob("*.md"), *HERE.parent.glob("examples/*.py"), *HERE.parent.glob("notebooks/*.ipynb")]
USED = "\n".join(path.read_text(encoding="utf-8") for path in SOURCES if path.stem not in ("architecture", "numbers"))
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


def internal(app, what, name, thing, skip, options):
    """Leave out what a module imports, and a class's methods without types that no page and no example names."""
    function = getattr(thing, "fget", None) or getattr(thing, "func", thing)
    if what == "module" and options.imported_members:
        home = f"{getattr(inspect.getmodule(thing), '__name__', '')}."
        public = any(home.startswith(f"{getattr(servoctl, name).__name__}.") for name in servoctl.__all__)
        return None if public and "----" in (thing.__doc__ or "") else True
    if skip or what != "class" or not inspect.isfunction(function):
        return None
    first = function.__qualname__.split(".")[0]
    homes = (servoctl, servoctl.types, servoctl.methods, servoctl.paths)
    owner = next((getattr(home, first) for home in homes if hasattr(home, first)), None)
    known = re.search(rf"\.{name}\b", USED) or f"`{name}`" in (owner.__doc__ or "")
    return None if function.__annotations__ or known else True


def signed(app, what, name, thing, options, signature, returns):
    """No constructor for a class whose values a function makes; the short name of what NumPy takes for an array."""
    from numpy.typing import ArrayLike
    from sphinx.util.typing import stringify_annotation

    if what == "class" and "made by" in (thing.__doc__ or "").split("\n\n")[0]:
        return "", None
    return (signature or "").replace(stringify_annotation(ArrayLike, "smart"), "ArrayLike") or None, returns


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


def formula(writer, node):
    r"""A formula as MathML, which browsers typeset without a script; its \tag stands at the right."""
    from docutils.nodes import SkipNode
    from latex2mathml.converter import convert

    block = node.tagname == "math_block"
    text, *tag = re.split(r"\\tag\{(.*?)\}", node.astext())
    shown = convert(text.replace("'", "′"), display="block" if block else "inline")  # no prime of a prime
    shown = re.sub(r"<mi>([a-z]{3,})</mi>", r'<mo form="prefix" lspace="0.17em" rspace="0.17em">\1</mo>', shown)
    number = f'<span class="eqno">({tag[0]})</span>' if tag else ""
    writer.body.append(f'<div class="formula">{shown}{number}</div>' if block else shown)
    raise SkipNode


def setup(app):
    """Connect these functions to Sphinx, that of docstrings before napoleon's."""
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
    app.connect("builder-inited", notebooks)
    app.connect("autodoc-process-docstring", sections, priority=1)
    app.connect("autodoc-process-signature", signed)
    app.connect("autodoc-skip-member", internal)
    app.connect("source-read", outside)
