# make demo   installs into .venv and finds mushrooms in a recording
# make test   installs into .venv and runs lint, types and tests
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# pip compiles modules on one core, which takes most of a minute; here all cores do, afterwards.
INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile
COMPILE := $(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true  # some are of another Python

.PHONY: demo test lint types docs unit test-slow recordings clean

# The first time kernels are compiled: those of `cap-fit` on the other core.
demo: $(STAMP)
	@$(MAKE) --silent kernels-pose & $(BIN)/mushpipe run graphs/demo.yaml; code=$$?; wait; exit $$code

test:
	$(MAKE) --jobs 2 $(STAMP)-dev system-libraries
	$(MAKE) --jobs 2 lint docs types kernels-pose kernels-others
	$(MAKE) unit

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "mushpipe needs Python 3.11 or newer; set PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && apt-get install -y -qq python3-venv && $(PYTHON) -m venv $(VENV); \
	  else echo "install python3-venv first: sudo apt-get install python3-venv"; exit 1; fi; }

$(STAMP): $(VENV)/bin/python pyproject.toml
	$(INSTALL) --editable .
	@$(COMPILE)
	@touch $@

$(STAMP)-dev: $(VENV)/bin/python pyproject.toml
	$(INSTALL) --editable '.[dev]'
	@$(COMPILE)
	@touch $@ $(STAMP)

# open3d needs libGL and libEGL; the tests that use it say so and are skipped without them.
# After the virtual environment, which may need apt-get as well.
.PHONY: system-libraries
system-libraries: | $(VENV)/bin/python
	@ldconfig -p | grep -q libEGL.so.1 && ldconfig -p | grep -q 'libGL.so.1' || { \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && apt-get install -y -qq libegl1 libgl1 libusb-1.0-0 >/dev/null; \
	  else echo "note: sudo apt-get install libegl1 libgl1 enables the open3d tests"; fi; }

lint: $(STAMP)-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)-dev
	$(BIN)/mypy

# The site goes to out/site; `mkdocs serve` shows it while it is written. With --quiet, no dead
# link would count.
docs: $(STAMP)-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir out/site

# The tests start the program some hundred times: Python shall not compile its modules each time.
unit kernels-pose kernels-others: export PYTHONDONTWRITEBYTECODE :=

# Two processes of tests that begin together would compile the same kernels, each for itself.
.PHONY: kernels-pose kernels-others
kernels-pose: $(STAMP)
	$(BIN)/python -c 'from mushpipe.stages.cap_fit import CapFit; CapFit().open()'
kernels-others: $(STAMP)-dev
	$(BIN)/mushpipe run graphs/classic.yaml --set pose.use=surface-fit

# On two cores in three fifths of the time. Each takes half of the files, since fixtures of a file are
# made once for a core; whichever is done first takes half of what the other still has.
unit: $(STAMP)-dev
	$(BIN)/pytest -m 'not slow' --numprocesses auto --maxprocesses 2 --dist worksteal

test-slow: $(STAMP)-dev system-libraries
	$(BIN)/pytest -m slow

# With the oldest versions that pyproject.toml allows. Goldens are left out, and a test that depends
# on the last bits as well: older versions of numba and ONNX Runtime have others.
LOWEST := .venv-lowest
.PHONY: test-lowest
test-lowest: system-libraries
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/pip install --quiet --disable-pip-version-check uv
	$(LOWEST)/bin/uv pip install --quiet --python $(LOWEST) --resolution lowest-direct --editable '.[dev]'
	$(LOWEST)/bin/pytest -m 'not slow' --numprocesses 2 --dist worksteal --ignore tests/proof/test_goldens.py \
	  --deselect tests/stages/test_learned_chain.py::test_what_is_hardly_a_cap

# Weights of the verifiers of detector and cap fit, from simulated scenes alone; rendering takes minutes.
# For another network BESIDE=--beside trains those beside one, and leaves the others as they are.
.PHONY: verifier
verifier: $(STAMP)-dev system-libraries
	$(BIN)/python -m training.verifier $(BESIDE)
	$(BIN)/python -m training.fitted $(BESIDE)

# Networks of `cap-net`. The one that ships takes two targets. `train-taught`: three seeds taught by a
# large one, eleven minutes of training on a GPU that PyTorch knows, beside 15 cores that cut crops,
# and joined into one. `train-tables` trains that one on, at tables: an hour on two cores. It begins
# with the one that was made so, out of an earlier commit, so that no GPU is needed.
# `train` makes one from nothing on two cores within an hour: frames, network, figures; `train-seeds`
# adds two that tell how much chance there is. There a training takes one core, and half of another
# to cut its crops; meanwhile the one that ships is judged, which renders the frames for it. PyTorch
# for the CPU comes from PyTorch's own index; elsewhere `torch` would bring CUDA along.
NET := out/net
CORES := $(shell nproc)
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
JOINED := 0b8270f
render = for part in $$(seq $(CORES)); do $(BIN)/python -m training.net.scenes $(1) \
  --part $$((part - 1)) --of $(CORES) & pids="$$pids $$!"; done; for pid in $$pids; do wait $$pid || exit 1; done
