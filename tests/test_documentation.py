"""The site has a place for everything."""

import ast
import inspect
import re
import subprocess
import sys
from operator import attrgetter
from pathlib import Path

import diffrax as dfx
import pytest
from documents import assert_printed, blocks_of, outputs_of, ROOT, run

import manifold_jax as mj


PAGES = ROOT / "docs" / "pages"
MESSAGES = (PAGES / "messages.md").read_text()


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


def docstrings_of(name):
    """Of a public name and of its members."""
    thing = attrgetter(name)(mj)
    members = [getattr(thing, x, None) for x in vars(thing)] if isinstance(thing, type) else ()
    return "\n".join(x.__doc__ or "" for x in (thing, *members))


def test_docstrings_have_no_control_characters_and_no_links():
    """As `\\b` and `\\t` of formulas become in strings that are not raw; links are for the site."""
    for name in public_names():
        assert re.findall(r"[\x00-\x09\x0b-\x1f\x7f].*|`\]\[.*", docstrings_of(name)) == [], name


def test_cross_references_of_docstrings_name_something_public():
    """By the anchors that docs/hooks.py sets."""
    anchors = set(public_names())
    anchors |= {f"mj.{name}" for name in anchors}
    for name in public_names():
        thing = attrgetter(name)(mj)
        near = {x.removeprefix("multibody.") for x in anchors if name.startswith("multibody.")}
        own = {f"{thing.__name__}.{x}" for x in vars(thing)} if isinstance(thing, type) else set()
        for target in re.findall(r"\[`([\w.]+)`\]\[\]", inspect.getsource(thing)):
            assert target in anchors | near | own, name


def texts_of_the_source():
    """Every string in the source; in place of what is filled in there is `...`."""
    for path in Path(mj.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                parts = [x.value if isinstance(x, ast.Constant) else "..." for x in node.values]
                yield "".join(parts)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield re.sub(r"\{\w*(:[^{}]*)?\}", "...", node.value)


def quoted_messages():
    """The first column of the tables of messages, without the backticks around it."""
    tables = re.split(r"^\| the message begins with .*\n\|[-|]+\n", MESSAGES, flags=re.MULTILINE)
    for table in tables[1:]:
        for row in re.match(r"(?:\|.*\n)*", table)[0].splitlines():
            yield re.fullmatch(r"\| (`+) ?(.+?) ?\1 \|.*", row)[2].removesuffix("...").rstrip()


def test_quoted_messages_begin_as_in_the_source():
    texts, quoted = tuple(texts_of_the_source()), list(quoted_messages())
    assert all(quoted)
    assert len(quoted) == len(set(quoted)) > 50
    assert [quote for quote in quoted if not any(x.startswith(quote) for x in texts)] == []


def test_result_codes_of_the_page_of_messages_are_those_of_diffrax():
    named = re.findall(r"^\| `RESULTS\.(\w+)` \|", MESSAGES, flags=re.MULTILINE)
    assert len(named) == 7
    assert [name for name in named if not hasattr(dfx.RESULTS, name)] == []
    explained = (PAGES / "how-to" / "failing-trajectories.md").read_text()
    assert [name for name in named if f"| `RESULTS.{name}` |" not in explained] == []


def test_signatures_of_the_site_are_those_of_the_classes(monkeypatch):
    """Those of classes whose `__init__` is generated are put together in docs/signatures.py."""
    griffe = pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(ROOT / "docs")
    extensions = griffe.load_extensions("signatures")
    options = dict(search_paths=[ROOT], allow_inspection=False, extensions=extensions)
    package = griffe.load("manifold_jax", resolve_aliases=True, **options)
    for name in public_names():
        thing = attrgetter(name)(mj)
        if thing is mj.Solution:  # made by solves
            continue
        if isinstance(thing, type) and not thing.__name__.startswith("Abstract"):
            shown = [p.name for p in package[name].all_members["__init__"].parameters]
            assert shown == ["self", *inspect.signature(thing).parameters], name


@pytest.mark.parametrize("page", ["questions", "messages", "glossary"])
def test_names_in_the_pages_of_help_exist(page):
    text = (PAGES / f"{page}.md").read_text()
    for module, prefix in ((mj, "mj"), (dfx, "dfx"), (dfx, "diffrax")):
        for name in re.findall(rf"\b{prefix}\.([A-Za-z]\w*(?:\.[A-Za-z]\w*)*)", text):
            attrgetter(name)(module)


def test_the_gallery_shows_every_problem():
    page = (PAGES / "gallery.md").read_text()
    for name in mj.problems.ALL | mj.problems.FURTHER:
        assert f"](gallery/{name}.png)" in page
        assert f"[`{name}`][" in page
        assert (PAGES / "gallery" / f"{name}.png").exists()


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
        printed = []
        run(*blocks_of(page), printed=printed)
        for number, shown in outputs_of(page).items():
            assert_printed(shown, printed[number])
