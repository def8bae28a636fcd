"""Both plugins under the laws of their families."""

import pytest
from driftlab_warm_up.fan import ChamberFan
from driftlab_warm_up.warm_up import WarmUp

from fusion_core.testing import check_plugin, laws


@pytest.mark.parametrize("law", laws(WarmUp), ids=str)
def test_warm_up(law):
    law()


def test_chamber_fan():
    check_plugin(ChamberFan)
