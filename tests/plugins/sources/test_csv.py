import gzip
import io
import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from recordings_on_disk import read, simple, text

from fusion_core.chunk import concatenate
from fusion_core.errors import (
    BadValue,
    EmptyRecording,
    MissingChannel,
    UnreadableFile,
    Unwritable,
)
from fusion_core.faults import Faults, usable
from fusion_plugins.sources import csv as csv_module
from fusion_plugins.sources import unpacked
from fusion_plugins.sources.csv import Csv
from fusion_plugins.sources.dialect import dialect_of

GOOD = "t,g,h\n0,1,5\n1,2,6\n2,3,7\n"


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        GOOD[:-1],
        "\ufeff" + GOOD,
        "# made by hand\n# t,g\n\n" + GOOD,
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n1", "\n\n# a pause\n1"),
        GOOD + "\n\n",
        '"t","g","h"\n0,"1","a,b"\n1,"2","c"\n2,"3",""\n',
        "t, g, h\n0, 1, x\n1, 2, y\n2, 3, z\n",
        "g,,t\n1,,0\n2,,1\n3,,2\n",
        "h,h,g,t\n0,0,1,0\n0,0,2,1\n0,0,3,2\n",
        "t,g,h\n0,1,\n1,2,\n2,3,\n",
        "t,g,h\n0,1,\n1,2,\n2,3,",
        "t,g\n0,1e0\n1.0,+2\n 2,.3E+1\n",
    ],
)
def test_ways_to_write_the_same_csv(tmp_path, content):
    faults = Faults()
    got = read(simple(text(tmp_path, content)), faults=faults)
    np.testing.assert_array_equal(got.t, [0, 1, 2])
    np.testing.assert_array_equal(got["gyro"], [[1], [2], [3]])
    assert faults.lines() == []


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        "# c\n" + GOOD,
        GOOD.replace("\n", "\r\n"),
        "t,g,h\n0,1,\n1,,\n2,3,\n",
        't,g,h\n0,"1",a\n1,2,b\n',
        "t,g\n0, 1\n1, nan\n",
        "t,g,h\n0,1,5\n# c\n1,2,6\n",
    ],
)
def test_what_is_regular_is_left_to_polars(tmp_path, monkeypatch, content):
    monkeypatch.setattr(csv_module.CsvLines, "_careful", lambda *_: pytest.fail("was read row by row"))
    assert len(read(simple(text(tmp_path, content)))) >= 2


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_separators(tmp_path, separator):
    path = text(tmp_path, GOOD.replace(",", separator))
    assert len(read(simple(path, separator=separator))) == 3
    if separator != ",":
        shown = separator.replace("\t", r"\\t")
        with pytest.raises(
            MissingChannel, match=f"the header has no ',' and is a single column; set separator: \"{shown}\""
        ):
            read(simple(path))


def test_text_of_another_encoding_in_other_columns(tmp_path):
    content = "t,g,T (°C)\n0,1,é\n".encode("latin-1")
    assert len(read(simple(text(tmp_path, content)))) == 1
    named = Csv(
        path=text(tmp_path, "t,T (°C)\n0,5\n".encode("latin-1")),
        channels={"time": {"path": "t", "unit": "s"}, "temperature": {"path": "T (°C)", "unit": "degC"}},
    )
    assert read(named)["temperature"] == [5]
    assert read(simple(text(tmp_path, "t,g\r\n0,1\r\n1,2".encode("utf-16"))))["gyro"].tolist() == [[1], [2]]
    with pytest.raises(UnreadableFile, match="is not UTF-8 text; save it as UTF-8"):
        read(simple(text(tmp_path, "t,g\n0,1\n".encode("utf-16-le"))))  # without a mark


