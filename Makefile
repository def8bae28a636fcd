# make demo and make test are the two commands of the README; each makes its own virtual environment.

PYTHON ?= python3
VENV := .venv
TEST_VENV := .venv-test
SOURCES := $(shell find fusion_core plugins driftlab -name '*.py' -o -name '*.html' -o -name '*.yaml') pyproject.toml README.md

ifneq ($(wildcard ../shared/data),)
export DRIFTLAB_DATA ?= $(abspath ../shared)
endif
# figures are drawn to files; no display is looked for
export MPLBACKEND := Agg
# modules are compiled once, when they are first imported: most of what pip would compile is never imported, and takes it longest
unexport PYTHONDONTWRITEBYTECODE
PIP_INSTALL := pip install --quiet --disable-pip-version-check --no-compile

.PHONY: setup demo oven navigator autopilot family planned reference hysteresis turntable paper tools test hidden torture statistics wheels lint types bench loop docs clean

setup: $(VENV)/ready

$(VENV)/ready: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/$(PIP_INSTALL) --editable '.[dev]'
	touch $@

demo: $(VENV)/ready
	$(VENV)/bin/python examples/01_cats/demo.py

# what a measured resistor lacks that lags behind its oven, and a control beside it (ten seconds, the first time a minute; no recording is fetched)
oven: $(VENV)/ready
	$(VENV)/bin/python examples/02_oven_resistor/run.py

# a vehicle that drives and stops while its inertial unit warms: what the thermal derivative gains over 20 drives (three minutes)
navigator: $(VENV)/ready
	$(VENV)/bin/python examples/04_navigator/run.py

# from an autopilot's logs to its parameters, and what each way leaves on a measured day that none has seen (two minutes)
autopilot: $(VENV)/ready
	$(VENV)/bin/python examples/05_autopilot/run.py

# a line of 200 gyros with odd units, a shifted lot and a hidden hysteresis: what is found, and new units with 40 % of a soak, and a later day (six minutes)
family: $(VENV)/ready
	$(VENV)/bin/python examples/06_family/run.py

# a planned soak beside a staircase of the same hours, on simulated units (40 s)
planned: $(VENV)/ready
	$(VENV)/bin/python examples/07_planned_soak/run.py

# a measured voltage reference, in ppm, while it warms (10 s)
reference: $(VENV)/ready
	$(VENV)/bin/python examples/08_voltage_reference/run.py

# a hysteresis in one simulated soak, and a unit without any (10 s)
hysteresis: $(VENV)/ready
	$(VENV)/bin/python examples/09_hysteresis/run.py

# the paper's experiment on a twin: its tables beside ours, and what causes them (ten minutes)
paper: $(VENV)/ready
	$(VENV)/bin/python examples/paper/paper.py
	$(VENV)/bin/python examples/paper/ablation.py

# scale factors as states while a simulated turntable turns and warms (10 s)
turntable: $(VENV)/ready
	$(VENV)/bin/python examples/11_turntable/run.py

# the tables of docs/reference/performance.md, side by side with other filters and polars (fifteen minutes, 10 GB of disk;
# more of them after pip install '.[peers]', which is six gigabytes for torch)
bench: $(VENV)/ready
	$(VENV)/bin/python benchmarks/run_all.py
	# from the last byte of a frame to the estimate, at 1 kHz through a pty (two minutes)
	$(VENV)/bin/python benchmarks/live_latency.py

# does explain close the loop: measured, planted and simulated cases that one develops on (ten minutes on two cores);
# LOOP='--split check --seeds 3' for those that one does not
loop: $(VENV)/ready
	$(VENV)/bin/python benchmarks/loop.py $(LOOP)

# the suite runs against the built wheel, not against this folder; a file of tests in one of JOBS processes, of one thread each
JOBS ?= 2
$(TEST_VENV)/bin/pip:
	$(PYTHON) -m venv $(TEST_VENV)

$(TEST_VENV)/ready: $(SOURCES) $(TEST_VENV)/bin/pip
	rm -rf build dist driftlab.egg-info
	$(TEST_VENV)/bin/pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .
	$(TEST_VENV)/bin/$(PIP_INSTALL) "$$(ls dist/driftlab-*.whl)[test]"
	$(TEST_VENV)/bin/$(PIP_INSTALL) --no-deps --force-reinstall dist/driftlab-*.whl
	touch $@

# programs that tests run, from Debian, where one is missing (as root): a browser that looks at pages, compilers and an
# emulator for C code, Octave for .mat files
TOOLS := gcc:gcc g++:g++ arm-none-eabi-gcc:gcc-arm-none-eabi qemu-arm:qemu-user octave-cli:octave pdftotext:poppler-utils
BESIDE := fonts-dejavu-core libc6-dev libeigen3-dev libnewlib-arm-none-eabi
tools:
	@missing="$$(for tool in $(TOOLS); do command -v $${tool%%:*} >/dev/null || echo $${tool##*:}; done)"; \
	command -v chromium chromium-browser google-chrome >/dev/null || missing="$$missing chromium"; \
	test -z "$$missing" || { apt-get update -qq && apt-get install -y -qq --no-install-recommends $$missing $(BESIDE) >/dev/null; }

test: $(TEST_VENV)/ready
	DRIFTLAB_TEST_WHEEL=1 OPENBLAS_NUM_THREADS=1 $(TEST_VENV)/bin/pytest --numprocesses $(JOBS) --dist loadfile --durations=10

# the suite where modules that POSIX alone has are missing, in each process: what needs them is skipped, and says so
# (HIDDEN='tests/app/storage tests/core' for a part)
HIDDEN ?= tests/core tests/plugins tests/app
hidden: $(VENV)/ready
	PYTHONPATH=$(abspath tests/support/hidden) OPENBLAS_NUM_THREADS=1 $(VENV)/bin/pytest --numprocesses $(JOBS) --dist loadfile $(HIDDEN)

# bad input, kills and full disks by the thousand; a small dose of it is in the suite (up to fifteen minutes on two cores; as root
# it also mounts small disks, and unmounts them). Failed cases are written to torture_failures
torture: $(VENV)/ready
	$(VENV)/bin/python tests/torture/campaign.py

# tests that draw many seeds, with all of them; the suite has the first few
statistics: $(VENV)/ready
	DRIFTLAB_STATISTICS=1 OPENBLAS_NUM_THREADS=1 $(VENV)/bin/pytest $$(grep -l 'from doses import' -r tests --include 'test_*.py')

# before a release: the wheel of what is committed on three Pythons, each from nothing to C code; it is then in dist/
PYTHONS ?= python3.11 python3.12 python3.13
wheels: $(VENV)/ready
	$(VENV)/bin/python packaging/try_wheel.py $(PYTHONS)

lint: $(VENV)/ready
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	PYTHONPATH=typings $(VENV)/bin/lint-imports

types: $(VENV)/ready
	$(VENV)/bin/mypy

# the documentation as a site, in site/ (a minute); a link, an anchor or an image that is missing fails
$(VENV)/docs: $(VENV)/ready pyproject.toml
	$(VENV)/bin/$(PIP_INSTALL) --editable '.[docs]'
	touch $@

docs: $(VENV)/docs
	rm -rf site .cache/docs
	$(VENV)/bin/sphinx-build --quiet --fail-on-warning -c docs/.site -d .cache/docs docs site

clean:
	rm -rf $(VENV) $(TEST_VENV) build dist driftlab.egg-info demo_out site .cache/docs
