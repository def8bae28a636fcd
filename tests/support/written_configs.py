"""A config as a user writes it, and how one is read."""

from driftlab.config import Config, products
from fusion_core.host.config import read_document, validate

GOOD = """
latitude: 40.9 deg
filter:
  gyro: {noise: 3.18 deg/h/sqrt(Hz), bias: {kind: random_walk, walk: 5e-4 deg/s/sqrt(s)}}
"""


def load(tmp_path, text, model=Config):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    return validate(model, read_document(path, products()))
