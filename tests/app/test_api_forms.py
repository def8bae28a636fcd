"""Arguments of the API that are of no form that they can have: one error that names the argument."""

import inspect

import numpy as np
import pytest

import driftlab
from driftlab.errors import FusionError

FUNCTIONS = [getattr(driftlab, name) for name in driftlab.__all__ if inspect.isfunction(getattr(driftlab, name))]
STRANGE = [object(), b"x", 3.5j, [object()], {1: 2}, (None,), np.zeros(3), "\0", lambda: 1, -1, 10**5000]
GIVEN = {"config": "map.yaml", "configs": ["a.yaml", "b.yaml"], "what": "map.yaml", "file": "a.h5", "kind": "px4"}
GIVEN["logs"] = ["a.ulg"]
GIVEN |= dict.fromkeys(("out", "units", "calibration", "train", "holdout"), "none")


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
@pytest.mark.parametrize("strange", STRANGE, ids=lambda strange: type(strange).__name__)
def test_an_argument_of_no_form_is_refused_by_name(function, strange, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parameters = inspect.signature(function).parameters.values()
    needed = {one.name: GIVEN[one.name] for one in parameters if one.default is one.empty}
    for one in parameters:
        with pytest.raises(FusionError):
            function(**needed | {one.name: strange})


def test_the_error_says_what_is_given_and_what_could_be():
    with pytest.raises(FusionError, match=r"^out: is 3, of type int; give a text or a path or None$"):
        driftlab.run("run.yaml", out=3)
    with pytest.raises(FusionError, match=r"^range: is \('a',\), of type tuple; give "):
        driftlab.plan("map.yaml", range=("a",))
    with pytest.raises(FusionError, match=r"^hours: 'soon' is not a quantity"):
        driftlab.plan("extends: mems_crs05", "soon")
