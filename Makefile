# Ferrite. `make demo` prints a part on the simulated printer, `make test` runs everything that must hold.
# All that is made goes to out/ and .venv/.

OUT    := out
PYTHON := .venv/bin/python
JOBS   ?= 2

# make V=1 shows the commands.
ifndef V
.SILENT:
endif

.DEFAULT_GOAL := help
.PHONY: help setup setup-test sim chelper demo printer deb test test-browser test-flash check format bench bench-plan bench-control bench-disturbance bench-machines bench-clog bench-studies soak soak-motion soak-api soak-kill fuzz mutants clean distclean

help:
	@echo "make demo    print a part on the simulated induction printer; report in $(OUT)/demo"
	@echo "make printer a simulated printer in real time with Moonraker and a dashboard (FRONT_END=folder: another front end)"
	@echo "make deb     a Debian package of the host: $(OUT)/ferrite_VERSION_all.deb"
	@echo "make test    all checks and tests, except for:"
	@echo "make test-browser the tests of report and dashboard in a browser (installs Chromium)"
	@echo "make test-flash   the tests of make flash with the boards' tools (installs avrdude, openocd)"
	@echo "make check   the checks only: lint, types, layers, message formats, cross compilation"
	@echo "make bench   print the 5 MB benchy in closed loop and report speed and memory (QUICK=1: the short file)"
	@echo "make bench-thermometer  accuracy and latency of the estimate, beside the published chain"
	@echo "make bench-control      every control law on the same plants, and on random machines (studies; QUICK=1)"
	@echo "make bench-disturbance  a sine on the reading: how much of it reaches the true temperature (a study; QUICK=1)"
	@echo "make bench-motion       moves a second, batch mode and print (PEER=\"CMD\": a peer beside it; QUICK=1)"
	@echo "make bench-steady       printing in real time beside a busy computer; memory of ten hours (QUICK=1)"
	@echo "make bench-api          50 clients of the API during ten minutes of printing (QUICK=1: one)"
	@echo "make bench-firmware     cost of samples, steps, commands on the images of both chips (QUICK=1)"
	@echo "make bench-identify     hidden plants found again from their recorded prints (QUICK=1)"
	@echo "make bench-faults       every fault on every machine in every state: caught by what, how hot (QUICK=1)"
	@echo "make bench-recovery     where an interrupted print would be resumed, at 1,000 instants (a study; RUNS=60: fewer; QUICK=1)"
	@echo "make bench-plan         what the temperature plan does for welds, and how the melt follows it (studies)"
	@echo "make bench-machines     1,000 drifting machines, calibrated and printing for 20 minutes (a study; RUNS=20: 40; QUICK=1)"
	@echo "make bench-clog         clogs, runouts, grinding and clean prints on random machines (studies; RUNS=4: fewer; QUICK=1)"
	@echo "make bench-studies      the studies of config/studies: random machines, calibrated machines, the sample"
	@echo "make soak               a long print in closed loop: does it leak? (HOURS=10, hours of wall time, too)"
	@echo "make soak-api           clients that misbehave beside a print, one thing a simulated second (HOURS=24; EACH=60: a minute of each)"
	@echo "make soak-kill          the host is killed while it writes a file (KILLS=200 of each kind)"
	@echo "make soak-motion        random moves on every machine against the analytic path (SECONDS=600)"
	@echo "make mutants FILE=guard  do its tests notice each small change of a safety file? (without FILE: all, hours)"
	@echo "make fuzz    fuzz the firmware's message parser (FUZZ_SECONDS=600)"
	@echo "make sim     build the simulated MCU and the world it lives in"
	@echo "make menuconfig     choose a chip and its options; then make, make flash, make size"
	@echo "make PORT=stm32f334 the firmware for that chip (or atmega2560, simulator); PORT=... flash, PORT=... size"
	@echo "make clean   remove $(OUT); make distclean also removes .venv"

setup:
	@scripts/setup.sh demo

setup-test:
	@scripts/setup.sh test

