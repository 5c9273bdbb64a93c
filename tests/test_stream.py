"""Ensembles on the disk: what is there, and that an interruption leaves no trace."""

import builtins
import errno
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import streamed
import zarr
from streamed import BROKEN, CHUNK, FAST, SIZE, stream
from test_cli import run, unframed

import manifold_jax as mj


# The same package in other processes, installed or not.
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(mj.__file__).parents[1])}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run without interruption."""
    out = tmp_path_factory.mktemp("stream") / "whole"
    stream(out)
    return out


def contents(folder):
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def assert_same_files(a, b):
    a, b = contents(a), contents(b)
    assert list(sorted(a)) == list(sorted(b))
    assert [name for name in a if a[name] != b[name]] == []


def test_each_trajectory_is_what_it_is_in_one_ensemble(whole):
    """Also in the last chunk, which is filled up; from the index and the key alone."""
    stored = mj.open_ensemble(whole)
    index = jnp.arange(SIZE)
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(3), i))(index)
    y0s, args = jax.vmap(streamed.sample)(index, keys)
    sol = mj.solve_ensemble(
        streamed.TURN,
        mj.Projected(dfx.Heun(), streamed.CIRCLE),
        0.0,
        jax.vmap(streamed.end)(index, keys),
        None,
        y0s,
        args | {"radius": streamed.RADIUS},
        args_axes={"rate": 0, "radius": None},
        saveat=dfx.SaveAt(ts=jnp.array([0.25, 1.0]), t1=True),
        stepsize_controller=dfx.PIDController(rtol=1e-4, atol=1e-4),
        max_steps=500,
        lanes=16,
    )
    np.testing.assert_allclose(stored.ts[:], sol.ts, rtol=0, atol=1e-14)
    np.testing.assert_allclose(stored.ys["0"][:], sol.ys[0], rtol=0, atol=1e-12)
    assert sorted(stored.stats) == sorted(sol.stats)
    np.testing.assert_array_equal(stored.stats["num_steps"][:], sol.stats["num_steps"])
    np.testing.assert_array_equal(stored.result[:] != 0, sol.failed)
    assert stored.failures() == sol.failures()


def test_failures_by_number_and_reason(whole):
    stored = mj.open_ensemble(whole)
    assert [number for number, _ in stored.failures()] == [BROKEN, FAST]
    assert len(stored.failures(1)) == 1
    reasons = stored.failures_by_reason()
    steps = next(reason for reason in reasons if "maximum number of solver steps" in reason)
    assert reasons.pop(steps) == (1, [FAST])
    assert list(reasons.values()) == [(1, [BROKEN])]
    assert (stored.size, stored.chunk, stored.finished) == (SIZE, CHUNK, SIZE)
    assert repr(stored).startswith(f"StoredEnsemble({SIZE} of {SIZE} trajectories")


def test_settings_are_json_in_the_folder(whole):
    settings = json.loads((whole / "zarr.json").read_text())["attributes"]["settings"]
    assert settings == mj.open_ensemble(whole).settings
    assert (settings["size"], settings["chunk"], settings["lanes"]) == (SIZE, CHUNK, 16)
    assert "rtol=0.0001" in settings["stepsize_controller"]
    assert "Heun" in settings["solver"]
    assert settings["version of jax"] == jax.__version__
    assert not re.search("0x[0-9a-f]{6}", json.dumps({**settings, "program": ""}))


def test_a_killed_run_is_continued_bit_by_bit(whole, tmp_path):
    """`kill -9` between two arrays of a chunk, in a process of its own."""
    out = tmp_path / "killed"
    child = subprocess.run(
        [sys.executable, streamed.__file__, str(out)], env=ENVIRONMENT, check=False
    )
    assert child.returncode == -signal.SIGKILL
    assert len(list(out.rglob("c/2"))) == 3  # the chunk is not finished
    assert len(list(out.rglob("c/1"))) == 10
    partial = out / f"result/c/2.{32 * 'a'}.partial"
    partial.write_bytes(b"half a file")
    other = out / "notes.partial"
    other.write_text("not ours")
    stored = mj.open_ensemble(out)
    assert stored.finished == 2 * CHUNK
    assert set(stored.result[2 * CHUNK :]) == {-1}
    resumed = stream(out, resume=True)
    assert resumed.finished == SIZE
    assert other.exists()
    other.unlink()
    assert_same_files(whole, out)


def test_a_run_killed_at_its_beginning(whole, tmp_path):
    """Before there are arrays, and before there are settings."""
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    shutil.copy(whole / "zarr.json", first)
    assert mj.open_ensemble(first).finished == 0
    assert mj.open_ensemble(first).failures() == []
    second.mkdir()
    (second / f"zarr.{32 * 'b'}.partial").write_text("{")
    for out in (first, second):
        stream(out, resume=True)
        assert_same_files(whole, out)


def test_what_is_finished_is_not_computed_again(whole, monkeypatch, tmp_path):
    def refuse(*args):
        raise AssertionError("computed again")

    monkeypatch.setattr(sys.modules["manifold_jax._ensemble.api.stream_ensemble"], "write", refuse)
    before = contents(whole)
    for function in (streamed.sample, same):  # whatever they are called
        stream(whole, resume=True, sample=function)
        assert contents(whole) == before


def another(index, key):
    return streamed.sample(index + 1, key)


def same(index, key):
    return streamed.sample(index, key)


another.__qualname__ = another.__name__ = "sample"  # not seen by its name
OTHER_SETTINGS = {
    "`size` was 300 and is 301": dict(size=301),
    "`chunk` was 64 and is 32": dict(chunk=32),
    "`seed` was 3 and is 4": dict(seed=4),
    "`lanes` was 16 and is 8": dict(lanes=8),
    "`t1` was .* and is 2.0": dict(t1=2.0),
    "`stepsize_controller` was .*rtol=0.0001.* and is .*rtol=0.001": dict(
        stepsize_controller=dfx.PIDController(rtol=1e-3, atol=1e-4)
    ),
    "`solver` was .*Heun.* and is .*Bosh3": dict(solver=mj.Projected(dfx.Bosh3(), streamed.CIRCLE)),
    "`terms`, the constraint or `sample` differ": dict(sample=another),
}


@pytest.mark.parametrize("message", OTHER_SETTINGS)
def test_other_settings_are_refused(message, whole):
    before = contents(whole)
    with pytest.raises(ValueError, match=message):
        stream(whole, resume=True, **OTHER_SETTINGS[message])
    assert contents(whole) == before


@pytest.mark.slow
def test_arrays_in_functions_are_settings(tmp_path):
    """Also those that are inputs of the compiled program, not part of it."""

    class Sample(eqx.Module):
        radius: jax.Array

        def __call__(self, index, key):
            return streamed.sample(index, key)[0], {"rate": jnp.ones(()), "radius": self.radius}

    options = dict(size=3, max_steps=5)
    stream(tmp_path / "out", sample=Sample(jnp.asarray(2.0)), **options)
    stream(tmp_path / "out", sample=Sample(jnp.asarray(2.0)), resume=True, **options)
    with pytest.raises(ValueError, match="`terms`, the constraint or `sample` differ"):
        stream(tmp_path / "out", sample=Sample(jnp.asarray(2.5)), resume=True, **options)


def test_folders_that_are_not_empty_are_refused(whole, tmp_path):
    with pytest.raises(FileExistsError, match=r"is not empty.*`resume=True`"):
        stream(whole)
    (tmp_path / "letter.txt").write_text("Dear")
    with pytest.raises(FileExistsError, match="holds no ensemble"):
        stream(tmp_path, resume=True)
    zarr.create_group(tmp_path)
    with pytest.raises(FileExistsError, match="holds no ensemble"):
        stream(tmp_path, resume=True)
    with pytest.raises(FileNotFoundError, match="has no ensemble"):
        mj.open_ensemble(tmp_path)
    with pytest.raises(FileNotFoundError, match="has no ensemble"):
        mj.open_ensemble(tmp_path / "nowhere")


def test_a_full_disk(whole, tmp_path, monkeypatch):
    """Stands for it: the largest size of a file that the system allows this process."""
    out = tmp_path / "full"
    largest = max(len(x) for name, x in contents(whole).items() if name.startswith("ys/0/c/"))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    create = sys.modules["manifold_jax._ensemble.api.stream_ensemble"].create_arrays

    def then_full(*args):
        create(*args)
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest - 200, hard))

    monkeypatch.setattr(
        sys.modules["manifold_jax._ensemble.api.stream_ensemble"], "create_arrays", then_full
    )
    try:
        with pytest.raises(OSError, match=r"cannot write to `path=.*go on with `resume=True`") as e:
            stream(out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old)
    assert e.value.errno == errno.EFBIG
    monkeypatch.undo()
    stream(out, resume=True)
    assert_same_files(whole, out)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OSError, match=r"cannot write to `path="):
            stream(out)


def test_without_zarr(monkeypatch, tmp_path):
    real = builtins.__import__

    def missing(name, *args):
        if name == "zarr":
            raise ImportError(name)
        return real(name, *args)

    monkeypatch.setattr(builtins, "__import__", missing)
    for call in (stream, mj.open_ensemble):
        with pytest.raises(ImportError, match=r"pip install zarr.*manifold_jax\[ensemble\]"):
            call(tmp_path / "out")
    assert not (tmp_path / "out").exists()


BAD_ARGUMENTS = {
    "`size` must be a positive integer, .* got 0": dict(size=0),
    "`size` must be a positive integer, .* got 2.5": dict(size=2.5),
    "`size` must be a positive integer, .* got True": dict(size=True),
    "`size` must be a positive integer, .* got 4294967296": dict(size=2**32),
    "`chunk` must be a positive integer, .* got 0": dict(chunk=0),
    "`lanes` must be a positive integer": dict(lanes=0),
    "`seed` must be an integer": dict(seed=0.5),
    "`sample` must be a function": dict(sample=jnp.ones((3, 2))),
    "`sample.*` must return the pair .* got Array|got .*Tracer": dict(
        sample=lambda index, key: jnp.ones(2)
    ),
    "got tuple of length 3": dict(sample=lambda index, key: (index, key, 1)),
    "`t1` must be one number, or a function": dict(t1=jnp.ones(3)),
    "'ys/a/b c/0' cannot be the name": dict(
        saveat=dfx.SaveAt(t1=True, fn=lambda t, y, args: {"a/b c": y})
    ),
}


@pytest.mark.usefixtures("as_a_user_meets_it")
@pytest.mark.parametrize("message", BAD_ARGUMENTS)
def test_bad_arguments(message, tmp_path):
    with pytest.raises((TypeError, ValueError), match=message):
        stream(tmp_path / "out", **BAD_ARGUMENTS[message])
    assert not (tmp_path / "out").exists()


def test_progress(tmp_path, capsys):
    stream(tmp_path / "out", progress=True, size=100)
    out = capsys.readouterr().out
    assert "ensemble: compiling" in out
    assert re.search(r"ensemble: 100 of 100, \d+/s, 1 failed", out)


# The command line

PENDULUM = ["ensemble", "pendulum", "--size", 100, "--t1", 0.5, "--solver", "heun", "--chunk", 64]


def test_command(tmp_path):
    """Kepler's problem, whose invariants are those of each trajectory."""
    out = tmp_path / "orbits"
    arguments = ["ensemble", "kepler", "--size", 100, "--chunk", 64, "--t1", 2, "--solver", "bosh3"]
    arguments += ["--vary", "args.eccentricity=uniform(0.1,0.5)", "--out", out]
    arguments += ["--vary", "y0.0.1 = normal(0, 1e-3)"]
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    assert re.search(r"failed: +0\n", result.stdout)
    assert "args.eccentricity=uniform(0.1, 0.5)" in result.stdout
    stored = mj.open_ensemble(out)
    ys = stored.ys
    assert float(re.search(r"violation: +(\S+) at most", result.stdout)[1]) < 1e-14
    assert ys["violation"][:].max() < 1e-14
    steps = stored.stats["num_steps"][:]
    assert f"steps:        {steps.sum()} in all" in result.stdout
    e, height = (ys[f"varied/{name}"][:].ravel() for name in ("args.eccentricity", "y0.0.1"))
    assert 0.1 < e.min() < 0.15 < 0.45 < e.max() < 0.5
    assert 5e-4 < height.std() < 2e-3
    q, v = ys["y/0"][:, 0], ys["y/1"][:, 0]
    energy = np.sum(v**2, 1) / 2 - 1 / np.linalg.norm(q, axis=1)
    start = (1 + e) / (1 - e) / 2 - 1 / np.hypot(1 - e, height)
    np.testing.assert_allclose(energy, start, rtol=0, atol=1e-13)
    again = run(*arguments, "--resume")
    assert "(100 were there)" in again.stdout
    other = run(*arguments[:-1], "y0.0.1=normal(0,0.5)", "--resume")
    assert other.exit_code == 2
    assert "y0.0.1=normal(0.0, 0.001)" in unframed(other.output)
    assert "y0.0.1=normal(0.0, 0.5)" in unframed(other.output)