def test_empty_cells_are_dropped_and_reported_later(tmp_path):
    source = simple(text(tmp_path, "t,g,h\n0,1,\n1,,\n2,3,\n"))
    np.testing.assert_array_equal(read(source)["gyro"], [[1], [np.nan], [3]])
    faults = Faults()
    assert len(concatenate(list(usable(source.chunks(9, faults), faults, "r")))) == 2
    assert faults.lines() == ["rows where gyro is not a finite number, left out: 1 (first at 1.0 s)"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "1,abc,6",
            r"r\.csv: line 4, column 'g': 'abc' is not a number; correct it, or leave the cell empty",
        ),
        ("1,2_0,6", r"line 4, column 'g': '2_0' is not a number"),
        ('1,2,"a\rb"c', None),
        ('1,"2,5",6', r"line 4, column 'g': '2,5' is not a number"),
        ("1e,2,6", r"line 4, column 't': '1e' is not a number"),
        ("1,2", r"line 4 has 2 fields, 3 were expected as in the header; correct or remove the line"),
        ("1,2,6,", r"line 4 has 4 fields, 3 were expected"),
        ("1", r"line 4 has 1 fields?, 3 were expected"),
        ('1,2,"x', None),
    ],
)
@pytest.mark.parametrize("block", [20, 8 << 20])
def test_bad_lines(tmp_path, monkeypatch, line, message, block):
    monkeypatch.setattr(csv_module, "BLOCK", block)
    content = f"# a comment\nt,g,h\n0,1,5\n{line}\n" + "".join(f"{k},3,7\n" for k in range(2, 20))
    source = simple(text(tmp_path, content))
    if message is None:
        assert len(read(source)) == 20
    else:
        with pytest.raises(BadValue, match=message):
            read(source)


def test_a_short_line_and_a_long_one_do_not_make_up_for_each_other(tmp_path):
    with pytest.raises(BadValue, match="line 3 has 2 fields"):
        read(simple(text(tmp_path, "t,g,h\n0,1,5\n1,2\n2,3,7,8\n3,4,9\n")))
    with pytest.raises(BadValue, match="line 3 has 4 fields"):
        read(simple(text(tmp_path, "t,g,h\n0,1,5\n1,2,3,4\n2,3\n3,4,9\n")))


@pytest.mark.parametrize("cut", ["2", "2,", "2,3", '2,3,"no', "\0\0\0"])
def test_torn_last_line(tmp_path, cut):
    faults = Faults()
    got = read(simple(text(tmp_path, "# c\nt,h,g\n0,5,1\n1,6,2\n" + cut)), faults=faults)
    np.testing.assert_array_equal(got["gyro"], [[1], [2]])
    assert faults.lines() == ["torn last line, left out: 1 (first line 5)"]


@pytest.mark.parametrize("cut", ["1e", "-", "0x", "1.2e-", "na"])
def test_last_field_cut_to_something_else_than_a_number(tmp_path, cut):
    faults = Faults()
    assert len(read(simple(text(tmp_path, f"t,g\n0,1\n1,{cut}")), faults=faults)) == 1
    assert faults.lines() == ["torn last line, left out: 1 (first line 3)"]
    with pytest.raises(BadValue, match=f"line 3, column 'g': '{cut}' is not a number"):
        read(simple(text(tmp_path, f"t,g\n0,1\n1,{cut}\n")))


def test_every_cut_of_a_csv_loses_at_most_one_row(tmp_path):
    content = GOOD.encode()
    for n in range(len("t,g,h\n0,1,5\n"), len(content) + 1):
        faults = Faults()
        rows = len(read(simple(text(tmp_path, content[:n])), faults=faults))
        begun = content[:n].count(b"\n") - content[:n].endswith(b"\n")
        assert rows + len(faults.lines()) == begun


def test_headers(tmp_path):
    with pytest.raises(EmptyRecording, match=r"has no header line; write the columns' names in the first line"):
        read(simple(text(tmp_path, "# only\n\n# comments\n")))
    with pytest.raises(EmptyRecording, match="has columns and no rows"):
        read(simple(text(tmp_path, "t,g\n")))
    with pytest.raises(MissingChannel, match=r"has numbers only \(0, 1, \.\.\.\), the columns' names were expected"):
        read(simple(text(tmp_path, "0,1\n1,2\n")))
    with pytest.raises(BadValue, match="has 2 columns 'g', one was expected; rename the others"):
        read(simple(text(tmp_path, "t,g,g\n0,1,2\n")))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(st.lists(st.floats(), min_size=1, max_size=20), st.sampled_from(["{!r}", "{:.17g}", "{:.6f}", '"{!r}"']))
