"""`python -m manifold_jax`: the command line."""

from ._cli import app


if __name__ == "__main__":
    app(prog_name="manifold-jax")
