"""No input may crash the interpreter, or give two answers with two methods."""

import subprocess
import sys

import numpy as np
import pytest
from doses import draws
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_core.kalman import estimate, expected
from fusion_core.model import Measurement, State, Transition
from fusion_core.smoother import smooth

n, N, m = 3, 5, 2
GOOD = {
    "x": np.zeros(n),
    "P": np.eye(n),
    "F": np.eye(n),
    "Q": np.eye(n),
    "u": np.zeros(n),
    "z": np.zeros((N, m)),
    "H": np.eye(m, n),
    "R": np.eye(m),
    "used": np.ones(N, dtype=bool),
    "C": None,
    "reset": None,
}


def run(method="auto", **changed):
    a = {**GOOD, **changed}
    state, transition = State(a["x"], a["P"]), Transition(a["F"], a["Q"], a["u"], a["C"])
    measurement = Measurement(a["z"], a["H"], a["R"], a["used"])
    return estimate(state, transition, measurement, reset=a["reset"], method=method, keep_P=True)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("u", np.zeros((n, N)), r"u has shape \(3, 5\), \(3,\) or \(5, 3\) was expected for n = 3 states and N = 5"),
        ("u", np.zeros((N - 1, n)), r"u has shape \(4, 3\)"),
        ("u", np.zeros(n + 1), r"u has shape \(4,\)"),
        ("F", np.broadcast_to(np.eye(n), (N - 1, n, n)), r"F has shape \(4, 3, 3\)"),
        ("F", np.broadcast_to(np.eye(n), (1, n, n)), r"F has shape \(1, 3, 3\)"),
        ("F", np.full((n, n), np.nan), "F has NaN or infinity"),
        ("Q", np.zeros((n, n + 1)), r"Q has shape \(3, 4\)"),
        ("Q", np.triu(np.ones((n, n))), "Q is not symmetric"),
        ("Q", -np.eye(n), "Q has a variance below zero"),
        ("P", np.eye(n + 1), r"P has shape \(4, 4\)"),
        ("x", np.array([0.0, np.inf, 0.0]), "x has NaN or infinity"),
        ("x", np.empty(0), "x has no state"),
        ("R", np.eye(m + 1), r"R has shape \(3, 3\)"),
        ("R", np.zeros((m, m)), "R has a variance of zero"),
        ("H", np.eye(n, m), r"H has shape \(3, 2\)"),
        ("z", np.zeros(N), r"z has shape \(5,\), \(N, m\) was expected"),
        ("z", np.full((N, m), 1j), "z is of type complex128"),
        ("used", np.ones(N), "used is of type float64"),
        ("used", np.ones((m, N), dtype=bool), r"used has shape \(2, 5\)"),
        ("reset", np.ones(N, dtype=bool), r"reset has shape \(5,\)"),
        ("C", np.zeros((2, n + 1)), r"C has shape \(2, 4\)"),
        ("F", [[1.0, 0.0, 0.0], [0.0, 1.0]], "F is a list of unequal rows"),
        ("z", np.full((N, m), np.nan), "not a finite number after sample 0"),
    ],
)
@pytest.mark.parametrize("method", ["auto", "recursive", "plain"])
def test_what_does_not_fit_is_refused_by_name(method, name, value, says):
    with pytest.raises(ValueError, match=says):
        run(method, **{name: value})


def test_a_method_a_gate_and_a_number_of_steps_are_looked_at():
    with pytest.raises(ValueError, match="method is 'long'"):
        run("long")
    with pytest.raises(ValueError, match="steady gains need"):
        run("steady", used=np.arange(N) > 0)
    given = State(GOOD["x"], GOOD["P"]), Transition(*(GOOD[name] for name in "FQu"))
    measurement = Measurement(*(GOOD[name] for name in ("z", "H", "R", "used")))
    with pytest.raises(ValueError, match="gate is nan"):
        estimate(*given, measurement, gate=np.nan)
    with pytest.raises(ValueError, match=r"u has shape"):
        expected(np.zeros(n), Transition(np.eye(n), np.eye(n), np.zeros((4, n))), 5)
    with pytest.raises(ValueError, match="used has shape"):
        smooth(*given, measurement, run(z=np.zeros((4, m)), used=np.ones(4, dtype=bool)))


