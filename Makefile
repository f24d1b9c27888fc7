# make run    sets everything up and runs the whole loop on the built-in robot over real Zenoh
# make test   sets everything up and runs the quick tests, in some minutes
# make test-all  every test: also whole stories, all traces, measured recordings, further seeds
# make check  format, lint, types, import walls, language, docs
# make bench  the figures that the docs state, as ratios in one run
# make mutation  does a test notice every small change of the gate, the certificate and the core, and is every line of them run
# make robotarium-experiment  the paper's experiment, reading by reading, with its figures on one page (robotarium-experiment.html)
# make quadruped-experiment   the paper's other experiment, on a walking robot in rigid-body physics (quadruped-experiment.html)
# make rover-experiment       the whole loop on a real autopilot in its own simulator, in real time (rover-experiment.html); STORIES=3, SITL=FOLDER
# make bench-trace  the tracer on seeded recordings that it has never seen, in some 15 minutes; SETS="--seeds 0:5 --failures" for others
# make bench-quadruped  two and a half simulated hours of walking: falls, tracking, and how fast the simulation is
# make bench-endurance  the daemon for half an hour at 100 Hz and half an hour at 1 kHz: memory, latency, jitter. MINUTES=5 for less
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
RUNS := $(VENV)/.runs

.PHONY: bench-endurance run test test-all check quadruped-experiment mutation bench bench-trace bench-quadruped robotarium-experiment rover-experiment format clean wheels setup

run: $(RUNS)
	$(BIN)/s2r demo

# Some tests compute, most wait for robots: side by side they keep two cores busy. All of it at the lowest priority, since the daemon's
# worker runs at that: beside tests of a higher one it would hardly run at all.
TESTS := PYTHONHASHSEED=0 nice -n 19 $(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder --durations 10

test: $(STAMP)
	$(TESTS)

test-all: $(STAMP)
	$(TESTS) -m ""

check: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/python tools/vocabulary.py
	$(BIN)/mypy & $(BIN)/pytest -m "" tests/test_docs.py; docs=$$?; wait $$! || { echo "mypy failed, see above" >&2; exit 1; }; exit $$docs

mutation: $(STAMP)
	PYTHONHASHSEED=0 nice -n 19 $(BIN)/python tools/mutation.py

bench: $(STAMP)
	-@$(BIN)/python -c 'import importlib.util, sys; sys.exit(importlib.util.find_spec("rtamt") is None)' || \
	    $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[bench]'
	$(BIN)/python tools/bench.py

robotarium-experiment: $(STAMP)
	$(BIN)/python tools/robotarium_experiment.py -o robotarium-experiment.html --json robotarium-experiment.json

quadruped-experiment: $(STAMP)
	$(BIN)/python tools/quadruped_experiment.py -o quadruped-experiment.html --json quadruped-experiment.json

STORIES ?= 1
SITL ?= $(S2R_SITL)

rover-experiment: $(STAMP)
	$(BIN)/python tools/rover_experiment.py --stories $(STORIES) $(if $(SITL),--sitl $(SITL)) -o rover-experiment.html --json rover-experiment.json

SETS ?= --seeds 1000000:1000020 --jobs 2

bench-trace: $(STAMP)
	@$(BIN)/python -c 'import importlib.util, sys; sys.exit(importlib.util.find_spec("pysindy") is None)' || \
	    $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[bench]'
	$(BIN)/python tools/bench_trace.py $(SETS)

bench-quadruped: $(STAMP)
	$(BIN)/python tools/bench_quadruped.py

MINUTES ?= 30

bench-endurance: $(STAMP)
	$(BIN)/python tools/bench_endurance.py --minutes $(MINUTES)

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

wheels: $(STAMP)
	rm -rf dist
	for package in . plugins/zenoh plugins/can plugins/mavlink plugins/standins plugins/ros2; do $(BIN)/python -m build --wheel --outdir dist $$package || exit 1; done

setup: $(STAMP)

PROJECTS := pyproject.toml constraints.txt $(addprefix plugins/,$(addsuffix /pyproject.toml,zenoh can mavlink standins ros2))
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

# What the built-in robot's whole loop needs, and no more.
$(RUNS): $(PROJECTS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed; this is $$($(PYTHON) --version). Set PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || { echo "the venv module is missing: sudo apt-get install python3-venv" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable '.[report]' --editable plugins/zenoh --editable plugins/standins
	@$(BIN)/python -m compileall -q s2r_runtime plugins  # else each start does it again where PYTHONDONTWRITEBYTECODE is set
	@touch $(RUNS)

# What developers need besides.
$(STAMP): $(RUNS)
	$(INSTALL) --editable '.[report,formats,onnx,dev]' --editable plugins/zenoh --editable plugins/can --editable plugins/mavlink \
	    --editable 'plugins/standins[sim]' --editable 'plugins/ros2[formats]'
	@touch $(STAMP)

clean:
	rm -rf $(VENV) build dist *.egg-info plugins/*/*.egg-info
