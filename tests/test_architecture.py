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
# Layers, lowest first; a file may import from its own layer or a lower one.
LAYERS = [
    {"_custom_types", "_compat", "_errors", "_user_function", "_rejection"},
    {"_linear", "_residual", "_projection", "_stability", "_directed_term", "_scalar"},
    {"_newton"},
    {"_correction"},
    {"_projection_info"},
    {"_constraint"},
    {"_constraint_checks"},
    {"_violation", "_diagnosis"},
    {"_project"},
    {"_chart", "_stabilization", "_interpolation"},
    {"_rosenbrock"},
    {"_tangent", "_solver"},
    {"_adjoint"},
    {"_solve"},
    {"_mechanics"},
    {"_applications", "_dae", "_ensemble"},
    {"_fit"},
    {"_manifolds", "_lie_groups"},
    {"_multibody"},
    {"multibody"},
    {"problems"},
    {"__init__"},
    {"_compare"},
    {"_certify"},
    {"_cli"},
    {"__main__"},
]


def layer_of(module):
    head = module.split(".")[0] or "__init__"
    if not (PACKAGE / head).is_dir() and not (PACKAGE / f"{head}.py").is_file():
        head = "__init__"  # a name that the package itself defines
    return next(i for i, layer in enumerate(LAYERS) if head in layer)


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


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_private_names_of_others_only_in_compat(path):
    if path.name == "_compat.py":
        return
    for node in ast.walk(ast.parse(path.read_text())):
        module = getattr(node, "module", None) or ""
        assert not module.startswith(("diffrax._", "equinox._", "equinox.internal", "jax._src"))


def test_abstract_or_final():
    """Only abstract classes are subclassed (equinox, docs/pattern.md)."""

    def walk(cls):
        for sub in cls.__subclasses__():
            yield sub
            yield from walk(sub)

    ours = [cls for cls in set(walk(eqx.Module)) if cls.__module__.startswith("manifold_jax")]
    assert len(ours) >= 10
    for cls in ours:
        for base in cls.__mro__[1:]:
            if base.__module__.startswith("manifold_jax"):
                assert base.__name__.startswith("Abstract"), f"{cls} subclasses {base}"


def test_importing_changes_nothing_in_jax():
    code = (
        "import jax; before = dict(jax.config.values); import manifold_jax; "
        "assert dict(jax.config.values) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_has_a_docstring():
    public = [
        x for x in vars(mj).values() if getattr(x, "__module__", "").startswith("manifold_jax")
    ]
    assert len(public) >= 9
    for x in public:
        assert (x.__doc__ or "").strip(), x


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