def test_polars_and_the_slow_road_agree(tmp_path, numbers, form):
    lines = ["t,g"] + [f"{k}," + form.format(value) for k, value in enumerate(numbers)]
    path = text(tmp_path, "\n".join(lines) + "\n")
    fast = read(simple(path))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(csv_module.CsvLines, "_fast", lambda *_: None)
        slow = read(simple(path))
    expected = [float(form.format(value).strip('"')) for value in numbers]
    np.testing.assert_array_equal(slow["gyro"][:, 0], expected)
    np.testing.assert_array_equal(fast["gyro"], slow["gyro"])


# archives and standard input


def test_an_archive_is_read_as_its_text(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_module, "BLOCK", 1000)
    content = "t,g\n" + "".join(f"{k},{k / 7!r}\n" for k in range(500))
    plain, packed = text(tmp_path, content), text(tmp_path, gzip.compress(content.encode()), "r.csv.gz")
    for size in (7, 1000):
        one, other = (read(simple(path, start=100.0), size) for path in (plain, packed))
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one["gyro"], other["gyro"])


def test_an_archive_of_several_members_is_read_to_its_end(tmp_path):
    """As `cat day1.gz day2.gz`, or a logger that opens its archive anew, makes them."""
    lines = [f"{k},{k / 8}\n" for k in range(1000)]
    members = ["t,g\n", *("".join(lines[k : k + 7]) for k in range(0, 1000, 7))]
    path = text(tmp_path, b"".join(gzip.compress(member.encode()) for member in members), "r.csv.gz")
    np.testing.assert_array_equal(read(simple(path))["gyro"][:, 0], np.arange(1000) / 8)


def test_a_bad_line_of_an_archive_is_named_by_its_number(tmp_path):
    path = text(tmp_path, gzip.compress((GOOD + "3,x,8\n").encode()), "r.csv.gz")
    with pytest.raises(BadValue, match=r"r.csv.gz: line 5, column 'g': 'x' is not a number"):
        read(simple(path))


def test_an_archive_cut_anywhere_is_refused(tmp_path):
    rng = np.random.default_rng(1)
    content = "t,g\n" + "".join(f"{k},{value!r}\n" for k, value in enumerate(rng.normal(size=2000).tolist()))
    whole = gzip.compress(content.encode())
    for cut in (3, 11, 100, len(whole) // 2, len(whole) - 1):
        with pytest.raises(UnreadableFile, match=r"is cut short or damaged .*; copy or record it again"):
            read(simple(text(tmp_path, whole[:cut], "r.csv.gz")))
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF
    with pytest.raises((UnreadableFile, BadValue)):
        read(simple(text(tmp_path, bytes(damaged), "r.csv.gz")))


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        (b"", "is empty \\(0 bytes when unpacked\\)"),
        (b"\x89HDF\r\n\x1a\n" + bytes(99), "is an HDF5 file, a file of kind csv"),
    ],
)
def test_what_an_archive_holds_is_checked(tmp_path, inside, message):
    with pytest.raises(UnreadableFile, match=message):
        read(simple(text(tmp_path, gzip.compress(inside), "r.csv.gz")))


@pytest.fixture
def standard_input(tmp_path, monkeypatch):
    """Return a function that puts bytes, or what comes of a stream, on standard input."""

    def forget():
        if unpacked._standard_input.cache_info().currsize:
            unpacked._standard_input()[1].close()
        unpacked._standard_input.cache_clear()

    def give(content):
        forget()
        raw = io.BytesIO(content) if isinstance(content, bytes) else io.BufferedReader(content)
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(raw))

    yield give
    forget()


@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_standard_input_is_read_as_often_as_it_is_needed(standard_input, pack):
    standard_input(pack(GOOD.encode()))
    for _ in range(2):
        np.testing.assert_array_equal(read(simple("-", stop=2.0)).t, [0, 1])


