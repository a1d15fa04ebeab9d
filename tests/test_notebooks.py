"""The notebooks run from top to bottom, with the numbers that they assert; what they show is what is stored in them."""

import os
import re
import sys
from pathlib import Path

import pytest
from conftest import needs

for _module in ("nbformat", "nbclient", "ipykernel"):
    needs(_module)

import nbformat  # noqa: E402
from jupyter_client.kernelspec import KernelSpec, KernelSpecManager  # noqa: E402
from jupyter_client.manager import AsyncKernelManager  # noqa: E402
from jupyter_core.utils import run_sync  # noqa: E402
from nbclient import NotebookClient  # noqa: E402

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
NUMBER = re.compile(r"[-+]?(\d[\d.]*(e[-+]?\d+)?|nan|inf)\b")
ROUNDING = re.compile(r"\s*(nfev|iterations|pivot_changes|max / final)|.*(rank margins|largest residual)")
MOST_BYTES = 400_000  # of a notebook with its figures


class ThisInterpreter(KernelSpecManager):
    """Every kernel is the interpreter that runs the tests, whatever kernels the machine has."""

    def get_kernel_spec(self, kernel_name):
        argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=argv, display_name=kernel_name, language="python")


def cells(path, kind):
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == kind]


def shown(cell):
    """The texts of a cell's outputs, without numbers and what rounding orders, and how many figures it has."""
    texts = [o.text if o.output_type == "stream" else o.data.get("text/plain", "") for o in cell.outputs]
    pictures = [o for o in cell.outputs if "image/png" in o.get("data", {})]
    texts = [text for text, o in zip(texts, cell.outputs, strict=True) if o not in pictures]
    lines = [line for line in "".join(texts).splitlines() if line.strip() and not ROUNDING.match(line)]
    return [" ".join(NUMBER.sub("#", line).split()) for line in lines], len(pictures)


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 8


@pytest.fixture(scope="module")
def manager(tmp_path_factory):
    """The manager of one kernel for all notebooks: each of them would import the same packages again."""
    connection = {"connection_file": str(tmp_path_factory.mktemp("kernel") / "kernel.json")}
    manager = AsyncKernelManager(kernel_name="python3", kernel_spec_manager=ThisInterpreter(), **connection)
    yield manager
    run_sync(manager.shutdown_kernel)(now=True)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_its_numbers_hold(path, manager):
    notebook = nbformat.read(path, as_version=4)
    stored = [shown(cell) for cell in notebook.cells if cell.cell_type == "code"]
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))
    folder = {"metadata": {"path": str(path.parent)}}
    client = NotebookClient(notebook, km=manager, timeout=300, resources=folder)
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    client.execute(env={**os.environ, "PYTHONPATH": paths})
    _, *code = (cell for cell in notebook.cells if cell.cell_type == "code")
    assert all(cell.execution_count for cell in code)
    images = [o for cell in code for o in cell.outputs if "image/png" in o.get("data", {})]
    assert len(images) == sum("plt.show()" in cell.source for cell in code)
    assert [shown(cell) for cell in code] == stored


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_valid_asserts_its_numbers_and_has_its_outputs(path):
    nbformat.validate(nbformat.read(path, as_version=nbformat.NO_CONVERT))
    code, text = cells(path, "code"), cells(path, "markdown")
    assert sum("assert " in cell.source for cell in code) >= 4
    assert all(cell.execution_count for cell in code) and path.stat().st_size < MOST_BYTES
    assert not [o for cell in code for o in cell.outputs if o.output_type == "error" or o.get("name") == "stderr"]
    assert all("<table" in o.data["text/html"] for cell in code for o in cell.outputs if "text/html" in o.get("data", {}))
    assert text[0].source.startswith("# ") and code[0].outputs is not None
    ids = [cell.id for cell in (*code, *text)]
    assert len(ids) == len(set(ids))
