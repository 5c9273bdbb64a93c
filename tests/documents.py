"""Code blocks of the README and the documentation, run as a reader would."""

import contextlib
import io
import re
from decimal import Decimal
from pathlib import Path

import jax


ROOT = Path(__file__).parents[1]


def blocks_of(path):
    return re.findall(r"^```python\n(.*?)^```", path.read_text(), flags=re.DOTALL | re.MULTILINE)


def run(*blocks, printed=None):
    """One after the other in one session, with JAX's own settings. What they define; what each prints is appended to
    `printed`."""
    namespace = {}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for block in blocks:
            with contextlib.redirect_stdout(io.StringIO()) as output:
                exec(compile(block, "example", "exec"), namespace)
            if printed is not None:
                printed.append(output.getvalue())
    return namespace


def outputs_of(path):
    """What a page says that its blocks print: the block of text after one of Python, by the number of that."""
    shown, count = {}, -1
    blocks = re.findall(r"^```(\w+)\n(.*?)^```", path.read_text(), flags=re.DOTALL | re.MULTILINE)
    for language, block in blocks:
        count += language == "python"
        if language == "text":
            assert shown.setdefault(count, block) is block
    return shown


_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def assert_printed(shown, printed):
    """The same words, and the same numbers, of which the last digit shown may be another one by one."""
    assert _NUMBER.sub("#", shown).split() == _NUMBER.sub("#", printed).split(), printed
    for here, there in zip(_NUMBER.findall(shown), _NUMBER.findall(printed)):
        assert abs(Decimal(here) - Decimal(there)) <= Decimal(
            (0, (1,), Decimal(here).as_tuple().exponent)
        ), (here, there)
