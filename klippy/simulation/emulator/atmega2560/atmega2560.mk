# The ATmega2560 on libsimavr (Debian: libsimavr-dev).
EMULATOR_ATMEGA2560_SOURCES := $(wildcard klippy/simulation/emulator/atmega2560/*.c)
EMULATOR_ATMEGA2560         := $(OUT)/emulator/libferrite_atmega2560.so

emulator: $(EMULATOR_ATMEGA2560)
$(EMULATOR_ATMEGA2560): $(EMULATOR_ATMEGA2560_SOURCES) klippy/simulation/emulator/emulator.h src/simulator/sim_mcu.h \
		$(wildcard klippy/simulation/emulator/atmega2560/*.h klippy/simulation/emulator/atmega2560/*.mk)
	@mkdir -p $(@D)
	$(CC) -std=gnu11 -O2 -g -fPIC -fvisibility=hidden -Wall -Wextra -Werror -Isrc/simulator -Iklippy/simulation/emulator \
		-isystem /usr/include/simavr -shared -Wl,-Bsymbolic -o $@.new $(EMULATOR_ATMEGA2560_SOURCES) -lsimavr
	@mv $@.new $@
