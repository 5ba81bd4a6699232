# The emulators: real images behind the interface of a simulated MCU.
#
#   $(EMULATOR_STM32F334)   the STM32F334 on PyPI's unicorn, whose wheel brings headers and library into .venv
#   emulator                all of them, and the images they run

EMULATOR_DIR     := klippy/simulation/emulator
EMULATOR_OUT     := $(OUT)/emulator
EMULATOR_INCLUDES := -Isrc/simulator -Iklippy/simulation/world
EMULATOR_CFLAGS  := -std=gnu11 -O2 -g -fPIC -fvisibility=hidden -Wall -Wextra -Werror $(EMULATOR_INCLUDES)
UNICORN          ?= $(firstword $(shell ls -d $(CURDIR)/.venv/lib/python3*/site-packages/unicorn 2>/dev/null))
UNICORN_CFLAGS    = -isystem $(UNICORN)/include
UNICORN_LIBS      = $(UNICORN)/lib/libunicorn.so.2 -Wl,-rpath,$(UNICORN)/lib

EMULATOR_CORTEX_SOURCES    := $(wildcard $(EMULATOR_DIR)/*.c)
EMULATOR_STM32F334_SOURCES := $(EMULATOR_CORTEX_SOURCES) $(wildcard $(EMULATOR_DIR)/stm32f334/*.c)
EMULATOR_HEADERS           := $(wildcard $(EMULATOR_DIR)/*.h $(EMULATOR_DIR)/stm32f334/*.h) \
                              src/simulator/sim_mcu.h klippy/simulation/world/chip_sensor.h
EMULATOR_STM32F334         := $(EMULATOR_OUT)/libferrite_stm32f334.so

.PHONY: emulator
emulator: $(EMULATOR_STM32F334)

# Calls within the library stay within it (-Bsymbolic): several copies are loaded side by side. Put in place whole: another
# make may be at the same, or an emulator may have the old one open.
$(EMULATOR_STM32F334): $(EMULATOR_STM32F334_SOURCES) $(EMULATOR_HEADERS) $(EMULATOR_DIR)/emulator.mk
	@mkdir -p $(@D)
	$(CC) $(EMULATOR_CFLAGS) $(UNICORN_CFLAGS) -flto -shared -Wl,-Bsymbolic -o $@.$$$$ $(EMULATOR_STM32F334_SOURCES) \
		$(UNICORN_LIBS) && mv $@.$$$$ $@

include $(EMULATOR_DIR)/atmega2560/atmega2560.mk