.PHONY: train train-seeds train-taught train-tables
train: $(STAMP) system-libraries
	$(INSTALL) --editable '.[train]' --extra-index-url $(TORCH_INDEX)
	$(call render,--frames 640)
	nice $(BIN)/python -m training.net.judge > $(NET)/shipped.txt & \
	  OMP_NUM_THREADS=1 $(MAKE) --always-make $(NET)/seed-1.onnx && wait
	$(BIN)/python -m training.net.judge --peers --models $(NET)/seed-1.onnx

train-seeds: train
	OMP_NUM_THREADS=1 $(MAKE) --always-make --jobs 2 $(NET)/seed-0.onnx $(NET)/seed-2.onnx
	$(BIN)/python -m training.net.judge --models $(NET)/seed-0.onnx $(NET)/seed-1.onnx $(NET)/seed-2.onnx

train-taught: $(STAMP) system-libraries
	$(INSTALL) --editable '.[train]'
	$(call render,--frames 2000)
	$(BIN)/python -m training.net.taught --out $(NET)
	$(BIN)/python -m training.net.joined --weights $(NET)/taught-1.pt $(NET)/taught-0.pt $(NET)/taught-2.pt
	for name in taught-0 taught-1 taught-2 joined; do $(BIN)/python -m training.net.export \
	  --weights $(NET)/$$name.pt --out $(NET)/$$name.onnx || exit 1; done
	$(BIN)/python -m training.net.judge --peers \
	  --models $(NET)/taught-0.onnx $(NET)/taught-1.onnx $(NET)/taught-2.onnx $(NET)/joined.onnx

train-tables: $(STAMP) system-libraries
	$(INSTALL) --editable '.[train]' --extra-index-url $(TORCH_INDEX)
	$(call render,--tables)
	git show $(JOINED):mushpipe/stages/cap_net.onnx > $(NET)/before.onnx
	$(BIN)/python -m training.net.tables --start $(NET)/before.onnx
	$(BIN)/python -m training.net.export --out $(NET)/tables.onnx \
	  --weights $(NET)/tables-3000.pt $(NET)/tables-4500.pt $(NET)/tables-5500.pt
	$(BIN)/python -m training.net.judge --models $(NET)/before.onnx $(NET)/tables.onnx

$(NET)/seed-%.onnx:
	$(BIN)/python -m training.net.train --seed $* --out $(NET)/seed-$*.pt
	$(BIN)/python -m training.net.train --seed 2$* --start $(NET)/seed-$*.pt --steps 8000 \
	  --rate 1.2e-3 --stained --out $(NET)/stained-$*.pt
	$(BIN)/python -m training.net.export --weights $(NET)/seed-$*.pt $(NET)/stained-$*.pt --out $@

# A long replay with every sink attached, whose memory must stay flat; MINUTES=5 for a short one.
MINUTES ?= 60
.PHONY: soak
soak: $(STAMP)
	$(BIN)/python -m benchmarks.soak --minutes $(MINUTES)

recordings: $(STAMP) system-libraries
	$(BIN)/python -m mushpipe.sim.recordings

# Beds by another renderer, with their truth, and the graphs held against them: no scene or shape of the
# simulator, nothing trained on them. A quarter of an hour on two cores.
TRACED := out/traced
.PHONY: traced
traced: $(STAMP) system-libraries
	@ldconfig -p | grep -q libLLVM.so.19 || { \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && apt-get install -y -qq libllvm19 >/dev/null; \
	  else echo "note: Mitsuba needs LLVM 16 or newer: sudo apt-get install libllvm19"; fi; }
	$(INSTALL) --editable '.[traced]'
	$(BIN)/python -m training.traced --out $(TRACED)
	$(BIN)/python -m training.net.judge --peers --recordings $(TRACED)/*.mcap
	for graph in pick classic; do $(BIN)/mushpipe eval graphs/$$graph.yaml --recordings $(TRACED); done

# Results every recording is held to; shows what changes.
.PHONY: goldens
goldens: $(STAMP)-dev system-libraries
	$(BIN)/python -m tests.proof.goldens

clean:
	rm -rf $(VENV) $(LOWEST) out failures .mypy_cache .ruff_cache .pytest_cache
