"""Without the packages of the extra `cli`: what is missing is said, and nothing else needs it."""

import sys

import pytest

from manifold_jax import __main__ as command_line
from manifold_jax._base.extras import require
from manifold_jax._ensemble.api.progress import ChunkMeter


@pytest.fixture
def without(monkeypatch):
    def hide(*names):
        for name in list(sys.modules):
            if name.split(".")[0] in names or name.startswith("manifold_jax._tools.cli"):
                monkeypatch.delitem(sys.modules, name)
        for name in names:
            monkeypatch.setitem(sys.modules, name, None)

    return hide


@pytest.mark.parametrize("missing", ["typer", "rich"])
def test_command_line_says_what_to_install(without, missing):
    without(missing)
    with pytest.raises(SystemExit, match=rf'needs {missing}.*"manifold_jax\[cli\]"'):
        command_line.main()


def test_pictures_say_what_to_install(without):
    without("matplotlib")
    with pytest.raises(ImportError, match=r'`plot` needs matplotlib.*"manifold_jax\[cli\]"'):
        require("matplotlib", "cli", "`plot`")


def test_progress_without_rich_is_lines(without, capsys, monkeypatch):
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    without("rich")
    with ChunkMeter(10, 0, 0, True) as meter:
        meter.compiling()
        meter.advance(10, 0)
    assert capsys.readouterr().out.splitlines()[0] == "ensemble: compiling"
