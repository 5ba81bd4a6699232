# Build rules of the firmware, included by the top Makefile (or used alone: make -f src/build.mk).
#
#   $(SIM_MCU_LIB)     the simulated MCU as a shared library, with out/simulator/ferrite.dict beside it
#   firmware-sim       that, by name
#   compile-check      the portable files and the generated tables through clang, arm-none-eabi-gcc and avr-gcc, -Werror
#   sim-mcu-sanitized  the library with address and undefined behaviour sanitizers
#   fuzz-build, fuzz   the receiver's libFuzzer target; `make fuzz FUZZ_SECONDS=3600` for a long run

OUT ?= out
PYTHON ?= $(if $(wildcard .venv/bin/python),.venv/bin/python,python3)
CC ?= gcc
# The same text as klippy/util.py makes: VERSION, and the commit if this is a checkout.
FERRITE_VERSION ?= $(subst $() ,-,$(strip $(file <VERSION) $(shell git describe --always --exclude='*' --dirty 2>/dev/null)))

C_WARNINGS := -std=gnu11 -Wall -Wextra -Werror

# sched and basecmd first: their DECL_INIT functions run first.
FIRMWARE_CORE := src/sched.c src/basecmd.c src/command.c src/wire.c src/debugcmds.c
FIRMWARE_GLUE := src/timed_output.c src/gpiocmds.c src/pwmcmds.c src/adccmds.c src/onoffcmds.c src/supplycmds.c \
	src/trsync.c src/stepper.c src/endstop.c
# The induction heater; needs board/bridge_pwm.h and board/sync_adc.h.
FIRMWARE_INDUCTION := src/oversample.c src/phase.c src/guard.c src/signal_test.c src/filters.c \
	src/block_record.c src/inductionconfig.c src/inductioncmds.c
# Buses and pin peripherals.  A port takes what it has room and hardware for; *_hardware needs board/spi.h, board/i2c.h.
FIRMWARE_BUS := src/spicmds.c src/spi_software.c src/thermocouple.c src/i2ccmds.c src/i2c_software.c
FIRMWARE_BULK := src/sensor_bulk.c
FIRMWARE_ACCELEROMETERS := src/accelerometers.c
FIRMWARE_LOAD_CELLS := src/load_cell_adcs.c
FIRMWARE_EDDY := src/ldc1612.c
FIRMWARE_ANGLE := src/angle.c
# Of load cells and eddy probes.
FIRMWARE_TRIGGER := src/sos_filter.c src/trigger_analog.c
FIRMWARE_SENSORS := $(FIRMWARE_BULK) $(FIRMWARE_ACCELEROMETERS) $(FIRMWARE_TRIGGER) $(FIRMWARE_LOAD_CELLS) $(FIRMWARE_EDDY) \
	$(FIRMWARE_ANGLE)
