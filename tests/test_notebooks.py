"""The notebooks run from top to bottom, with the numbers that they assert, and are stored without outputs."""

import os
import sys
from pathlib import Path

import nbformat
import pytest
from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


class ThisInterpreter(KernelSpecManager):
    """Every kernel is the interpreter that runs the tests, whatever kernels the machine has."""

    def get_kernel_spec(self, kernel_name):
        argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=argv, display_name=kernel_name, language="python")


def cells(path, kind):
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == kind]


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_its_numbers_hold(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    connection = {"connection_file": str(tmp_path / "kernel.json")}
    manager = AsyncKernelManager(kernel_name="python3", kernel_spec_manager=ThisInterpreter(), **connection)
    folder = {"metadata": {"path": str(path.parent)}}
    client = NotebookClient(notebook, km=manager, timeout=300, resources=folder)
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    client.execute(env={**os.environ, "PYTHONPATH": paths})
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code)
    images = [o for cell in code for o in cell.outputs if "image/png" in o.get("data", {})]
    assert len(images) == sum("plt.show()" in cell.source for cell in code)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_valid_asserts_its_numbers_and_is_stored_without_outputs(path):
    nbformat.validate(nbformat.read(path, as_version=nbformat.NO_CONVERT))
    code = cells(path, "code")
    assert sum("assert " in cell.source for cell in code) >= 4
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    ids = [cell.id for kind in ("code", "markdown") for cell in cells(path, kind)]
    assert len(ids) == len(set(ids))