# Set-up comes first, and what it brings is needed by what follows: one thing at a time, also with -j.
.NOTPARALLEL:
fuzz: setup-test

# The firmware's rules (any port, simulator included) and the simulated world's.
include src/build.mk
include src/ports.mk
include klippy/simulation/world/world.mk
include klippy/simulation/emulator/emulator.mk

# --- build ---------------------------------------------------------------------------------------
# src/build.mk makes libferrite_mcu.so and ferrite.dict, world.mk (SIM_TARGETS) the machine around them.
sim: $(SIM_MCU_LIB) $(SIM_TARGETS)

chelper: setup
	@$(PYTHON) -c "import sys; sys.path.insert(0, 'klippy'); import chelper; chelper.get_ffi()"

# --- run -----------------------------------------------------------------------------------------
demo: setup sim chelper
	@$(PYTHON) scripts/demo.py --out $(OUT)/demo

printer: setup sim chelper
	@scripts/setup.sh moonraker
	@$(PYTHON) scripts/run_printer.py --front-end $(or $(FRONT_END),klippy/webhooks/dashboard)

deb:
	@scripts/build/build_deb.py --out $(OUT)

# QUICK=1: what each bench leaves out then stands in its --help.
BENCH = $(PYTHON) scripts/bench/bench_$*.py --json $(OUT)/bench/$*.json
BENCHES := bench-print bench-api bench-thermometer bench-motion bench-steady bench-firmware bench-identify bench-faults
.PHONY: $(BENCHES)
bench: bench-print
$(BENCHES): bench-%: setup sim chelper
	@$(BENCH) $(if $(QUICK),--quick) $(ARGS)

bench-thermometer bench-firmware: setup-test
bench-motion: ARGS = $(if $(PEER),--peer "$(PEER)")

# Benches that are studies, and what each measures besides.
STUDIES_bench-control := control control_machines
STUDIES_bench-disturbance := disturbance
STUDIES_bench-recovery := recovery
STUDIES_bench-plan    := plan_prints plan_steps
STUDIES_bench-machines := bench_machines
STUDIES_bench-clog    := clog lost_flow clean_prints
STUDIES_bench-studies := machines calibrated sample_print real
BESIDE_bench-control  = $(PYTHON) scripts/bench/bench_control.py --json $(OUT)/bench/control.json $(if $(QUICK),--quick)
BESIDE_bench-plan     = $(PYTHON) scripts/bench/bench_plan.py --json $(OUT)/bench/plan.json && \
    $(PYTHON) scripts/bench/bench_plan_cost.py --memory benchy.gcode && \
    $(PYTHON) scripts/bench/bench_plan_cost.py --real-time 30

bench-recovery bench-control bench-disturbance bench-plan bench-machines bench-clog bench-studies: setup sim chelper
	@scripts/setup.sh study
	@status=0; for study in $(STUDIES_$@); do \
	    $(PYTHON) scripts/study.py config/studies/$$study.toml --out $(OUT)/studies/$$study $(if $(QUICK),--small) $(if $(RUNS),--runs $(RUNS)) || status=1; \
	done; $(or $(BESIDE_$@),true) || status=1; exit $$status

soak: setup sim chelper
	@$(PYTHON) scripts/bench/soak_print.py --hours $(or $(HOURS),10)

soak-motion: setup-test chelper
	@$(PYTHON) scripts/bench/soak_motion.py --seconds $(or $(SECONDS),600)

soak-api: setup sim chelper
	@$(PYTHON) scripts/bench/soak_api.py $(if $(EACH),--each $(EACH),--hours $(or $(HOURS),24))

soak-kill: setup-test chelper
	@KILLS=$(or $(KILLS),200) $(PYTHON) -m pytest test/unit/host/test_killed.py

# --- test ----------------------------------------------------------------------------------------
# Both are run to their end whatever the other finds; the tests' closing line comes last.
test: setup-test sim chelper
	@status=0; \
	$(MAKE) --no-print-directory --keep-going check || status=1; \
	$(PYTHON) -m pytest -n $(JOBS) --dist worksteal $(TEST_ARGS) || status=1; \
	exit $$status

