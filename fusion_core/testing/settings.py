"""The law of every plugin: it is its own configuration."""

from __future__ import annotations

import json

from fusion_core.contracts import Plugin


def can_be_written_and_read_again(plugin: Plugin) -> None:
    """`model_validate(model_dump())` gives the same plugin, also through JSON."""
    cls = type(plugin)
    assert cls.model_validate(plugin.model_dump()) == plugin, "model_dump() is read as other settings"
    again = cls.model_validate(json.loads(plugin.model_dump_json()))
    assert again == plugin, "model_dump_json() is read as other settings"


def says_what_it_is(plugin: Plugin) -> None:
    """The class has a docstring, and `kind` a default."""
    assert type(plugin).__doc__, "the class has no docstring; say in a sentence what it is"
    assert type(plugin).model_fields["kind"].default == plugin.kind, "kind has no default; write it beside its type"


LAWS = {"settings can be written and read again": can_be_written_and_read_again, "says what it is": says_what_it_is}