@pytest.mark.parametrize("method", ["auto", "recursive", "plain"])
def test_a_value_that_is_not_finite_is_told_by_its_sample(method):
    for name, array in (("u", np.zeros((N, n))), ("Q", np.stack([np.eye(n)] * N)), ("z", np.zeros((N, m)))):
        array[3] = np.nan
        with pytest.raises(ValueError, match="after sample 3"):
            run(method, **{name: array})


@pytest.mark.parametrize("method", ["auto", "recursive", "plain"])
def test_what_is_masked_in_z_is_not_used_and_a_mask_elsewhere_is_refused(method):
    z = np.ma.array(np.ones((N, m)), mask=np.zeros((N, m), dtype=bool))
    z[1:3, 0] = 1e6
    z[1:3, 0] = np.ma.masked
    used = ~np.ma.getmaskarray(z)
    expected_x = run(method, z=np.ones((N, m)), used=used).x
    np.testing.assert_array_equal(run(method, z=z).x, expected_x)
    np.testing.assert_array_equal(run(method, z=z, used=np.ones((N, m), dtype=bool)).x, expected_x)
    for name in ("x", "P", "F", "Q", "u", "H", "R", "used"):
        masked = np.ma.array(GOOD[name])
        np.testing.assert_array_equal(run(method, **{name: masked}).x, run(method).x)  # nothing is masked
        masked[0] = np.ma.masked
        with pytest.raises(ValueError, match=f"{name} has masked values"):
            run(method, **{name: masked})


CHILD = """
import sys
import numpy as np
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State, Transition

def shape(rng, *right):
    '''The right shape, mostly; else one with an axis changed, added, dropped or turned.'''
    if rng.random() > 0.04:
        return right
    kind = rng.integers(4)
    if kind == 0 and right:
        at = rng.integers(len(right))
        return (*right[:at], max(0, right[at] + rng.integers(-2, 3)), *right[at + 1 :])
    return ((rng.integers(3), *right), right[1:], right[::-1])[kind - 1]

def dress(rng, a):
    '''The same values as someone else would hold them.'''
    kind = rng.integers(12)
    if kind == 0:
        return np.asfortranarray(a)
    if kind == 1:
        return a.tolist()
    if kind == 2:
        a = a.copy(); a.flags.writeable = False; return a
    if kind == 3 and a.dtype != bool:
        return a.astype(rng.choice(["f4", ">f8", "i8", "O", "c16", "U8", "f2"]))
    if kind == 4:
        return np.repeat(a, 2, axis=0)[::2] if a.ndim else a
    if kind == 5 and a.size and rng.random() < 0.3 and a.dtype != bool:
        a = a.copy(); a.flat[rng.integers(a.size)] = rng.choice([np.nan, np.inf, -1.0, 2.0]); return a
    return a

def square(rng, n, lead):
    L = rng.normal(size=(*lead, n, n))
    return L @ np.swapaxes(L, -1, -2)

def case(seed):
    rng = np.random.default_rng(seed)
    N = int(rng.choice([0, 1, 2, 3, 17]))
    n, m = ((3, 2), (2, 1), (2, 0))[rng.integers(3)]  # few sizes: each is compiled
    lead = lambda: (N,) if rng.random() < 0.5 else ()
    F = np.clip(rng.normal(size=(*lead(), n, n)), -1, 1)
    R = square(rng, m, lead()) + np.eye(m) if rng.random() < 0.5 else np.broadcast_to(np.eye(m), (*lead(), m, m))
    used = rng.random(N if rng.random() < 0.5 else (N, m)) < rng.choice([0.0, 0.7, 1.1])
    parts = [rng.normal(size=n), square(rng, n, ()), F, square(rng, n, lead()), rng.normal(size=(*lead(), n)),
             rng.normal(size=(N, m)), rng.normal(size=(*lead(), m, n)), R, used]
    parts = [dress(rng, a if a.shape == (s := shape(rng, *a.shape)) else np.resize(a, s)) for a in parts]
    reset = rng.random(n) < 0.3 if rng.random() < 0.5 else None
    x, P, F, Q, u, z, H, R, used = parts
    return (State(x, P), Transition(F, Q, u), Measurement(z, H, R, used)), rng.choice([np.inf, 3.0]), reset

def outcome(args, gate, reset, method):
    try:
        return estimate(*args, gate=gate, reset=reset, method=method, keep_P=True)
    except ValueError as error:
        return str(error)

np.seterr(all="ignore")
agree = refused = 0
for seed in range(int(sys.argv[1]), int(sys.argv[2])):
    args, gate, reset = case(seed)
    steady, fast, plain = (outcome(args, gate, reset, method) for method in ("steady", "auto", "plain"))
    if seed % 2 and not (isinstance(steady, str) and "steady gains need" in steady):
        fast = steady
    if isinstance(fast, str) or isinstance(plain, str):
        assert isinstance(fast, str) and isinstance(plain, str), (seed, fast, plain)
        refused += 1
        continue
    nis = plain.nis[plain.dof > 0]
    if np.any(np.abs(nis - gate) < 1e-6):
        continue
    agree += 1
    for name in ("x", "sigma", "y", "white", "nis", "log_det", "dof", "used", "P"):
        a, b = getattr(fast, name), getattr(plain, name)
        assert a.shape == b.shape, (seed, name)
        scale = 1 + np.nanmax(np.abs(np.append(b, 0.0)))
        np.testing.assert_allclose(a / scale, b / scale, rtol=1e-6, atol=1e-6, err_msg=f"{seed} {name}")
    np.testing.assert_allclose(fast.state.P, plain.state.P, rtol=1e-6, atol=1e-6 * (1 + np.max(plain.state.P)))
print(agree, refused)
"""


