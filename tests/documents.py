"""Code blocks of the README and the documentation, run as a reader would."""

import re
from pathlib import Path

import jax


ROOT = Path(__file__).parents[1]


def blocks_of(path):
    return re.findall(r"^```python\n(.*?)^```", path.read_text(), flags=re.DOTALL | re.MULTILINE)


def run(*blocks):
    """One after the other in one session, with JAX's own settings. What they define."""
    namespace = {}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for block in blocks:
            exec(compile(block, "example", "exec"), namespace)
    return namespace
