# The firmware of one port: `make PORT=stm32f334`, or `make firmware-stm32f334` beside anything else.
# Included by the top Makefile after src/build.mk.
#
# A port's src/PORT/port.mk gives
#   PORT_CC PORT_OBJCOPY              its tools (PORT_CC is also what preprocesses for the dictionary)
#   PORT_FIRMWARE                     the portable files it takes: some of build.mk's FIRMWARE_ lists
#   PORT_SOURCES                      its own files
#   PORT_PREFIX_MAP                   the option by which the compiler forgets a folder's name (older ones: -fdebug-prefix-map)
#   PORT_CFLAGS PORT_LDFLAGS          what the compiler and the linker need to know beyond what is here
#   PORT_LINK_INPUTS                  files the link depends on (linker script)
#   PORT_IMAGES                       what is made of OUT/PORT/ferrite.elf (ferrite.bin, ferrite.hex), with rules
#   PORT_SEAL                         a command that gets the linked file as its argument, before any image is made of it
#   PORT_FLASH_CMD                    the tool that writes the board, for `make flash`
#   PORT_FLASH_DEVICE                 the serial port that it uses, if it does
#   PORT_PACKAGES                     Debian's names of what has PORT_CC and its libraries
# and may look at CONFIG_ variables of .config (`make menuconfig`); it must do without them.

