import gc
import os
from pathlib import Path

import jax
import jaxtyping
import pytest
from optimized import FAST_FLAGS


# Read when JAX compiles for the first time.
os.environ.setdefault("XLA_FLAGS", FAST_FLAGS)
# Tracing makes many small objects that live long: a tenth of its time went into looking at them.
gc.set_threshold(200_000, 50, 100)

# XLA copies where each operation was written whenever it inlines a function: a tenth of its time for
# the gradient of a solve. In the environment, too, for the processes that tests start.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
jax.config.update("jax_traceback_in_locations_limit", 0)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

MAPPINGS = Path("/proc/self/maps")
MOST_MAPPINGS = 30_000


@pytest.fixture(autouse=True, scope="module")
def _bounded_memory():
    """Compiled programs of one file are of no use to the next, and there are many."""
    yield
    jax.clear_caches()


@pytest.fixture(autouse=True)
def _bounded_mappings():
    """Every compiled program takes memory mappings; Linux allows a process 65530 of them, and
    beyond that the compiler crashes."""
    yield
    if MAPPINGS.exists() and MAPPINGS.read_text().count("\n") > MOST_MAPPINGS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def traced_anew():
    """For tests that change a module: they use nothing that was traced before, and leave nothing."""
    jax.clear_caches()
    yield
    jax.clear_caches()


@pytest.fixture
def missing_entry(traced_anew, monkeypatch):
    """As if a rule of the walk through the constraint were wrong: equation 5 not known to depend on
    unknown 0."""
    from manifold_jax._linalg.sparse import structure  # not before the type checks are in place

    exact = structure.dependence

    def wrong(function, x):
        depends = exact(function, x).tolil()
        assert depends[5, 0]
        depends[5, 0] = False
        return depends.tocsr()

    monkeypatch.setattr(structure, "dependence", wrong)
    monkeypatch.setattr(structure, "_FOUND", {})


@pytest.fixture
def as_a_user_meets_it():
    """Without the runtime type checks of the tests, which would answer before the library."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True)
def _types_are_checked_in_the_default_run(request):
    """The long tests go through the same functions as the short ones, where every argument is
    checked; there the checks would only cost a fifth of the time."""
    if request.node.get_closest_marker("slow"):
        request.getfixturevalue("as_a_user_meets_it")
