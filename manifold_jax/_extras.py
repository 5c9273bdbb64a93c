"""Packages that only an extra of this one installs."""

import importlib.util


def require(module: str, extra: str, what: str) -> None:
    """Raise with what to install where `module` is missing."""
    if importlib.util.find_spec(module) is None:
        raise ImportError(
            f"{what} needs {module}, which is not installed: `pip install {module}`, or install "
            f'`"manifold_jax[{extra}]"`.'
        )
