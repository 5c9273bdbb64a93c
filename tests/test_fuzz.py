"""The fuzz program sees what is wrong, and a slice of it finds nothing."""

import sys
from pathlib import Path

import numpy as np
import pytest


sys.path.append(str(Path(__file__).parents[1]))

from tests.fuzz import __main__ as fuzz, checks
from tests.fuzz.families import Quadrics
from tests.fuzz.lanes import amplification, draw, FAILING, reference_paths
from tests.fuzz.mechanics import Linkage, Rolling
from tests.fuzz.program import FRACTIONS
from tests.fuzz.reference import jacobian, violations
from tests.fuzz.structure import Structure, structure


DRAWS = 6


def plain_structure(family, **changes):
    fields = dict(
        index=0,
        seed=0,
        family=family,
        layout="vector",
        residual_layout="vector",
        solver="Tsit5",
        controller="pid",
        tolerance=1e-8,
        steps=50,
        first_step=False,
        output="ts",
        direction="mixed",
        approach="projected",
        failing="impossible",
        own_field=False,
        offset=False,
        single=False,
        reverse=None,
    )
    return Structure(**fields | changes)


def saved_value(lanes, paths):
    """What a faultless solve would return."""
    length = lanes["end"] - lanes["start"]
    states = np.swapaxes(paths(FRACTIONS), 0, 1).copy()
    times = lanes["start"][:, None] + length[:, None] * FRACTIONS
    code = np.zeros(len(length), int)
    return {"times": times, "states": states, "code": code, "num_steps": code + 20}


def faults(spoil):
    """Of a faultless batch that has been changed by `spoil(found, failed)`."""
    one = plain_structure(Quadrics(3, 1, True))
    lanes = draw(one, DRAWS)
    paths = reference_paths(one, lanes)
    judge = checks.judge(one, lanes, paths, amplification(one, lanes, paths))
    assert judge.trusted.all()
    found, failed = saved_value(lanes, paths), saved_value(lanes, paths)
    for each in (found, failed):  # the reference is good to twelve digits only
        y = each["states"].reshape(-1, 3)
        args = {name: np.repeat(value, len(FRACTIONS), 0) for name, value in lanes["args"].items()}
        t = each["times"].ravel()
        for _ in range(3):
            G = jacobian(one.family, t, y, args)[:, 0]
            r = one.family.residual(np, t, y, args)
            y = y - r * G / np.sum(G**2, axis=-1, keepdims=True)
        each["states"] = y.reshape(each["states"].shape)
    failed["code"][FAILING] = 4
    failed["states"][FAILING, 4:] = np.inf
    spoil(found, failed)
    out = checks.check_results(one, judge, found, failed)
    out += checks.check_other_lanes(found, failed)
    out += checks.check_violations(one, lanes, judge, found, failed)[0]
    out += checks.check_accuracy(one, lanes, judge, found)[0]
    return {fault.kind for fault in out}


def shift(name, index, change):
    def spoil(found, failed):
        for each in (found, failed):
            each[name][index] = each[name][index] + change

    return spoil


def test_a_faultless_batch_has_no_faults():
    assert faults(lambda found, failed: None) == set()


@pytest.mark.parametrize(
    ("kinds", "spoil"),
    [
        ({"violation"}, shift("states", (4, 2), 1e-12)),
        ({"violation", "error"}, shift("states", (4, 2), 1e-2)),
        ({"refused"}, shift("code", 3, 4)),
        ({"not finite"}, shift("states", (1, 3), np.nan)),
        ({"lanes"}, lambda found, failed: shift("states", (5, 1), 1e-16)(failed, failed)),
        ({"silent"}, lambda found, failed: shift("code", FAILING, -4)(failed, {"code": failed["code"].copy()})),
    ],
    ids=["off the manifold", "wrong", "refused", "NaN", "touched by another lane", "silent"],
)  # fmt: skip
def test_every_kind_of_fault_is_seen(kinds, spoil):
    assert kinds <= faults(spoil)


@pytest.mark.parametrize(
    ("later", "further", "seen"),
    [(0.0, 0.0, False), (1e-10, 1e-10, False), (0.0, 1e-10, True), (1e-7, 1e-7, True), (1e-10, 1e-9, True)],
    ids=["equal", "later on its way", "elsewhere", "far too late", "elsewhere, and later"],
)  # fmt: skip
def test_a_lane_alone_may_be_later_but_not_elsewhere(later, further, seen):
    """Of a state that moves with speed one."""
    times = np.linspace(0.0, 1.0, 5)
    found = {"times": times[None], "states": times[None, :, None], "num_steps": [4], "code": [0]}
    alone = {"times": times + later, "states": times[:, None] + further, "num_steps": 4, "code": 0}
    known = checks.Judge(None, np.ones(1), np.array([True]), np.ones(1), 0.0)
    one = plain_structure(Quadrics(3, 1, True))
    assert bool(checks.check_single(one, known, found, alone, 0)[0]) == seen


@pytest.mark.parametrize(
    "family",
    [
        Linkage("matrix", 2, (-1, 0, 0), True, False),
        Rolling("diagonal", 4, True),
    ],
    ids=["linkage", "rolling"],
)
def test_mechanics_of_the_reference_stays_on_its_manifold(family):
    """Jacobians, velocities and accelerations are written out by hand there."""
    one = plain_structure(family)
    lanes = draw(one, DRAWS)
    paths = reference_paths(one, lanes)
    for s, y in zip((0.0, 0.6, 1.0), paths(np.array([0.0, 0.6, 1.0]))):
        t = lanes["start"] + s * (lanes["end"] - lanes["start"])
        assert violations(family, t, y, lanes["args"]).max() < 1e-9


def cheap(one):
    return (
        one.family.n <= 6
        and one.reverse is None
        and one.solver in ("Tsit5", "Dopri5", "Bosh3", "Heun")
        and getattr(one.family, "mass", None) != "lagrangian"
    )


@pytest.mark.slow
def test_a_slice_finds_nothing():
    indices = [i for i in range(200) if cheap(structure(i, 1))][:6]
    for record in fuzz.run(indices, seed=1, draws=12, limit=300):
        assert record["faults"] == [], record["spec"]


@pytest.mark.slow
def test_reduced_equations_and_damaged_stores():
    for kind, index in (("dae", 1), ("store", 1)):
        (record,) = fuzz.run([index], seed=0, draws=12, limit=300, kind=kind)
        assert record["faults"] == [], record["spec"]
