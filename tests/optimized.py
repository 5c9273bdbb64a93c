"""Compiled as users compile: what depends on how XLA rounds does not show without optimization, with
which the other tests run."""

import functools

import jax


optimized_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 3})
