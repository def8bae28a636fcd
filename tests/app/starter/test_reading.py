"""Files as loggers and vendors' tools write them: read to the digit, asked about, or refused with the next step."""

import logger_traps  # noqa: F401  # twelve of the files
import pytest
from logger_files import FILES, read_back


def test_there_are_sixty_and_twelve_and_each_names_its_description():
    assert len(FILES) == len({file.name for file in FILES}) == 72
    assert all(file.source for file in FILES)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_a_first_config_reads_what_a_logger_wrote(tmp_path, file):
    assert read_back(file, tmp_path) == ""
