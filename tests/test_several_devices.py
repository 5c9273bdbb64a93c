"""Ensembles shared out among devices, and among processes."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import two_processes
from optimized import FAST_FLAGS


HERE = Path(__file__).parent


def start(arguments, flags=""):
    return subprocess.Popen(
        [sys.executable, *arguments],
        env=os.environ | {"XLA_FLAGS": f"{FAST_FLAGS} {flags}", "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.slow
def test_two_devices():
    file = HERE / "several_devices.py"
    process = start(
        ["-m", "pytest", "-q", "--numprocesses=0", str(file)],
        "--xla_force_host_platform_device_count=2",
    )
    out, _ = process.communicate(timeout=600)
    assert process.returncode == 0, out


def free_port():
    try:
        with socket.socket() as s:
            s.bind(("localhost", 0))
            return s.getsockname()[1]
    except OSError as error:
        pytest.skip(f"no local port: {error}")


@pytest.mark.slow
def test_two_processes():
    """Of one device each: `jax.distributed`."""
    port = str(free_port())
    processes = [start([two_processes.__file__, port, str(i)]) for i in range(2)]
    try:
        outs = [process.communicate(timeout=300)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, out in zip(processes, outs):
        assert process.returncode == 0, out