def test_what_is_wrong_with_standard_input(standard_input, monkeypatch):
    standard_input(b"")
    with pytest.raises(UnreadableFile, match=r"-: is empty \(0 bytes\)"):
        read(simple("-"))
    standard_input(b"t,g\n0,1\n1,x\n")
    with pytest.raises(BadValue, match="-: line 3, column 'g'"):
        read(simple("-"))
    terminal, other = os.openpty()
    with os.fdopen(other) as screen:
        standard_input(b"")
        monkeypatch.setattr("sys.stdin", screen)
        with pytest.raises(UnreadableFile, match=r"-: standard input is a terminal, .*; pipe one in, or name a file"):
            read(simple("-"))
    os.close(terminal)
    standard_input(GOOD.encode())
    monkeypatch.setattr("tempfile.tempdir", "/dev/full")
    with pytest.raises(Unwritable, match=r"-: standard input cannot be kept in /dev/full"):
        read(simple("-"))


class Endless(io.RawIOBase):
    """One thing first and another again and again, of which no more than some is asked for."""

    def __init__(self, first, again, most=100_000_000):
        self.rest, self.again, self.most = first, again * (BLOCK // len(again) + 1), most

    def readable(self):
        return True

    def readinto(self, buffer):
        self.rest = self.rest or self.again
        data, self.rest = self.rest[: len(buffer)], self.rest[len(buffer) :]
        buffer[: len(data)] = data
        self.most -= len(data)
        assert self.most > 0, "more was read than tells that it is no recording"
        return len(data)


BLOCK = 1 << 16
MEMBER = gzip.compress(b"", mtime=0)


@pytest.mark.parametrize(
    ("first", "again", "message"),
    [
        (b"", b"y\n", "has no column 't'"),
        (b"", b"\0", "is not UTF-8 text"),
        (b"", b"y", "a line of more than 1 MB"),
        (b"", b"\n", "has more than 64 MB of comments and blank lines before its first row"),
        (b"t,g,h\n", b"# a comment\n", "has more than 64 MB of comments and blank lines before its first row"),
        (b"", gzip.compress(bytes(1 << 20)), "is not UTF-8 text"),
        (b"", MEMBER, "has more than 64 MB that unpack to nothing"),
        (MEMBER, b"\0", "has more than 64 MB that unpack to nothing"),
    ],
)
def test_a_stream_without_end_that_is_no_recording_is_refused_by_its_beginning(
    standard_input, monkeypatch, first, again, message
):
    standard_input(Endless(first, again))
    with pytest.raises(UnreadableFile if "column" not in message else MissingChannel, match=f"-: .*{message}"):
        read(simple("-"))


def test_rows_without_end_are_read_as_far_as_the_limit(standard_input, monkeypatch, tmp_path):
    """More than TMPDIR may hold: refused in one line, and the file that kept them has no name there."""
    monkeypatch.setattr("fusion_core.budget.MAX_TEMPORARY", 3_000_000)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    standard_input(b"t,g,h\n" + b"0,1,2\n" * 1_000_000)
    with pytest.raises(UnreadableFile, match="-: standard input has more than 3 MB, which is the limit; write it to"):
        read(simple("-"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("block", [16, 64, 1 << 20])
@pytest.mark.parametrize(
    "start", ["", "\ufeff", "\ufeff# a\n", "# a\n", "\n \t\n", "\u00a0\n# b\n", "  # no comment,\n"]
)
def test_comments_before_the_header_are_passed_over_by_blocks(tmp_path, monkeypatch, block, start):
    monkeypatch.setattr(csv_module, "BLOCK", block)
    content = start + "#\n\n# a comment, that is longer than some blocks\n" * 40 + GOOD
    if start.startswith("  #"):
        with pytest.raises(MissingChannel, match="it has # no comment"):
            read(simple(text(tmp_path, content)))
        return
    np.testing.assert_array_equal(read(simple(text(tmp_path, content))).t, [0, 1, 2])
    with pytest.raises(BadValue, match=f"line {content.count(chr(10)) + 3}, column 'g': 'x' is not a number"):
        read(simple(text(tmp_path, content + "#\n\n3,x,1\n")))


@pytest.mark.parametrize("line", ["#\n", "\n", "# a comment\n", " \t\n"])
@pytest.mark.parametrize("before", ["", GOOD])
def test_comments_without_end(tmp_path, monkeypatch, line, before):
    for limit in ("SKIPPED", "TEXTS"):
        monkeypatch.setattr(csv_module, limit, 10_000)
    content = before + '3,"4",5\n' * bool(before) + line * 11_000 + GOOD.partition("\n")[2 if before else 0] + GOOD
    with pytest.raises(UnreadableFile, match="has more than 10 kB of comments and blank lines, which is the limit"):
        read(simple(text(tmp_path, content)))


def test_a_header_without_end(tmp_path):
    with pytest.raises(UnreadableFile, match="has a line of more than 1 MB"):
        read(simple(text(tmp_path, "t,g," + "x," * 600_000 + "\n0,1\n")))
    with pytest.raises(UnreadableFile, match="has 20,003 columns, at most 10,000 are read; check the separator"):
        read(simple(text(tmp_path, "t,g," + "x," * 20_000 + "\n0,1\n")))


FLAGGED = "t,status,g\n0,OK,1\n1, OK ,2\n2,ERR,3\n3,,4\n4,OK!,5\n5,OK,6\n"


@pytest.mark.parametrize("content", [
    FLAGGED,
    FLAGGED[:-1],
    FLAGGED.replace("\n", "\r\n"),
    FLAGGED.replace("ERR", '"ERR, loud"'),  # line by line
    "".join(",".join(line.split(",")[i] for i in (0, 2, 1)) + "\n" for line in FLAGGED.splitlines()),
])  # fmt: skip
def test_a_column_of_texts_says_which_rows_are_valid(tmp_path, content):
    channels = {"time": {"path": "t", "unit": "s"}, "gyro": {"path": "g", "unit": "rad/s"}, "valid": {"path": "status"}}
    path, faults = text(tmp_path, content), Faults()
    source = Csv(path=path, channels=channels, flags={"status": "OK"})
    got = concatenate(list(usable(source.chunks(100, faults), faults, "rec")))
    assert got["gyro"][:, 0].tolist() == [1, 2, 6]
    assert [line.partition(" (")[0] for line in faults.lines()] == ["rows flagged as not valid, left out: 3"]
    with pytest.raises(BadValue, match=r"'OK' is not a number; set source.flags to \{status: TEXT\}"):
        read(Csv(path=path, channels=channels))


LOGGED = (
    'Soak of unit 7\n\nDatum;Zeit;g;T\n;;deg/s;°C\n05.03.2026;14:22:01,5;0,25;"20,5"\n05.03.2026;14:22:02;-1,5;21\n'
)
FORMS = {"separator": ";", "decimal": ",", "header": 3, "first_row": 5}


def logged(path, **more):
    settings = FORMS | {"dates": {"Datum + Zeit": "%d.%m.%Y %H:%M:%S"}} | more
    names = {"time": {"path": "Datum + Zeit"}, "gyro": {"path": "g"}, "temperature": {"path": "T"}}
    return Csv(path=path, channels=names, **settings)


@pytest.mark.parametrize("quote", ["", '"'])
def test_a_text_is_read_as_a_logger_writes_it(tmp_path, quote):
    """Quotes are read line by line, all else in blocks: a preamble, units, decimal commas and two columns of a date."""
    path = text(tmp_path, LOGGED.replace('"', quote))
    got = read(logged(path))
    np.testing.assert_allclose(got.t - 1772720521, [0.5, 1.0], atol=1e-6)
    np.testing.assert_allclose(got["gyro"][:, 0], np.deg2rad([0.25, -1.5]))
    assert got["temperature"].tolist() == [20.5, 21.0]
    found = Csv.settings_for(path, {})
    assert found == FORMS | {"dates": {"Datum + Zeit": "%d.%m.%Y %H:%M:%S"}}


@pytest.mark.parametrize(("content", "more", "message"), [
    (LOGGED.replace("14:22:02", "noon"), {}, r"line 6, column 'Datum \+ Zeit': '05.03.2026 noon' is not a date as '%d"),
    (LOGGED.replace("-1,5", "1.234,5"), {}, "line 6, column 'g': '1.234,5' is not a number"),
    (LOGGED, {"header": 30}, "has fewer than 30 lines; correct source.header"),
])  # fmt: skip
def test_what_is_written_otherwise_is_refused_where_it_stands(tmp_path, content, more, message):
    with pytest.raises((BadValue, EmptyRecording), match=message):
        read(logged(text(tmp_path, content), **more))
    with pytest.raises(ValidationError, match="the separator and the decimal sign are both ','; correct one of them"):
        simple(tmp_path / "r.csv", decimal=",")


def test_columns_of_blanks_and_columns_without_names(tmp_path):
    channels = {"time": {"path": "1", "unit": "s"}, "gyro": {"path": ["2", "3"], "unit": "rad/s"}}
    got = read(Csv(path=text(tmp_path, "  0   1\t2 \n  1  -1e-3  4"), channels=channels, separator=" ", header=0))
    assert got["gyro"].tolist() == [[1, 2], [-1e-3, 4]]
    got = read(Csv(path=text(tmp_path, "0,1,2,\n1,5,4,\n"), channels=channels, header=0))
    assert got["gyro"].tolist() == [[1, 2], [5, 4]]


@pytest.mark.parametrize("separator", ["\t", ";", " ", ","])
def test_the_dialect_of_ordinary_tables_is_found_whatever_their_numbers(separator):
    """Signed numbers with points, eleven columns: no cell is a date, and no comma a decimal sign."""
    names = separator.join(["time_s", "wx", "wy", "wz", "ax", "ay", "az", "mx", "my", "mz", "temp"])
    for seed in range(12):
        rng = np.random.default_rng(seed)
        rows = np.column_stack(
            [np.arange(300) / 100, rng.normal(size=(300, 9)) * rng.uniform(0.01, 10), np.full(300, 25)]
        )
        lines = [names, *(separator.join(f"{x:.5g}" for x in row) for row in rows)]
        found = dialect_of(lines, {})
        assert (found.separator, found.decimal, found.header, found.first_row) == (separator, ".", 1, 2), seed


def test_days_and_months_are_told_by_the_span_and_years_by_the_date():
    """Over midnight of 3 April the day can only stand first; fractions of four digits are no year."""
    moments = [
        f"0{3 + k // 30}/04/2024 {(23, 0)[k // 30]:02d}:{(59, 0)[k // 30]:02d}:{k % 30 + 30 * (k < 30):02d}"
        for k in range(60)
    ]
    for year in ("2024", "24"):
        lines = ["t;gx", *(f"{m.replace('2024', year)}.0000;{k / 7:.3f}" for k, m in enumerate(moments))]
        (form,) = dialect_of(lines, {}).dates.values()
        assert form.startswith("%d/%m/" + ("%Y" if year == "2024" else "%y"))


@pytest.mark.parametrize("row", ["05.03.2026 14:22:02; 1,5;12.345\n", "05.03.2026 14:22:02;1.234,5;20\n"])
def test_a_point_under_a_decimal_comma_is_refused(tmp_path, row):
    """It stands between thousands, or the decimal sign is another: polars would take it for one."""
    content = "when;g;T\n05.03.2026 14:22:01;-0,5;20\n" + row
    forms = {"separator": ";", "decimal": ",", "dates": {"when": "%d.%m.%Y %H:%M:%S"}}
    names = {"time": {"path": "when"}, "gyro": {"path": "g", "unit": "deg/s"}}
    source = Csv(path=text(tmp_path, content), channels={**names, "temperature": {"path": "T", "unit": "K"}}, **forms)
    remedy = "is not a number; the decimal sign is ',': remove points between thousands, or correct source.decimal"
    with pytest.raises(BadValue, match=rf"line 3, column '[gT]': '[\d.,]+' {remedy}"):
        read(source)


def test_dates_with_points_beside_decimal_commas_are_left_to_polars(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_module.CsvLines, "_careful", lambda *_: pytest.fail("was read row by row"))
    content = "when;g;T\r\n05.03.2026 14:22:01; -0,5;20\r\n05.03.2026 14:22:02;;1e1\r\n"
    forms = {"separator": ";", "decimal": ",", "dates": {"when": "%d.%m.%Y %H:%M:%S"}}
    names = {"time": {"path": "when"}, "gyro": {"path": "g", "unit": "rad/s"}}
    path = text(tmp_path, content)
    np.testing.assert_array_equal(read(Csv(path=path, channels=names, **forms))["gyro"], [[-0.5], [np.nan]])
    with Csv(path=path, channels=names, **forms).open(path, Faults()) as table:
        assert next(table.blocks(["when"], 9)).read("when").tolist() == [1772720521, 1772720522]


@pytest.mark.parametrize("block", [30, 100, 8 << 20])
@pytest.mark.parametrize("quote", ["", '"'])
def test_a_time_of_day_goes_on_over_midnight(tmp_path, monkeypatch, block, quote):
    monkeypatch.setattr(csv_module, "BLOCK", block)
    seconds = 86_390 + 7_200 * np.arange(30)
    clock = [f"{s // 3600 % 24:02}:{s // 60 % 60:02}:{s % 60:02}" for s in seconds]
    clock[3] = ""
    path = text(tmp_path, "t,g\n" + "".join(f"{quote}{cell}{quote},{k}\n" for k, cell in enumerate(clock)))
    names = {"time": {"path": "t"}, "gyro": {"path": "g", "unit": "rad/s"}}
    source = Csv(path=path, channels=names, dates={"t": "%H:%M:%S"})
    for _ in range(2):
        got = read(source)
        np.testing.assert_array_equal(got.t[got["gyro"][:, 0] != 3], np.delete(seconds, 3))


def test_a_comment_below_the_names_does_not_count_as_a_row(tmp_path):
    content = "t,g,h\n# s,deg/s,degC,\n\n0,1,5\n1,2,6\n"
    assert read(simple(text(tmp_path, content)))["gyro"].tolist() == [[1], [2]]
    assert read(simple(text(tmp_path, content.replace("degC,", "degC")), header=1)).t.tolist() == [0, 1]
    assert read(simple(text(tmp_path, content.replace("5\n1,2,6", "5,\n1,2,6,")))).t.tolist() == [0, 1]


def test_a_name_too_many_is_refused_below_a_preamble_too(tmp_path):
    with pytest.raises(BadValue, match="line 3 has 2 fields, 3 were expected as in the header"):
        read(simple(text(tmp_path, "Rec 1\nDate,t,g\n0,1\n1,2\n2,3\n"), header=2))
    assert len(read(simple(text(tmp_path, "Rec 1\nt,g,\n0,1\n1,2\n"), header=2))) == 2


def test_an_archive_of_utf_16_fills_no_more_than_its_budget(tmp_path, monkeypatch):
    monkeypatch.setattr("fusion_core.budget.MIN_UNPACKED", 1_000)
    packed = gzip.compress(("t,g,h\n" + "0,1,2\n" * 1_000_000).encode("utf-16"))
    with pytest.raises(UnreadableFile, match=r"r.csv.gz: unpacks to more than .* MB, which is the limit"):
        read(simple(text(tmp_path, packed, "r.csv.gz")))


@pytest.mark.parametrize(("cell", "seconds"), [
    ("10:00:00.5", 36_000.5), ("10:00:00,25", 36_000.25), ("10:00:00:005", 36_000.005),
    ("10:00:00:000005", 36_000.000005), ("10:00:00:500 UTC", 36_000.5),
    ("10:00:00:5", None), ("10:00:00:05", None), ("1:10:00:05", None), ("10:00:00:0005", None),
])  # fmt: skip
def test_a_colon_before_a_fraction_is_one_before_thousandths_or_millionths(tmp_path, cell, seconds):
    source = Csv(
        path=text(tmp_path, f't;g\n"{cell}";1\n'),
        channels={"time": {"path": "t"}, "gyro": {"path": "g", "unit": "rad/s"}},
        separator=";",
        dates={"t": "%H:%M:%S"},
    )
    if seconds is None:
        with pytest.raises(BadValue, match=f"line 2, column 't': '{cell}' is not a date as '%H:%M:%S'"):
            read(source)
    else:
        np.testing.assert_allclose(read(source).t, [seconds], atol=1e-9)