@pytest.mark.slow
def test_command_for_a_problem_with_resets(tmp_path):
    """Each trajectory switches at the times of its own parameters."""
    arguments = ["--size", 20, "--t1", 5, "--rtol", 1e-9, "--atol", 1e-9, "--out", tmp_path / "out"]
    result = run("ensemble", "relay-feedback", "--vary", "args.lead=uniform(1.5,2)", *arguments)
    assert result.exit_code == 0, result.output
    ys = mj.open_ensemble(tmp_path / "out").ys
    problem = mj.problems.relay_feedback()
    for i, lead in enumerate(ys["varied/args.lead"][:].ravel()):
        known = problem.with_args(problem.args._replace(lead=lead)).reference(5.0)
        for k in range(3):
            np.testing.assert_allclose(ys[f"y/{k}"][i, 0], known[k], atol=1e-7)


@pytest.mark.slow
def test_command_reports_failures(tmp_path):
    """Of starts so far away that their squares are infinite."""
    arguments = [*PENDULUM, "--vary", "args.gravity=uniform(9,10)", "--vary"]
    result = run(*arguments, "y0.0.0=normal(1e300,1e300)", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "failed:       100" in result.stdout
    assert "100 (numbers 0, 1, 2, ...)" in result.stdout


GOOD = "args.length=uniform(0.5,2)"
MISTAKES = {
    "no number of `pendulum` 'args.lenght'. Choose one of: args.gravity, args.length": [
        "args.lenght=uniform(0,1)"
    ],
    "Choose one of: uniform, normal, loguniform": ["args.length=gamma(0,1)"],
    "is not of the form": ["args.length=2"],
    "needs low < high": ["args.length=uniform(2,1)"],
    "`args.length` is a length. Write": ["args.length=uniform(-2,-1)"],
    "needs std > 0": ["args.length=normal(2,0)"],
    "needs 0 < low < high": ["args.length=loguniform(0,1)"],
    "uniform(low, high) needs": ["args.length=uniform(a,1)"],
    "'args.length' is varied twice": [GOOD, GOOD],
    "Missing option '--vary'": [],
}


@pytest.mark.parametrize("message", MISTAKES)
def test_mistakes_of_what_to_vary(message, tmp_path):
    vary = [word for text in MISTAKES[message] for word in ("--vary", text)]
    result = run(*PENDULUM, *vary, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert message in unframed(result.output), result.output
    assert not (tmp_path / "out").exists()


def test_other_mistakes(whole, tmp_path):
    def message(*arguments, problem="pendulum"):
        result = run("ensemble", problem, "--vary", GOOD, *arguments)
        assert result.exit_code == 2
        return unframed(result.output)

    size = ["--size", 100, "--t1", 0.5]
    assert "'--size': Input should be greater" in message("--size", 0, "--out", tmp_path / "a")
    assert "'--chunk': Input should be greater" in message(
        *size, "--chunk", 0, "--out", tmp_path / "a"
    )
    assert "no problem 'pendulm'" in message(*size, "--out", tmp_path, problem="pendulm")
    assert "`--resume` to continue" in message(*size, "--out", whole)
    assert "other settings" in message(*size, "--out", whole, "--resume")
    (tmp_path / "file").write_text("")
    assert "cannot write to" in message(*size, "--out", tmp_path / "file" / "below")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads /proc/self/status")
def test_memory_does_not_grow_with_the_size(tmp_path):
    code = (
        "import sys, diffrax, numpy, streamed\n"
        "many = diffrax.SaveAt(ts=numpy.linspace(0, 1, 150))\n"
        "streamed.stream(sys.argv[1], int(sys.argv[2]), chunk=2048, lanes=128, saveat=many)\n"
        # Not `ru_maxrss`, which begins with what the process of the tests had when it made this one.
        "print(next(line.split()[1] for line in open('/proc/self/status') if 'VmHWM' in line))"
    )

    def peak(size):
        arguments = [sys.executable, "-c", code, str(tmp_path / str(size)), str(size)]
        child = subprocess.run(
            arguments,
            capture_output=True,
            text=True,
            check=True,
            cwd=Path(streamed.__file__).parent,
            env=ENVIRONMENT,
        )
        return int(child.stdout) / 1024

    small, large = peak(4096), peak(40_000)
    print(f"{small:.0f} MiB, {large:.0f} MiB")
    # Of 40 000 trajectories values and times are 69 MiB.
    assert large < small + 12
