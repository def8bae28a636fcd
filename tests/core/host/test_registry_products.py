"""An error in what extends a product points to the user's file, and never into an installed one."""

from pathlib import Path
from typing import Literal

import pytest

from fusion_core.errors import ConfigError
from fusion_core.host.config import read_document, validate
from fusion_core.settings import Settings


class Part(Settings):
    kind: Literal["one", "two"]
    size: int


class Unit(Settings):
    rate: int
    part: Part
    places: tuple[int, ...] = ()


@pytest.fixture
def write(tmp_path):
    def write(name, text):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


@pytest.fixture
def products(write):
    return {"acme": write("installed.yaml", "rate: 3\npart:\n  kind: one\n  size: 4\nplaces:\n  - 1\n  - 2\n")}


def message_of(path, products):
    with pytest.raises(ConfigError) as caught:
        validate(Unit, read_document(path, products))
    return str(caught.value)


def test_a_key_that_went_with_a_replaced_mapping_is_missing_where_the_user_replaced_it(write, products):
    mine = write("mine.yaml", "# a unit\nextends: acme\npart:\n  kind: two\n")
    assert message_of(mine, products) == f"{mine}:3: part.size: is required and missing; add it"


def test_an_item_of_a_list_is_that_of_the_users_list(write, products):
    mine = write("mine.yaml", "extends: acme\n\nplaces: [1, x]\n")
    assert message_of(mine, products).startswith(f"{mine}:3: places.1: ")


def test_a_fault_of_the_product_itself_is_told_by_the_line_that_extends_it(write, products):
    Path(products["acme"]).write_text("rate: fast\npart: {kind: one, size: 1}\n")
    mine = write("mine.yaml", "\nextends: acme\n")
    assert message_of(mine, products).startswith(f"{mine}:2: extends acme (its line 1): rate: ")
    # the line is of the user's file that says so, whatever extends that one
    mine = write("outer.yaml", "extends: mine.yaml\n")
    assert message_of(mine, products).startswith(f"{mine.with_name('mine.yaml')}:2: extends acme (its line 1): rate: ")


def test_a_file_of_the_user_is_named_as_it_is(write, products):
    write("base.yaml", "rate: fast\npart: {kind: one, size: 1}\n")
    mine = write("mine.yaml", "extends: base.yaml\n")
    assert message_of(mine, products).startswith(f"{mine.with_name('base.yaml')}:1: rate: ")
