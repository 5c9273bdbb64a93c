"""The command line, `manifold-jax` or `python -m manifold_jax`."""

import sys


_EXTRA = {"typer", "rich", "click"}


def main() -> None:
    try:
        from ._tools.cli import app
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in _EXTRA:
            raise
        sys.exit(
            f"The command line needs {error.name}, which is not installed: "
            '`pip install typer rich matplotlib`, or install `"manifold_jax[cli]"`.'
        )
    app(prog_name="manifold-jax")


if __name__ == "__main__":
    main()
