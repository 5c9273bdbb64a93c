"""Rules of the code that no linter checks."""

import ast
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import pytest

import manifold_jax as mj


PACKAGE = Path(mj.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
# Folders, lowest first; a file may import from its own folder or from one further up in this list.
LAYERS = [
    {"_base"},
    {"_jaxpr"},
    {"_linalg"},
    {"_linalg.sparse"},
    {"_constraint"},
    {"_rosenbrock"},
    {"_radau"},
    {"_solver.step"},
    {"_solver"},
    {"_resets"},
    {"_adjoint"},
    {"_solve"},
    {"_mechanics"},
    {"_applications", "_dae", "_ensemble.lanes", "_ensemble.stored", "_sympy"},
    {"_ensemble", "_ensemble.api"},
    {"_fit"},
    {"_manifolds", "_lie_groups"},
    {"_multibody"},
    {"multibody"},
    {"problems"},
    {"__init__"},
    {"_tools.compare"},
    {"_tools.animate", "_tools.certify"},
    {"_tools.cli"},
    {"_tools", "__main__"},
]


def layer_of(module):
    parts = (module or "__init__").split(".")
    if not (PACKAGE / parts[0]).is_dir() and not (PACKAGE / f"{parts[0]}.py").is_file():
        parts = ["__init__"]  # a name that the package itself defines
    names = [".".join(parts[:2]), parts[0]]
    return next(i for name in names for i, layer in enumerate(LAYERS) if name in layer)


def imports(path):
    """Names of the modules of this package that a file imports, relative to the package."""
    package = path.relative_to(PACKAGE).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level > 0:
            base = ".".join(package[: len(package) - node.level + 1])
            modules = [node.module] if node.module else [alias.name for alias in node.names]
            for module in modules:
                yield f"{base}.{module}".strip(".")
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("manifold_jax"):
            yield node.module.removeprefix("manifold_jax").lstrip(".") or "__init__"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    own = layer_of(".".join(path.relative_to(PACKAGE).with_suffix("").parts))
    for module in imports(path):
        assert layer_of(module) <= own, f"{path.name} imports {module}"


WATCHED = {"diffrax", "equinox", "jax", "jaxlib", "jaxtyping", "lineax", "optimistix"}
OF_NAMED_TUPLES = {"_asdict", "_fields", "_make", "_replace"}


def is_private(dotted):
    words = dotted.split(".")
    private = any(w.startswith("_") and not w.endswith("__") for w in words[1:])
    return words[0] in WATCHED and (private or words[:2] == ["equinox", "internal"])


def dotted_name(node, aliases):
    """What a chain of attributes stands for, as imported, e.g. `diffrax._term.WrapTerm`."""
    if isinstance(node, ast.Attribute):
        base = dotted_name(node.value, aliases)
        return None if base is None else f"{base}.{node.attr}"
    return aliases.get(node.id) if isinstance(node, ast.Name) else None


def private_names_of_others(tree, own):
    """Imported, through an alias, or as attributes; `own` are private names of this package."""
    nodes, aliases = list(ast.walk(tree)), {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                first = alias.name.split(".")[0]
                aliases[alias.asname or first] = alias.name if alias.asname else first
                yield from filter(is_private, [alias.name])
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            for alias in node.names:
                aliases[alias.asname or alias.name] = f"{node.module}.{alias.name}"
                yield from filter(is_private, [f"{node.module}.{alias.name}"])
    for node in nodes:
        if isinstance(node, ast.Attribute):
            yield from filter(is_private, [dotted_name(node, aliases) or ""])
            if node.attr.startswith("_") and not node.attr.endswith("__") and node.attr not in own:
                yield node.attr


def private_names_bound(tree):
    for node in ast.walk(tree):
        name = getattr(node, "name", None) or getattr(node, "id", None)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            name = node.attr
        if isinstance(name, str) and name.startswith("_"):
            yield name


def test_private_names_of_others_only_in_compat():
    trees = {path: ast.parse(path.read_text()) for path in FILES}
    own = OF_NAMED_TUPLES.union(*map(private_names_bound, trees.values()))
    for path, tree in trees.items():
        if path.name != "compat.py":
            assert not list(private_names_of_others(tree, own)), path


@pytest.mark.parametrize(
    "code",
    [
        "from diffrax._term import WrapTerm",
        "from diffrax import _term",
        "import diffrax._term",
        "import diffrax._term as terms",
        "import equinox.internal as eqxi",
        "from equinox import internal",
        "import diffrax as dfx; dfx._term.WrapTerm",
        "import diffrax; diffrax._term",
        "import equinox as eqx; eqx.internal.while_loop",
        "from jax._src import core",
        "import jax; jax._src.core",
        "result._value",
    ],
)
def test_private_names_are_seen(code):
    assert list(private_names_of_others(ast.parse(code), OF_NAMED_TUPLES))


def test_class_names_are_unique():
    """In the whole package, so that a name that is read in one file means the same in another."""
    found = {}
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(str(path.relative_to(PACKAGE)))
    assert not {name: files for name, files in found.items() if len(files) > 1}


# Bases of joints and drives that give fields or a common type, and nothing to implement.
WITHOUT_METHODS = {"AbstractRestraint", "AbstractJointWithAxis", "AbstractJointWithoutAxis"}


def is_abstract(cls):
    if cls.__name__ in WITHOUT_METHODS:
        return True
    names = ("__abstractmethods__", "__abstractvars__", "__abstractclassvars__")
    return any(getattr(cls, name, ()) for name in names)


def test_abstract_or_final():
    """Only abstract classes are subclassed (equinox, docs/pattern.md)."""

    def walk(cls):
        for sub in cls.__subclasses__():
            yield sub
            yield from walk(sub)

    ours = [cls for cls in set(walk(eqx.Module)) if cls.__module__.startswith("manifold_jax")]
    assert len(ours) >= 10
    for cls in ours:
        assert cls.__name__.lstrip("_").startswith("Abstract") == is_abstract(cls), cls
        for base in cls.__mro__[1:]:
            if base.__module__.startswith("manifold_jax"):
                assert is_abstract(base), f"{cls} subclasses {base}"


def test_importing_changes_nothing_in_jax():
    code = (
        "import jax; before = dict(jax.config.values); import manifold_jax; "
        "assert dict(jax.config.values) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_needs_no_extra():
    """Nor does anything that is not on the command line, draws nothing and writes no folder."""
    code = (
        "import sys, manifold_jax; "
        "assert not {'typer', 'rich', 'matplotlib', 'sympy', 'zarr'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_has_a_docstring():
    public = [
        x for x in vars(mj).values() if getattr(x, "__module__", "").startswith("manifold_jax")
    ]
    assert len(public) >= 9
    for x in public:
        # Dataclasses without one get their signature.
        doc = (x.__doc__ or "").strip()
        assert doc, x
        assert not doc.startswith(f"{getattr(x, '__name__', '')}("), x


EXTENSIONS = [path for path in FILES if path.parent.name in ("_manifolds", "_lie_groups")]


@pytest.mark.parametrize("path", EXTENSIONS, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_extensions_use_public_names_only(path):
    """They come with the package, but could be anybody's."""
    own = path.parent.name
    assert all(module.split(".")[0] in ("__init__", own) for module in imports(path)), path
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "mj":
            assert not node.attr.startswith("_")
            assert hasattr(mj, node.attr)


def test_the_core_knows_nothing_of_mechanics():
    below = set().union(*LAYERS[: next(i for i, s in enumerate(LAYERS) if "_mechanics" in s)])
    for path in FILES:
        if path.relative_to(PACKAGE).parts[0].removesuffix(".py") in below:
            assert not any(module.startswith("_mechanics") for module in imports(path)), path
