# make run   this computer becomes a robot's MQTT endpoint, with a demo robot   make run PORT=9883 PLAIN_PORT=9884 WEB_PORT=9443
# make test  every check: format, lint, types, import directions, tests
# make test-kilted  of these the tests that tell most about a distribution of ROS 2, on Kilted in place of Jazzy
# make test-compiled  the tests with the broker as machine code: half an hour
# make compiled  a wheel in dist/ with the broker as machine code, for this Python and this kind of
#                computer; needs a C compiler and Python's headers (apt install gcc python3-dev)
# make binary    dist/appliance: one executable with everything in it, for this kind of computer;
#                needs binutils and Python's shared library (apt install binutils libpython3-dev);
#                with the broker as machine code: make binary COMPILE=1, or make deb COMPILE=1
# make deb   dist/appliance_VERSION_ARCHITECTURE.deb of what `make binary` makes, with its service
# make release   all that a release publishes, in dist/: docs/release.md says what, and what it needs
# What they install goes to .venv, what they make to run; both can be deleted at any time.

PYTHON ?= python3
PORT ?= 8883
PLAIN_PORT ?= 1883
WEB_PORT ?= 8443
WORKERS ?= 4
BIN := .venv/bin
INSTALL := $(BIN)/pip install -q --use-pep517 --disable-pip-version-check -c constraints.txt
# Of the build's own environment too, to which `-c` does not apply.
COMPILING := APPLIANCE_COMPILE=1 PIP_CONSTRAINT=$(CURDIR)/constraints.txt
INTEROP := tests/interop/mqttjs
KILTED := .venv-kilted
# Own interfaces both ways, services, actions, parameters, QoS, the loop's own subscriptions, losses, discovery, remapping.
KILTED_TESTS := tests/ros/ros2 tests/ros/payload/test_own_interfaces.py tests/ros/test_robot.py

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

.PHONY: run test test-kilted test-compiled checks tests-imported compiled binary deb release
run: .venv/run.stamp
	@$(BIN)/appliance init --demo --dir run
	@APPLIANCE_PORT=$(PORT) APPLIANCE_PLAIN_PORT=$(PLAIN_PORT) APPLIANCE_WEB_PORT=$(WEB_PORT) \
	  exec $(BIN)/appliance demo -c run/appliance.yaml

# Most of a test's time is waiting, so four at a time (on two cores); those that compare times come after them, alone.
# Hundreds of processes are started: each of them compiles all its modules where that is not kept.
# Only files with the word are imported for the marker `timed`: to import all takes longer than some of its tests.
test: export PYTHONDONTWRITEBYTECODE =
test:
	@$(MAKE) --no-print-directory -j3 --output-sync checks tests-imported $(INTEROP)/node_modules
	$(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m 'not timed'
	$(BIN)/pytest -m timed $$(grep -rlw timed tests --include='test_*.py')

checks: .venv/test.stamp
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Beside the checks, pytest compiles what it imports, which else each of its workers would do. What fails here fails
# again in the test run, which says why.
tests-imported: .venv/test.stamp
	@$(BIN)/pytest --collect-only -qq >/dev/null 2>&1 || true

# All but what builds, measures, or asks other Pythons: with machine code, as it is released.
test-compiled: .venv/test.stamp build/compiled $(INTEROP)/node_modules
	PYTHONPATH=$(CURDIR)/build/compiled $(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder \
	  -m 'not timed and not patches' $(addprefix --ignore=tests/,arm64 bench container packaging test_oldest_python.py)

test-kilted: $(KILTED)/test.stamp
	$(KILTED)/bin/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m 'not timed' $(KILTED_TESTS)

compiled: .venv/run.stamp
	$(COMPILING) $(BIN)/pip wheel -q --use-pep517 --disable-pip-version-check --no-deps -w dist .

ifeq ($(COMPILE),1)
binary: build/compiled
BINARY_OPTIONS := -- --compiled build/compiled
endif
binary: .venv/binary.stamp
	$(BIN)/pyinstaller --noconfirm --log-level WARN --workpath build --distpath dist appliance/packaging/appliance.spec $(BINARY_OPTIONS)
	@ls -sh dist/appliance

# Anew each time: of what setuptools has left there it would also take what is no longer compiled.
.PHONY: build/compiled
build/compiled: .venv/binary.stamp
	@rm -rf build/lib.* build/bdist.* build/wheel $@
	$(COMPILING) $(BIN)/pip wheel -q --use-pep517 --disable-pip-version-check --no-deps -w build/wheel .
	@$(BIN)/python -m zipfile -e build/wheel/*.whl $@

deb: binary
	@$(BIN)/python -m appliance.packaging.deb dist/appliance

release: .venv/release.stamp
	@$(BIN)/python -m appliance.packaging.release $(RELEASE_OPTIONS)

.venv/bin/pip:
	@echo "Setting up .venv; the first time this takes a minute or two."
	@$(PYTHON) -c 'import appliance' && $(PYTHON) -m venv $(VENV_OPTIONS) .venv

.venv/run.stamp: pyproject.toml constraints.txt | .venv/bin/pip
	@$(INSTALL) -e '.$(RUN_EXTRAS)'
	@touch $@

# What tests need has all that `make run` needs.
.venv/test.stamp: pyproject.toml constraints.txt | .venv/bin/pip
	@$(INSTALL) -e '.$(TEST_EXTRAS)'
	@touch .venv/run.stamp $@

# Its versions of ROS 2 take the place of those that constraints.txt has.
$(KILTED)/test.stamp: pyproject.toml constraints.txt tests/ros/kilted.txt
	@test -x $(KILTED)/bin/pip || $(PYTHON) -m venv $(KILTED)
	@grep -v '^ros-' constraints.txt > $(KILTED)/constraints.txt
	@$(KILTED)/bin/pip install -q --use-pep517 --disable-pip-version-check -c $(KILTED)/constraints.txt -e '.[camera]' \
	  -r tests/ros/kilted.txt hypothesis jinja2 jsonschema pytest pytest-asyncio pytest-timeout pytest-xdist
	@touch $@

.venv/binary.stamp: .venv/run.stamp
	@$(INSTALL) -e '.$(BINARY_EXTRAS)'
	@touch $@

.venv/release.stamp: .venv/run.stamp
	@$(INSTALL) -e '.[release]'
	@touch $@

# MQTT.js is one of the clients that the tests speak with; without npm those tests are skipped.
$(INTEROP)/node_modules: $(wildcard $(INTEROP)/package-lock.json)
	@if command -v npm >/dev/null && test -n "$<"; then cd $(INTEROP) && npm ci --silent --no-audit --no-fund && touch node_modules; fi
