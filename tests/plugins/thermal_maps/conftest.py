import pytest
from soaks import ALL, smooth, soak


@pytest.fixture(scope="session")
def fitted():
    return {maps.kind: maps.fit(*soak(smooth), {"recording": "soak.csv"}) for maps in ALL}
