# make run   this computer becomes a robot's MQTT endpoint, with a demo robot   make run PORT=9883 PLAIN_PORT=9884 WEB_PORT=9443
# make test  every check: format, lint, types, import directions, tests
# make compiled  a wheel in dist/ with the broker as machine code, for this Python and this kind of
#                computer; needs a C compiler and Python's headers (apt install gcc python3-dev)
# make binary    dist/appliance: one executable with everything in it, for this kind of computer;
#                needs binutils and Python's shared library (apt install binutils libpython3-dev)
# make deb   dist/appliance_VERSION_ARCHITECTURE.deb of what `make binary` makes, with its service
# What they install goes to .venv, what they make to run; both can be deleted at any time.

PYTHON ?= python3
PORT ?= 8883
PLAIN_PORT ?= 1883
WEB_PORT ?= 8443
WORKERS ?= 3
BIN := .venv/bin
INTEROP := tests/interop/mqttjs

# A sourced ROS is used as it is; without one, ROS 2 comes from PyPI.
ifdef ROS_DISTRO
VENV_OPTIONS := --system-site-packages
TEST_EXTRAS := [test]
BINARY_EXTRAS := [binary]
else
RUN_EXTRAS := [ros,camera]
TEST_EXTRAS := [ros,test]
BINARY_EXTRAS := [ros,binary]
endif

.PHONY: run test compiled binary deb
run: .venv/run.stamp
	@$(BIN)/appliance init --demo --dir run
	@APPLIANCE_PORT=$(PORT) APPLIANCE_PLAIN_PORT=$(PLAIN_PORT) APPLIANCE_WEB_PORT=$(WEB_PORT) \
	  exec $(BIN)/appliance demo -c run/appliance.yaml

# Most of a test's time is waiting, so three at a time (on two cores); those that compare times come after them, alone.
# Hundreds of processes are started: each of them compiles all its modules where that is not kept.
test: export PYTHONDONTWRITEBYTECODE =
test: .venv/test.stamp $(INTEROP)/node_modules
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m 'not timed'
	$(BIN)/pytest -m timed

compiled: .venv/run.stamp
	APPLIANCE_COMPILE=1 $(BIN)/pip wheel -q --use-pep517 --disable-pip-version-check --no-deps -w dist .

binary: .venv/binary.stamp
	$(BIN)/pyinstaller --noconfirm --log-level WARN --workpath build --distpath dist appliance/packaging/appliance.spec
	@ls -sh dist/appliance

deb: binary
	@$(BIN)/python -m appliance.packaging.deb dist/appliance

.venv/run.stamp: pyproject.toml constraints.txt
	@echo "Setting up .venv; the first time this takes a minute or two."
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV_OPTIONS) .venv
	@$(BIN)/pip install -q --use-pep517 --disable-pip-version-check -c constraints.txt -e '.$(RUN_EXTRAS)'
	@touch $@

.venv/test.stamp: .venv/run.stamp
	@$(BIN)/pip install -q --use-pep517 --disable-pip-version-check -c constraints.txt -e '.$(TEST_EXTRAS)'
	@touch $@

.venv/binary.stamp: .venv/run.stamp
	@$(BIN)/pip install -q --use-pep517 --disable-pip-version-check -c constraints.txt -e '.$(BINARY_EXTRAS)'
	@touch $@

# MQTT.js is one of the clients that the tests speak with; without npm those tests are skipped.
$(INTEROP)/node_modules: $(wildcard $(INTEROP)/package-lock.json)
	@if command -v npm >/dev/null && test -n "$<"; then cd $(INTEROP) && npm ci --silent --no-audit --no-fund && touch node_modules; fi