# What only these need is installed by these only.
test-browser: setup sim chelper
test-browser test-flash: test-%:
	@scripts/setup.sh $*
	@$(PYTHON) -m pytest -m $* $(TEST_ARGS)

CHECKS := check-format check-lint check-types check-c check-layers check-paths check-words check-formats check-cross check-registers
.PHONY: $(CHECKS)
check: setup-test sim $(CHECKS)
	@echo "check: all passed"

check-format:
	$(PYTHON) -m ruff format --check --quiet .

check-lint:
	$(PYTHON) -m ruff check --quiet .

check-types:
	$(PYTHON) -m mypy --no-error-summary

# DICTIONARY_PASS is for scripts/build/build_dictionary.py; cppcheck 2.10 knows noreturn only as an attribute.
# The firmware's own files meet four compilers in check-cross. (The C helper is not compiled with -Isrc: the
# system's headers would find the firmware's sched.h.)
check-c:
	for compiler in gcc clang; do \
	    $$compiler $(STRICT_C) -Iklippy $(HOST_C) && \
	    $$compiler $(STRICT_C) -D_GNU_SOURCE -Isrc -Isrc/simulator $(SIM_PORT) && \
	    $$compiler $(STRICT_C) -D_GNU_SOURCE $(WORLD_INCLUDES) $(WORLD_SOURCES) && \
	    $$compiler $(STRICT_C) $(UNICORN_CFLAGS) $(EMULATOR_INCLUDES) $(EMULATOR_STM32F334_SOURCES) || exit 1; done
	printf '%s\n' $(HOST_C) | xargs -P $(JOBS) -I{} gcc $(filter-out -fsyntax-only,$(STRICT_C)) -fanalyzer -Iklippy -c {} -o /dev/null
	cppcheck --quiet --std=c11 --error-exitcode=1 --inline-suppr -j $(JOBS) \
	    --enable=warning,performance,portability --suppress=missingIncludeSystem \
	    -U DICTIONARY_PASS -U OVERSAMPLE_KERNEL '-D_Noreturn=__attribute__((noreturn))' \
	    -I src -I src/simulator -I klippy $(patsubst -I%,-I %,$(WORLD_INCLUDES)) \
	    $$(git ls-files -co --exclude-standard 'src/*.c' 'klippy/*.c')

# The host's helper, which klippy/chelper/__init__.py compiles.
HOST_C   := $(shell find klippy/chelper klippy/thermal klippy/vibration -name '*.c' 2>/dev/null)
STRICT_C := -std=gnu11 -O2 -Wall -Wextra -Werror -fsyntax-only

check-layers:
	$(PYTHON) scripts/check/check_layers.py $(sort $(HOST_C) $(SIM_SOURCES) $(CROSS_SOURCES) $(WORLD_SOURCES) \
	    $(EMULATOR_STM32F334_SOURCES) $(EMULATOR_ATMEGA2560_SOURCES)) \
	    $(foreach port,$(PORTS),$$($(MAKE) --no-print-directory PORT=$(port) list-sources))

check-paths:
	$(PYTHON) scripts/check/check_paths.py

check-words:
	$(PYTHON) scripts/check/check_words.py

check-formats: sim
	$(PYTHON) scripts/check/check_formats.py $(OUT)/simulator/ferrite.dict

# FILE: guard signal_test oversample phase wire timed_output supervision.
mutants: setup-test
	@$(PYTHON) scripts/check/mutants.py $(FILE)

# The chip's registers, written by hand, against the vendor's table.
check-registers:
	$(PYTHON) scripts/check/check_registers.py

# The portable part of the firmware must compile for the chips it is meant for.
check-cross: compile-check

format:
	$(PYTHON) -m ruff format .
	$(PYTHON) -m ruff check --fix .

clean:
	rm -rf $(OUT) .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find klippy scripts test -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv
