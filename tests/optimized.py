"""How programs are compiled. The tests check numbers, not speed, and compiling is most of their
time: without optimization it takes a third. What depends on how XLA rounds does not show that way;
such tests compile as users do, with `optimized_jit`."""

import functools
import importlib.metadata

import jax


# Name, value for the tests, and what users have.
OPTIONS = {
    "xla_backend_optimization_level": (0, 3),
    "xla_llvm_disable_expensive_passes": (True, False),
    "xla_cpu_parallel_codegen_split_count": (1, 32),
    # Moving constants into and out of loops is an eighth of the time for the gradient of a robot.
    "xla_disable_hlo_passes": (
        "while-loop-invariant-code-motion,while-loop-constant-sinking,simplify-while-loops",
        "",
    ),
}
# Gone in later versions, where an unknown flag ends the process.
if tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:2])) < (0, 11):
    OPTIONS["xla_cpu_use_fusion_emitters"] = (False, True)

FAST_FLAGS = " ".join(f"--{name}={str(fast).lower()}" for name, (fast, _) in OPTIONS.items())
# For programs that run for as long as they compile: half of the time for compiling, nearly the speed.
MEDIUM_FLAGS = "--xla_backend_optimization_level=1"
if "xla_cpu_use_fusion_emitters" in OPTIONS:
    MEDIUM_FLAGS += " --xla_cpu_use_fusion_emitters=false"

optimized_jit = functools.partial(
    jax.jit, compiler_options={name: usual for name, (_, usual) in OPTIONS.items()}
)
# In between, at half of the time for compiling: XLA and LLVM optimize, but less than for users.
medium_jit = functools.partial(
    jax.jit,
    compiler_options={
        "xla_backend_optimization_level": 1,
        "xla_llvm_disable_expensive_passes": False,
    },
)
