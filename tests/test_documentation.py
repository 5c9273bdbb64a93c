"""The site has a place for everything."""

import re
from pathlib import Path

import pytest

import manifold_jax as mj


ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "pages"


def public_names():
    for module, prefix in ((mj, ""), (mj.problems, "problems.")):
        for name, x in vars(module).items():
            if not name.startswith("_") and getattr(x, "__module__", "").startswith("manifold_jax"):
                yield prefix + name


@pytest.fixture(scope="module")
def documented():
    text = "\n".join(path.read_text() for path in (PAGES / "api").glob("*.md"))
    return re.findall(r"^::: manifold_jax\.([\w.]+)$", text, flags=re.MULTILINE)


def test_every_public_name_is_documented_once(documented):
    assert sorted(documented) == sorted(public_names())


def test_every_notebook_is_a_page():
    navigation = (ROOT / "docs" / "mkdocs.yml").read_text()
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        assert f"- notebooks/{path.name}\n" in navigation