def test_inputs_are_refused_or_mean_the_same_with_every_method():
    """In a process of its own, for a crash to be a failure of this test alone."""
    count = draws(500, 2000)
    done = subprocess.run([sys.executable, "-c", CHILD, "0", str(count)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    agree, refused = map(int, done.stdout.split())
    assert agree > 0.25 * count
    assert refused > 0.15 * count


@given(pattern=st.lists(st.lists(st.booleans(), min_size=m, max_size=m), min_size=1, max_size=30), full=st.booleans())
@settings(max_examples=40)
def test_a_component_that_is_not_used_is_no_part_of_its_sample(pattern, full):
    """Garbage in z there changes nothing, and the sample is what it is with H, R and z of the others alone."""
    used = np.array(pattern)
    rng = np.random.default_rng(len(used))
    R = np.array([[2.0, 0.9], [0.9, 1.0]]) if full else np.eye(m)
    H = rng.normal(size=(m, n))
    z = rng.normal(size=(len(used), m))
    state, step = State(np.zeros(n), np.eye(n)), Transition(0.9 * np.eye(n), np.eye(n), np.zeros(n))
    garbage = np.where(used, z, np.nan)
    whole = estimate(state, step, Measurement(garbage, H, R, used), gate=9.0)
    np.testing.assert_array_equal(whole.dof, used.sum(axis=1))
    likelihood = 0.0
    for k, some in enumerate(used):
        one = Measurement(z[k : k + 1, some], H[some], R[np.ix_(some, some)], np.ones(1, dtype=bool))
        alone = estimate(state, step, one)
        if some.any() and not whole.used[k]:
            assert alone.nis[0] > (9.0 if some.all() else 6.0)
            alone = estimate(state, step, Measurement(one.z, one.H, one.R, np.zeros(1, dtype=bool)))
        else:
            likelihood += alone.log_likelihood()
        np.testing.assert_allclose(whole.x[k], alone.x[0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(whole.sigma[k], alone.sigma[0], rtol=1e-9)
        state = alone.state
    assert whole.log_likelihood() == pytest.approx(likelihood)