KCONFIG_CONFIG ?= .config
-include $(KCONFIG_CONFIG)
PORT ?= $(patsubst "%",%,$(CONFIG_PORT))
PORTS := $(patsubst src/%/port.mk,%,$(wildcard src/*/port.mk))
# The scripts used here need nothing but Python: a firmware can be built in a fresh checkout.
PORT_PYTHON := $(firstword $(wildcard .venv/bin/python) python3)

.PHONY: firmware firmware-simulator menuconfig flash size list-sources $(PORTS:%=firmware-%)
firmware-simulator: $(SIM_MCU_LIB)
$(PORTS:%=firmware-%): firmware-%:
	@$(MAKE) --no-print-directory PORT=$* OUT=$(OUT) firmware

# Another port's image by its file name, for whoever runs it in an emulator.
OTHER_PORTS := $(filter-out $(PORT),$(PORTS))
.PHONY: port-image
$(OTHER_PORTS:%=$(OUT)/%/ferrite.elf): $(OUT)/%/ferrite.elf: port-image
	@$(MAKE) --no-print-directory PORT=$* OUT=$(OUT) firmware

ifneq ($(PORT),)
.DEFAULT_GOAL := firmware
endif

ifeq ($(PORT),simulator)
firmware: firmware-simulator
flash size:
	@echo "The simulator is no chip: there is nothing to $@. Choose one of: $(PORTS)" >&2; exit 1
else ifneq ($(filter $(PORT),$(PORTS)),)
include src/$(PORT)/port.mk

# Options of the firmware proper, the same for every port.
PORT_CFLAGS += $(if $(filter y,$(CONFIG_SINGLE_ANALOG_REPORTS)),-DCONFIG_SINGLE_ANALOG_REPORTS)
PORT_FIRMWARE += $(if $(filter y,$(CONFIG_NO_ACCELEROMETERS)),,$(FIRMWARE_ACCELEROMETERS))
PORT_FIRMWARE += $(if $(filter y,$(CONFIG_LOAD_CELLS)),$(FIRMWARE_LOAD_CELLS))
PORT_FIRMWARE += $(if $(filter y,$(CONFIG_EDDY_PROBES)),$(FIRMWARE_EDDY))
PORT_FIRMWARE += $(if $(filter y,$(CONFIG_LOAD_CELLS) $(CONFIG_EDDY_PROBES)),$(FIRMWARE_TRIGGER))
PORT_FIRMWARE += $(if $(filter y,$(CONFIG_ANGLE_SENSORS)),$(FIRMWARE_ANGLE))
PORT_FIRMWARE += $(if $(filter $(FIRMWARE_ACCELEROMETERS) $(FIRMWARE_LOAD_CELLS) $(FIRMWARE_EDDY) $(FIRMWARE_ANGLE), \
	$(PORT_FIRMWARE)),$(FIRMWARE_BULK))

PORT_OUT := $(OUT)/$(PORT)
PORT_PREFIX_MAP ?= -ffile-prefix-map
PORT_ELF := $(PORT_OUT)/ferrite.elf
PORT_ALL_SOURCES := $(PORT_FIRMWARE) $(PORT_SOURCES)
PORT_OBJECTS := $(PORT_ALL_SOURCES:src/%.c=$(PORT_OUT)/obj/%.o) $(PORT_OUT)/obj/compile_time.o
PORT_INCLUDES := -Isrc -Isrc/$(PORT)
# Nothing of the place or the time of the build may get into the image: two builds, one hash.
PORT_ALL_CFLAGS := $(C_WARNINGS) $(PORT_CFLAGS) $(PORT_INCLUDES) -g -ffunction-sections -fdata-sections \
	$(PORT_PREFIX_MAP)=$(CURDIR)=. $(PORT_PREFIX_MAP)=$(PORT_OUT)=out -fno-common
# Other options, other objects: the stamp's name changes with them.
PORT_FLAGS_STAMP := $(PORT_OUT)/obj/flags-$(firstword $(shell echo '$(PORT_CC) $(PORT_ALL_CFLAGS) $(PORT_LDFLAGS)' | cksum))

firmware: $(PORT_ELF) $(PORT_IMAGES:%=$(PORT_OUT)/%)
	@echo "$(PORT): $(PORT_IMAGES:%=$(PORT_OUT)/%)"
# For the check that every C file is built by some rule.
list-sources:
	@echo $(PORT_ALL_SOURCES)
flash: firmware
	@$(PORT_PYTHON) scripts/build/flash_firmware.py $(if $(PORT_FLASH_DEVICE),--device $(PORT_FLASH_DEVICE)) $(PORT_FLASH_CMD)
# KEEP=1 makes today's figures those of the last release.
size: firmware
	@$(PORT_PYTHON) scripts/build/firmware_size.py --port $(PORT) --out $(PORT_OUT) $(if $(KEEP),--keep)

$(PORT_FLAGS_STAMP):
	@command -v $(PORT_CC) >/dev/null || { \
		echo "The firmware for $(PORT) needs $(PORT_CC) (Debian: apt-get install $(PORT_PACKAGES))" >&2; exit 1; }
	@mkdir -p $(@D)
	@rm -f $(PORT_OUT)/obj/flags-*
	@touch $@

$(PORT_OUT)/ferrite.dict $(PORT_OUT)/compile_time.c: $(PORT_OUT)/dictionary.stamp
$(PORT_OUT)/dictionary.stamp: $(PORT_ALL_SOURCES) $(FIRMWARE_HEADERS) $(wildcard src/$(PORT)/*.h) \
		scripts/build/build_dictionary.py $(PORT_FLAGS_STAMP)
	$(PORT_PYTHON) scripts/build/build_dictionary.py --out $(PORT_OUT) --version '$(FERRITE_VERSION)' \
		--cc '$(PORT_CC) $(PORT_CFLAGS) $(PORT_INCLUDES)' $(PORT_ALL_SOURCES)
	@touch $@

$(PORT_OUT)/obj/compile_time.o: $(PORT_OUT)/dictionary.stamp
	@mkdir -p $(@D)
	$(PORT_CC) $(PORT_ALL_CFLAGS) -c -o $@ $(PORT_OUT)/compile_time.c
$(PORT_OUT)/obj/%.o: src/%.c $(PORT_FLAGS_STAMP)
	@mkdir -p $(@D)
	$(PORT_CC) $(PORT_ALL_CFLAGS) -MMD -MP -c -o $@ $<
-include $(PORT_OBJECTS:.o=.d)

# Put in place whole: an emulator may have the old one open, another make may be at the same.
$(PORT_ELF): $(PORT_OBJECTS) $(PORT_LINK_INPUTS)
	$(PORT_CC) $(PORT_CFLAGS) $(PORT_LDFLAGS) -Wl,--gc-sections -Wl,--build-id=none -Wl,-Map=$(PORT_OUT)/ferrite.map \
		-o $@.$$$$ $(PORT_OBJECTS) && $(or $(PORT_SEAL),true) $@.$$$$ && mv $@.$$$$ $@

$(PORT_OUT)/ferrite.bin: $(PORT_ELF)
	$(PORT_OBJCOPY) -O binary $< $@
$(PORT_OUT)/ferrite.hex: $(PORT_ELF)
	$(PORT_OBJCOPY) -O ihex -R .eeprom -R .fuse $< $@
else
firmware flash size:
	@echo "$(if $(PORT),There is no port '$(PORT)'.,Which port?)" \
		"Say make PORT=NAME$(if $(filter firmware,$@),, $@) with one of: simulator $(PORTS);" \
		"or choose one with make menuconfig" >&2; exit 1
endif

menuconfig: setup
	@$(PYTHON) -c 'import menuconfig' 2>/dev/null || $(PYTHON) -m pip install --quiet --disable-pip-version-check \
		$$(grep '^kconfiglib==' requirements-dev.txt)
	@srctree=src KCONFIG_CONFIG=$(KCONFIG_CONFIG) $(PYTHON) scripts/build/run_menuconfig.py Kconfig
