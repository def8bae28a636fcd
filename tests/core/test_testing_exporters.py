"""The law on texts, tried on exporters that break it."""

from pathlib import Path
from typing import ClassVar, Literal

import pytest

from fusion_core.contracts import Export, Exporter, Loss
from fusion_core.errors import ConfigError
from fusion_core.escaping import comment, line, yaml_text
from fusion_core.testing.exporters import a_text_is_data


class Yaml(Exporter):
    """Names in YAML, by a line of the test's own."""

    suffix: ClassVar[str] = ".yaml"
    kind: Literal["names"] = "names"
    form: Literal["good", "raw", "quoted", "comment", "refused late"] = "good"

    def export(self, what: Export, path: Path) -> Loss:
        """Write serial number and channels."""
        (one, *_) = what.mapped
        written = {
            "good": [comment(what.serial), f"channel: {yaml_text(one.channel)}"],
            "raw": [f"# {what.serial}", f"channel: {yaml_text(one.channel)}"],
            "quoted": [comment(what.serial), f'channel: "{line(one.channel)}"'],
            "comment": [comment(what.serial), f"channel: {line(one.channel)}  # as it is"],
            "refused late": [comment(what.serial)],
        }
        path.write_text("\n".join(written[self.form]) + "\n", errors="replace")
        if self.form == "refused late" and one.channel == "*":
            raise ConfigError("names: that channel cannot be written; name another")
        return Loss()


def test_a_good_one_keeps_it():
    a_text_is_data(Yaml())


@pytest.mark.parametrize("form", ["raw", "quoted", "comment", "refused late"])
def test_one_that_writes_a_text_as_it_is_breaks_it(form):
    with pytest.raises(
        AssertionError, match=r"(name|channel) '.*has other lines, keys|a file is written, and then ref|has '# "
    ):
        a_text_is_data(Yaml(form=form))
