"""The notebooks run from top to bottom, and are kept with what they show."""

from pathlib import Path

import nbclient
import nbformat
import pytest
from optimized import MEDIUM_FLAGS


NOTEBOOKS = sorted(Path(__file__).parents[1].glob("notebooks/*.ipynb"))

# They compile for long and run shortly, so that the flags of the tests, without optimization, take half the time.
COMPILED_FOR_LONG = ("08_from", "13_from", "14_the", "16_a")

# They run for long, too: the flags between those of the tests and those of a reader.
COMPILED_AND_RUN_FOR_LONG = ("04", "05", "06", "07", "09", "10", "11", "12", "15")

# Numbers of repetitions, and what suffices to see that they work.
FEWER = {
    "04": {"20_000": "6_000"},
    "06": {"range(5000)": "range(300)"},
    "10": {"size=199": "size=39", "(200, 10)": "(40, 10)", "records[:20]": "records[:5]"},
    "12": {"satellites, readings, degree, every = 200": "satellites, readings, degree, every = 60"},
}

notebooks = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_there_are_notebooks():
    assert NOTEBOOKS


@notebooks
def test_is_short_and_saved_with_its_output(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < 200_000
    assert 6 <= len(notebook.cells) <= 12
    first, *_, last = notebook.cells
    assert first.cell_type == "markdown"
    assert first.source.startswith("# ")
    assert last.cell_type == "markdown"
    assert "**What to remember:**" in last.source

    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert "jax_enable_x64" in code[0].source
    outputs = [output for cell in code for output in cell.outputs]
    assert {output.output_type for output in outputs} <= {"stream", "display_data"}
    assert all(output.name == "stdout" for output in outputs if output.output_type == "stream")
    assert any("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.slow
@notebooks
def test_runs_in_a_fresh_kernel(path, tmp_path, monkeypatch):
    # The others as a reader runs them.
    if path.stem.startswith(COMPILED_AND_RUN_FOR_LONG):
        monkeypatch.setenv("XLA_FLAGS", MEDIUM_FLAGS)
    elif not path.stem.startswith(COMPILED_FOR_LONG):
        monkeypatch.delenv("XLA_FLAGS", raising=False)
    notebook = nbformat.read(path, as_version=4)
    for usual, fewer in FEWER.get(path.stem[:2], {}).items():
        (cell,) = (cell for cell in notebook.cells if usual in cell.source)
        cell.source = cell.source.replace(usual, fewer)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output.text for output in outputs if output.get("name") == "stderr"]
