"""Effects to try: a broken one stops nothing, the same one twice confuses nothing, one not wanted stays out."""

import numpy as np
import pytest
from rows_at_rest import C_VOLTAGE, VOLTAGE, evidence, known, search_of, signature
from third_parties import BROKEN, effect, registry_of

from driftlab.identification import candidates
from driftlab.identification.candidates import candidates_of
from driftlab.identification.candidates import check_kinds as check_known
from driftlab.identification.diagnosis import judge
from driftlab.identification.least_squares import Term
from driftlab.identification.model import joint
from driftlab.identification.result import summary
from driftlab.identification.search import search
from fusion_core.contracts import Effect, on_each_axis
from fusion_core.errors import ConfigError
from fusion_core.host.registry import registry
from fusion_plugins.thermal_maps.polynomial import Polynomial


def names(families):
    return {family[0] for family in families}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_effect_is_left_out_and_named_and_the_others_are_tried(monkeypatch, kind):
    cls, what, why = BROKEN[kind]
    found = search_of(evidence(known), ())
    monkeypatch.setattr(candidates, "registry", lambda: registry_of(cls, kinds=("channel", "hysteresis")))
    families = candidates_of(found)
    assert names(families) == {"channel of voltage", "hysteresis"}
    assert list(found.broken) == [kind]
    assert kind in found.broken[kind]
    assert what in found.broken[kind]
    assert why in found.broken[kind]


TWICE = effect("aaa_volts", signature=lambda self, c, m: (on_each_axis(-2 * c["voltage"] + 7, len(self.axes)), None))
OTHER = effect("aaa_square", signature=lambda self, c, m: (on_each_axis(c["voltage"] ** 2, len(self.axes)), None))


def searched(monkeypatch, *classes, without=(), kinds=("channel", "hysteresis")):
    monkeypatch.setattr(candidates, "registry", lambda: registry_of(*classes, kinds=kinds))
    rows = evidence(lambda k, chunk: signature(VOLTAGE, chunk) @ C_VOLTAGE)
    T = np.concatenate([chunk["temperature"] for chunk in rows.chunks])
    basis = Polynomial(order=3).basis((float(T.min()), float(T.max())))
    found = search(rows, basis, lambda text: None, without=without)
    return found, judge(found, np.full(3, 1e-5), lambda text: None)


def test_an_effect_that_another_shows_already_changes_no_verdict(monkeypatch):
    """Scaled, shifted and first in the alphabet: the built-in one is named, and as sure as without the other."""
    registry().classes(Effect)  # those that came with driftlab are known as such
    alone, verdict = searched(monkeypatch)
    beside, twice = searched(monkeypatch, TWICE)
    assert twice.word == verdict.word == "explained"
    (finding,) = twice.findings
    assert (finding.effect.kind, finding.rivals, finding.alike) == ("channel", (), ("aaa_volts of voltage",))
    assert beside.tried == alone.tried
    assert finding.trial.evidence == verdict.findings[0].trial.evidence
    assert "channel of voltage: here the same as aaa_volts of voltage" in summary(beside, twice, joint(beside))
    assert twice.experiments == ()


def test_what_differs_is_tried(monkeypatch):
    found, _ = searched(monkeypatch, OTHER)
    assert found.same == {}
    assert "aaa_square of voltage" in names(candidates_of(found))


def test_the_same_on_another_channel_is_another_explanation():
    """Recordings cannot say which of two wires that carry one voltage is to blame."""
    rows = evidence(known)
    twin = effect("twin", requires=property(lambda self: ("copy",)),
                  signature=lambda self, c, m: (on_each_axis(c["voltage"], len(self.axes)), None))()  # fmt: skip
    found = search_of(rows, (Term(VOLTAGE),))
    assert candidates.same(found.columns, twin, [VOLTAGE]) is None
    assert candidates.same(found.columns, TWICE(), [VOLTAGE]) is VOLTAGE


def test_what_is_not_wanted_is_not_tried(monkeypatch):
    found, verdict = searched(monkeypatch, without=("channel",))
    assert found.model == ()
    assert not {t.term.effect.kind for t in verdict.rejected} & {"channel"}


def test_an_unknown_kind_is_refused_with_the_nearest():
    check_known(["channel", "drift"])
    with pytest.raises(ConfigError, match=r"--without chanel: is no installed effect; did you mean channel\?"):
        check_known(["chanel"])
    with pytest.raises(ConfigError, match="--effects hysteresys: is no installed effect; did you mean hysteresis"):
        check_known(["hysteresys"], "--effects")