FIRMWARE_BUS_HARDWARE := src/spi_hardware.c src/i2c_hardware.c
FIRMWARE_PINS := src/buttons.c src/pulse_counter.c src/neopixel.c src/tmcuart.c src/lcd_hd44780.c src/lcd_st7920.c
FIRMWARE_EXTRAS := $(FIRMWARE_BUS) $(FIRMWARE_BUS_HARDWARE) $(FIRMWARE_PINS)
FIRMWARE_SOURCES := $(FIRMWARE_CORE) $(FIRMWARE_GLUE) $(FIRMWARE_INDUCTION)
FIRMWARE_HEADERS := $(wildcard src/*.h src/board/*.h)

SIM_DIR := $(OUT)/simulator
SIM_PORT := src/simulator/sim_mcu.c src/simulator/sim_pins.c src/simulator/sim_bridge.c src/simulator/sim_bus.c
SIM_SOURCES := $(FIRMWARE_SOURCES) $(FIRMWARE_EXTRAS) $(FIRMWARE_SENSORS) $(SIM_PORT)
SIM_HEADERS := $(FIRMWARE_HEADERS) $(wildcard src/simulator/sim_*.h src/simulator/port_types.h)
SIM_INCLUDES := -Isrc -Isrc/simulator
SIM_MCU_LIB := $(SIM_DIR)/libferrite_mcu.so
# Hidden, or the firmware's shutdown() would lose against the C library's socket function of that name.
SIM_SHARED := -g -fPIC -shared -fvisibility=hidden -Wl,-Bsymbolic

.PHONY: firmware-sim sim-mcu-sanitized compile-check fuzz-build fuzz
firmware-sim: $(SIM_MCU_LIB)

$(SIM_DIR)/ferrite.dict $(SIM_DIR)/compile_time.c: $(SIM_DIR)/dictionary.stamp
# Rounded up: a run does not begin earlier because the names of a version and a compiler are shorter.
$(SIM_DIR)/dictionary.stamp: $(SIM_SOURCES) $(SIM_HEADERS) scripts/build/build_dictionary.py src/build.mk
	@mkdir -p $(SIM_DIR)
	$(PYTHON) scripts/build/build_dictionary.py --out $(SIM_DIR) --version '$(FERRITE_VERSION)' --round-up 512 \
		--cc '$(CC) $(SIM_INCLUDES)' $(SIM_SOURCES)
	@touch $@

# One compiler call over everything: a second of work, and calls between files can be inlined.  The library is put in
# place whole, so that whoever has it loaded keeps the old one.
$(SIM_MCU_LIB): $(SIM_DIR)/dictionary.stamp
	$(CC) $(C_WARNINGS) -O2 -flto $(SIM_SHARED) \
		$(SIM_INCLUDES) -o $@.new $(SIM_SOURCES) $(SIM_DIR)/compile_time.c
	mv $@.new $@

# The sanitizers' runtime must be loaded before the program that loads this: LD_PRELOAD=$(gcc -print-file-name=libasan.so)
SIM_MCU_SANITIZED := $(SIM_DIR)/libferrite_mcu_sanitized.so
sim-mcu-sanitized: $(SIM_MCU_SANITIZED)
$(SIM_MCU_SANITIZED): $(SIM_DIR)/dictionary.stamp
	$(CC) $(C_WARNINGS) -O1 $(SIM_SHARED) -fsanitize=address,undefined -fno-sanitize-recover=all \
		$(SIM_INCLUDES) -o $@.new $(SIM_SOURCES) $(SIM_DIR)/compile_time.c
	mv $@.new $@

# --- the portable files on other compilers -------------------------------------------------------
# One stamp a compiler.  Missing cross compilers are an error here: `make check` promises them.
CROSS_DIR := $(OUT)/compile-check
CROSS_SOURCES := $(FIRMWARE_SOURCES) $(FIRMWARE_EXTRAS) $(FIRMWARE_SENSORS) src/template/port.c
CROSS_COMPILERS := clang arm-none-eabi-gcc avr-gcc
CROSS_FLAGS_clang :=
CROSS_FLAGS_arm-none-eabi-gcc := -mcpu=cortex-m4 -mthumb
CROSS_FLAGS_avr-gcc := -mmcu=atmega2560

compile-check: $(CROSS_COMPILERS:%=$(CROSS_DIR)/%/stamp)
$(CROSS_DIR)/%/stamp: $(CROSS_SOURCES) $(FIRMWARE_HEADERS) src/template/port_types.h scripts/build/build_dictionary.py
	@command -v $* >/dev/null || { echo "compile-check needs $*: apt-get install the package that has it"; exit 1; }
	@mkdir -p $(@D)
	@$(PYTHON) scripts/build/build_dictionary.py --out $(@D) --cc '$* $(CROSS_FLAGS_$*) -Isrc -Isrc/template' $(CROSS_SOURCES)
	@for source in $(CROSS_SOURCES) $(@D)/compile_time.c; do \
		$* $(CROSS_FLAGS_$*) $(C_WARNINGS) -Os -Isrc -Isrc/template -c -o $(@D)/$$(basename $$source .c).o $$source \
			|| exit 1; done
	@touch $@

# --- fuzzing the receiver ------------------------------------------------------------------------
FUZZ_SECONDS ?= 600
FUZZ_DIR := $(OUT)/fuzz
fuzz-build: $(FUZZ_DIR)/fuzz_command
$(FUZZ_DIR)/fuzz_command: test/fuzz/fuzz_command.c $(SIM_DIR)/dictionary.stamp
	@mkdir -p $(FUZZ_DIR)
	clang -std=gnu11 -Wall -Wextra -Werror -O1 -g -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all \
		$(SIM_INCLUDES) -o $@ $< $(SIM_SOURCES) $(SIM_DIR)/compile_time.c
fuzz: fuzz-build
	@mkdir -p $(FUZZ_DIR)/corpus
	PYTHONPATH=klippy:scripts/bench/rigs $(PYTHON) test/fuzz/fuzz_seeds.py $(FUZZ_DIR)/corpus
	$(FUZZ_DIR)/fuzz_command -max_len=1024 -max_total_time=$(FUZZ_SECONDS) -artifact_prefix=$(FUZZ_DIR)/ \
		-print_final_stats=1 $(FUZZ_DIR)/corpus
