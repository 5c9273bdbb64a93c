"""What was compiled or exported once is not compiled again, as the README says."""

import json
import os
import subprocess
import sys

import pytest
import second_process


def run(cache, *arguments):
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    environment |= {
        "EQX_ON_ERROR": "nan",
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    out = subprocess.run(
        [sys.executable, second_process.__file__, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout) if out.stdout else None


def check(result):
    assert result["success"]
    assert abs(result["gradient"] + 2.12823553) < 1e-5  # the exact one


@pytest.mark.slow
def test_second_process_compiles_nothing(tmp_path):
    """Forward and gradient from the cache: tracing is what is left. Goal 3 s on a quiet machine."""
    first, second = run(tmp_path, "solve"), run(tmp_path, "solve")
    check(second)
    assert first["cache_misses"] > 0
    assert second["cache_misses"] == 0
    assert second["cache_hits"] >= first["cache_misses"]
    assert (second["value"], second["gradient"]) == (first["value"], first["gradient"])
    assert second["seconds"] < 8
    print(f"first {first['seconds']:.2f} s, second {second['seconds']:.2f} s")


@pytest.mark.slow
def test_exported_program_needs_no_tracing_either(tmp_path):
    """Through bytes on the disk, in a process without this library. Goal 0.7 s."""
    file = str(tmp_path / "pendulum.bin")
    run(tmp_path / "cache", "export", file)
    first, second = (run(tmp_path / "cache", "load", file) for _ in range(2))
    check(second)
    assert second["cache_misses"] == 0
    assert (second["value"], second["gradient"]) == (first["value"], first["gradient"])
    assert second["seconds"] < 3
    print(f"first {first['seconds']:.2f} s, second {second['seconds']:.2f} s")
