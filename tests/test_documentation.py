"""The site has a place for everything."""

import ast
import re
import subprocess
import sys
from operator import attrgetter
from pathlib import Path

import pytest
from documents import blocks_of, ROOT, run

import manifold_jax as mj


PAGES = ROOT / "docs" / "pages"


def public_names():
    for module, prefix in ((mj, ""), (mj.problems, "problems."), (mj.multibody, "multibody.")):
        for name, x in vars(module).items():
            if not name.startswith("_") and getattr(x, "__module__", "").startswith("manifold_jax"):
                yield prefix + name


@pytest.fixture(scope="module")
def documented():
    text = "\n".join(path.read_text() for path in (PAGES / "api").glob("*.md"))
    found = re.findall(r"^::: manifold_jax\.([\w.]+)$", text, flags=re.MULTILINE)
    # Modules of the gallery have the names of their functions.
    return [re.sub(r"^problems\.(\w+)\.\1$", r"problems.\1", name) for name in found]


def test_every_public_name_is_documented_once(documented):
    assert sorted(documented) == sorted(public_names())


@pytest.mark.parametrize("interface", [mj, mj.multibody])
def test_no_module_takes_the_place_of_what_it_defines(interface):
    """`from ._fit import fit` is to the site what is in `_fit/fit.py`, not the function."""
    tree = ast.parse(Path(interface.__file__).read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            package = Path(mj.__file__).parent.joinpath(*node.module.split("."))
            assert not [a.name for a in node.names if (package / f"{a.name}.py").exists()]


def test_every_page_and_every_notebook_is_in_the_navigation():
    navigation = (ROOT / "docs" / "mkdocs.yml").read_text()
    pages = [path.relative_to(PAGES).as_posix() for path in PAGES.rglob("*.md")]
    notebooks = [f"notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.ipynb")]
    for page in pages + notebooks:
        assert f" {page}\n" in navigation


def test_cross_references_of_docstrings_name_something_public():
    """By the anchors that docs/hooks.py sets."""
    anchors = set(public_names())
    anchors |= {f"mj.{name}" for name in anchors}
    for name in public_names():
        thing = attrgetter(name)(mj)
        members = vars(thing).values() if isinstance(thing, type) else ()
        texts = [x.__doc__ or "" for x in (thing, *members)]
        near = {x.removeprefix("multibody.") for x in anchors if name.startswith("multibody.")}
        own = {f"{thing.__name__}.{x}" for x in vars(thing)} if isinstance(thing, type) else set()
        for target in re.findall(r"\[`([\w.]+)`\]\[\]", "\n".join(texts)):
            assert target in anchors | near | own, name


# The others compile for longer.
QUICK = {"failing-trajectories", "extending"}
# What is set before JAX and Equinox are imported.
ALONE = {"export", "single-precision"}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=() if page.stem in QUICK else pytest.mark.slow)
        for page in sorted(PAGES.rglob("*.md"))
        if blocks_of(page)
    ],
)
def test_examples_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch):
    """They assert by themselves what the text says."""
    monkeypatch.chdir(tmp_path)
    if page.stem in ALONE:
        script = "\n".join(blocks_of(page))
        subprocess.run([sys.executable, "-W", "error", "-c", script], check=True)
    else:
        run(*blocks_of(page))
