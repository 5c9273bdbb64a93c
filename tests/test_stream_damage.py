"""Stored ensembles of which something is lost: it is named, and made again."""

import shutil
import subprocess
import sys

import pytest
from streamed import SIZE, stream
from test_stream import assert_same_files, ENVIRONMENT

import manifold_jax as mj


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("stream") / "whole"
    stream(out)
    return out


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def lose(file):
    file.unlink()


def cut(file):
    file.write_bytes(file.read_bytes()[:-7])


def empty(file):
    file.write_bytes(b"")


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


DAMAGES = [
    ("ys/0/c/1/0/0", lose, "missing"),
    ("ys/0/c/4/0/0", cut, "damaged"),
    ("ys/0/c/1/0/0", flip, "damaged"),
    ("ys/0/c/0/0/0", empty, "damaged"),
    ("result/c/2", lose, "missing"),
    ("result/c/2", flip, "damaged"),
    ("stats/num_steps/c/0", lose, "missing"),
    ("ts/c/3/0", flip, "damaged"),
    ("stats/zarr.json", lose, "missing"),
    ("ys/0/zarr.json", empty, "empty"),
    ("result/zarr.json", flip, "damaged"),
]


@pytest.mark.parametrize(("name", "damage", "what"), DAMAGES)
def test_what_is_lost_is_named_and_made_again(name, damage, what, whole, copy):
    damage(copy / name)
    with pytest.raises(ValueError, match=f"`{name}` is {what}.*`resume=True`"):
        mj.open_ensemble(copy)
    assert [fault.file for fault in mj.open_ensemble(copy, check=False).faults()] == [name]
    resumed = stream(copy, resume=True)
    assert resumed.finished == SIZE
    assert_same_files(whole, copy)


def test_trajectories_of_the_last_chunk(copy):
    lose(copy / "ys/0/c/4/0/0")
    with pytest.raises(ValueError, match=rf"\(trajectories from 256 to {SIZE - 1}\)"):
        mj.open_ensemble(copy)


def test_a_chunk_of_which_everything_is_lost(whole, copy):
    """Trajectories that are not there are no failures."""
    for file in list(copy.rglob("c/1")):
        shutil.rmtree(file) if file.is_dir() else file.unlink()
    stored = mj.open_ensemble(copy, check=False)
    assert (stored.finished, len(stored.faults())) == (SIZE - 64, 10)
    assert [number for number, _ in stored.failures()] == [200]
    with pytest.raises(ValueError, match=r"from 64 to 127.*and 5 files more"):
        mj.open_ensemble(copy)
    stream(copy, resume=True)
    assert_same_files(whole, copy)


@pytest.mark.parametrize(
    ("damage", "what"), [(empty, "empty"), (cut, "damaged"), (flip, "damaged")]
)
def test_a_description_that_is_lost(damage, what, copy):
    damage(copy / "zarr.json")
    for read in (mj.open_ensemble, lambda out: stream(out, resume=True)):
        with pytest.raises(ValueError, match=f"`zarr.json` is {what}.*another folder"):
            read(copy)


def test_two_writers(copy):
    """In another process; the lock of one that was killed does not count."""
    (copy / "writer.lock").write_text("process 1 on a machine of old")
    holds = (
        "import sys, time; from pathlib import Path\n"
        "from manifold_jax._ensemble.stored.lock import only_writer\n"
        "with only_writer(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", holds, str(copy)]
    with subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(BlockingIOError, match=f"is being written by process {other.pid} on"):
            stream(copy, resume=True)
        other.kill()
    assert (copy / "writer.lock").exists()
    assert stream(copy, resume=True).finished == SIZE
    assert not (copy / "writer.lock").exists()
